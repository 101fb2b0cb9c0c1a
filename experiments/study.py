"""Writes the tables of docs/study.md from the archives of experiments/results/study.

A table has the differences that test one hypothesis. `csac-jax report ARCHIVE` shows all else.
"""

import fnmatch
import functools
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from csac_jax.evaluation import statistics
from csac_jax.evaluation.statistics import Band
from csac_jax.evaluation.suites import IN_DISTRIBUTION
from csac_jax.report import result_tables, results
from csac_jax.report.results import RecordedRun
from csac_jax.report.variants import NAMES

ROOT = Path(__file__).resolve().parents[1]
ARCHIVES, PAGE = ROOT / "experiments" / "results" / "study", ROOT / "docs" / "study.md"
BEGIN = "<!-- The rest is written by `python -m experiments.study`. -->\n"
FEWER = range(100, 120)  # seeds of all parts but the first in the target task
TASKS = ("target", "clear", "packed")
STRATA = ("clear", "target", "packed")  # of part 2; the order decides the bootstrap's draws
COMPLETION, PUSHES = "completion", "pushes_per_episode"  # of evaluations
AREA, ACTIONS = "area", "actions to 90 %"  # of training
POINT = 0.01  # within which methods are equal
LAWS = {
    "uniform": "2/algo=csac,",
    "prioritised": "2/algo=csac_per,",
    "Beta to (1, 12)": "2/algo=csac_beta,",
    "Beta to (1, 4)": "2-ends/replay.end=1:4,",
    "Beta to (1, 1)": "2-ends/replay.end=1:1,",
    "Beta from (1, 12) to (0.5, 0.5)": "2-reversed/",
    "Beta to (1, 12) by reward": "2-reward/",
    "Beta (1, 2)": "2-vpg/",
}
"""Law of part 2, by which replay draws transitions, and how the names of its folders begin."""
PUSHING = {
    "labels renewed less stored": ("renewed,*", "value,*"),
    "no success bonus less one": ("*bonus=0,*", "*bonus=1,*"),
    "discount 0.5 less 0.2": ("*gamma=0.5,*", "*gamma=0.2,*"),
}
"""Row of part 4, and the groups of folders that it compares."""
LOOSE, DENSE = "0.248:0.248", "0.18:0.18"  # squares that part 7 drops blocks in, m

Groups = tuple[list[str], list[str]]  # strata of ours and of theirs: patterns of folders


class Hypothesis(NamedTuple):
    """A hypothesis and the pairs that test it."""

    title: str
    metric: str
    rows: dict[str, dict[str, Groups]]  # row -> column -> what is compared
    seeds: Sequence[int] = range(100, 150)


class Difference(NamedTuple):
    """A difference of two groups, with its verdict."""

    band: Band
    p: float  # of no difference, two-sided, from the bootstrap
    verdict: str  # equal, open, differ, or DIFFER: differs by Holm's correction, too


def hypotheses() -> Iterator[Hypothesis]:
    """Yields the hypotheses in the order of the study's parts."""
    pushing = ("csac", "csac_per", "csac_beta", "reactive", "vpg")
    methods = {
        NAMES[algo]: {
            task: ([f"1-{task}-{algo}-*/*"], [f"1-{task}-grasp_only-*/*"]) for task in TASKS
        }
        | {"the paper's network": ([f"6-paper-{algo}-*/*"], ["6-paper-grasp_only-*/*"])}
        for algo in pushing
    }
    yield Hypothesis("1: a method less grasping only", COMPLETION, methods)
    replay = {
        law: {f"{n} actions": (_laws(law, n), _laws("uniform", n)) for n in (250, 500, 1000, 2500)}
        for law in LAWS
        if law != "uniform"
    }
    yield Hypothesis("2: a law of replay less uniform replay", AREA, replay, FEWER)
    yield Hypothesis("3: CEM less other choices", AREA, _search(), FEWER)
    yield Hypothesis("4: pushes in packed scenes", PUSHES, _pushes(), FEWER)
    switches = ("sensed", "anywhere", "oblique", "noisy", "ur5", "together")
    realism = {one: {"difference": ([f"5/switch={one}"], ["5/switch=none"])} for one in switches}
    yield Hypothesis("5: nearer to the paper's robot, less the preset", COMPLETION, realism, FEWER)
    yield Hypothesis("6: more blocks, and denser", ACTIONS, _clutter(), FEWER)


def _laws(law: str, actions: int) -> list[str]:
    """Returns the folders of a law, one per task; at 2,500 actions samplers are those of part 1."""
    if LAWS[law].startswith("2/") and actions == 2500:
        algo = LAWS[law].removeprefix("2/algo=").removesuffix(",")
        return [f"1-{task}-{algo}-*/*" for task in STRATA]
    return [f"{LAWS[law]}task={task},train.actions={actions}" for task in STRATA]


def _search() -> dict[str, dict[str, Groups]]:
    offset = "3-start/cem.start=actor,net.kind=offset"
    target = "3-target/target.value=softmax,policy.place="
    pairs = {
        "trilinear maps: CEM less the best cell": (f"{target}cem", f"{target}argmax"),
        "offset maps: CEM from the actor less from both": (offset, offset.replace("actor", "both")),
        "the same less from the best cells": (offset, offset.replace("actor", "cells")),
        "the same less the best cell": (offset, "3-offset/base"),
    }
    return {row: {"difference": ([ours], [theirs])} for row, (ours, theirs) in pairs.items()}


def _pushes() -> dict[str, dict[str, Groups]]:
    folders = [
        f"4/reward.push_effect={effect},reward.success_bonus={bonus},target.gamma={gamma},task=packed"
        for effect, bonus, gamma in itertools.product(("value", "renewed"), "01", ("0.2", "0.5"))
    ]
    return {
        row: {"difference": tuple(fnmatch.filter(folders, f"4/*{pattern}") for pattern in patterns)}
        for row, patterns in PUSHING.items()
    }


def _clutter() -> dict[str, dict[str, Groups]]:
    def folders(blocks: int, *places: str) -> list[str]:
        return [f"7-{blocks}/scene.drop_extent={place}" for place in places]

    counts, both = (5, 10, 15, 20, 30), (LOOSE, DENSE)
    more = {
        f"{many} blocks less {few}": (folders(many, *both), folders(few, *both))
        for few, many in itertools.pairwise(counts)
    }
    denser = {
        f"{n} blocks, dense less loose": (folders(n, DENSE), folders(n, LOOSE)) for n in counts
    }
    return {row: {"difference": pair} for row, pair in {**more, **denser}.items()}


@functools.cache
def read(part: str) -> results.Results:
    """Reads the archive of a part, by its number, once."""
    (path,) = ARCHIVES.glob(f"{part}-*{results.ARCHIVE}")
    return results.read([path])


def values(pattern: str, metric: str, seeds: Sequence[int]) -> list[np.ndarray]:
    """Returns a metric of the runs in folders of this pattern, an array [hosts] per seed."""
    source = read(pattern[0])
    runs = source.runs if metric in (AREA, ACTIONS) else source.evaluations
    rows = [
        (run.config["seed"], _value(run, metric))
        for run in runs
        if fnmatch.fnmatch("/".join(run.path.parts[-4:-2]), pattern)
        and run.config["seed"] in seeds
        and getattr(run, "suite", IN_DISTRIBUTION) == IN_DISTRIBUTION
    ]
    owners, column = zip(*rows, strict=True)
    return statistics.by_seed(owners, column)


def _value(run: RecordedRun | results.Evaluation, metric: str) -> float:
    if isinstance(run, results.Evaluation):
        return run.metrics[metric]["value"]
    return actions_to_good(run) if metric == ACTIONS else area(run)


def area(run: RecordedRun) -> float:
    """Returns the mean success over all actions of a run."""
    return statistics.area(run.actions, run.success, float(run.actions[-1]))


def actions_to_good(run: RecordedRun) -> float:
    """Returns the actions until nine of ten grasps lift; all where they never do."""
    good = result_tables.first_good(run, run.actions)
    return float(run.actions[-1]) if good is None else good


@functools.cache
def differences() -> dict[tuple[str, str, str], Difference]:
    """Computes all differences that test hypotheses, by title, row and column."""
    tests = {
        (one.title, row, column): (
            one.metric,
            *([values(p, one.metric, one.seeds) for p in group] for group in groups),
        )
        for one in hypotheses()
        for row, columns in one.rows.items()
        for column, groups in columns.items()
    }
    p_values = [statistics.p_value(*strata) for _, *strata in tests.values()]
    return {
        place: _difference(metric, statistics.difference(*strata), p, survives)
        for (place, (metric, *strata)), p, survives in zip(
            tests.items(), p_values, statistics.holm(p_values), strict=True
        )
    }


def _difference(metric: str, band: Band, p: float, survives: bool) -> Difference:
    _, low, high, _ = band
    assert low is not None
    assert high is not None
    if not low <= 0.0 <= high:
        return Difference(band, p, "DIFFER" if survives else "differ")
    is_share = metric not in (PUSHES, ACTIONS)
    return Difference(band, p, "equal" if is_share and max(-low, high) <= POINT else "open")


def page() -> str:
    """Returns docs/study.md with the tables of today's archives."""
    protocol, _, _ = PAGE.read_text().partition(BEGIN)
    return protocol + BEGIN + "".join(map(_section, hypotheses()))


def _section(one: Hypothesis) -> str:
    rows = [
        {"": row} | {column: _shown(one, row, column) for column in columns}
        for row, columns in one.rows.items()
    ]
    unit = results.METRICS.get(one.metric, one.metric)
    unit += "" if one.metric in (PUSHES, ACTIONS) else ", points"
    return f"\n**Hypothesis {one.title}** ({unit})\n\n{result_tables.table_text(rows)}\n"


def _shown(one: Hypothesis, row: str, column: str) -> str:
    found = differences()[one.title, row, column]
    if one.metric != ACTIONS:
        return f"{result_tables.shown(found.band, '+', one.metric)} {found.verdict}"
    value, low, high = (f"{x:+,.0f}" for x in found.band[:3] if x is not None)
    return f"{value} ({low} to {high}) {found.verdict}"


if __name__ == "__main__":
    PAGE.write_text(page())
