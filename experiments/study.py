"""Writes the tables of the study into docs/study.md, from archives in experiments/results/study,
and those differences that test its hypotheses into docs/results.md.

An archive PART-NAME.tar.xz holds sweeps of a part. `csac-jax report` reads it too.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csac_jax.evaluation import statistics
from csac_jax.evaluation.statistics import Band
from csac_jax.evaluation.suites import IN_DISTRIBUTION
from csac_jax.report import comparison, results, tables
from csac_jax.report.comparison import NAMES, Curve, Score
from csac_jax.report.results import Variant
from csac_jax.report.tables import Table
from csac_jax.sweeps.grid import SWITCHES, TASKS

ROOT = Path(__file__).resolve().parents[1]
ARCHIVES = ROOT / "experiments" / "results" / "study"
PAGE, RESULTS_PAGE = ROOT / "docs" / "study.md", ROOT / "docs" / "results.md"
BEGIN = "<!-- The rest is written by `python -m experiments.study`. -->\n"
METRICS = ("completion", "grasp_success", "action_efficiency", PUSHES := "pushes_per_episode")
AREA = "area"  # under the curve of training
ACTIONS = "actions to 90 %"  # of training; all other metrics are of evaluations
SEEDS = range(100, 120)  # of all parts but the first in the target task
TITLE, NEXT_TITLE = "## The study\n", "## Summary\n"  # of a section of docs/results.md


class Part(NamedTuple):
    """What the tables of an archive show."""

    title: str
    methods: tuple[str, ...]  # in order; names of algorithms, or the settings that are changed
    pairs: tuple[tuple[str, str], ...]  # of methods or groups that are compared
    episodes: int  # of an evaluation in scenes like the training's
    hypothesis: int
    tested: int  # how many of the pairs, the first ones, test the hypothesis
    by: str  # the metric that tests it
    name: Callable[[Variant], str] = lambda variant: NAMES[variant.algo]
    groups: Mapping[str, tuple[str, ...]] = {}  # each of methods, which are its strata
    metrics: tuple[str, ...] = ("completion",)  # of evaluations, whose differences are shown
    learning: tuple[str, ...] = (AREA,)  # metrics of training, likewise
    also: tuple[str, ...] = ()  # archives with more of its runs, see `_shared`

    def suites(self) -> dict[str, str]:
        """Suite -> what it is called."""
        own = f"scenes like the training's, {self.episodes} episodes"
        return {IN_DISTRIBUTION: own, "target": "suite `target`"}


def _algorithms(title: str, episodes: int) -> Part:
    """Methods of parts 1 and 6: pushes against none, samplers against uniform replay."""
    methods = ("grasp_only", "reactive", "vpg", "csac", "csac_per", "csac_beta")
    grasp_only, reactive, vpg, csac, per, beta = names = tuple(NAMES[name] for name in methods)
    pairs = [(name, grasp_only) for name in (csac, per, beta, reactive, vpg)]
    others = (per, csac), (beta, csac), (beta, vpg)
    return Part(title, names, (*pairs, *others), episodes, 1, len(pairs), "completion")


def _changes(variant: Variant) -> str:
    """The settings of a variant that the preset has otherwise."""
    return ", ".join(" ".join(change) for change in variant.changed) or PRESET


def _pushing(variant: Variant) -> str:
    """The settings of a variant that part 4 changes, also where they are the preset's."""
    changed = dict(variant.changed)
    return _values([changed.get(name, known[-1]) for name, known in PUSHING.items()])


def _values(values: Sequence[str]) -> str:
    """The values of `PUSHING`, each after the last word of its setting's name."""
    return ", ".join(
        f"{name.split('.')[1]} {value}" for name, value in zip(PUSHING, values, strict=True)
    )


PUSHING = {
    "reward.push_effect": ("value", "renewed"),
    "reward.success_bonus": ("0.0", "1.0"),
    "target.gamma": ("0.5", "0.2"),
}
"""Setting of part 4 -> its values, the preset's last."""


def _pushes(title: str, tested: int = 0) -> Part:
    """Methods of part 4: all values of each setting together, one against the other."""
    every = tuple(itertools.product(*PUSHING.values()))
    groups = {
        f"{setting} {value}": tuple(_values(one) for one in every if one[k] == value)
        for k, (setting, values) in enumerate(PUSHING.items())
        for value in values
    }
    stored, renewed, no_bonus, bonus, far, near = groups
    pairs = ((renewed, stored), (no_bonus, bonus), (far, near))
    methods = tuple(map(_values, every))
    metrics = ("completion", PUSHES)
    return Part(title, methods, pairs, 100, 4, tested, PUSHES, _pushing, groups, metrics)


UNIFORM, LENGTH = "uniform", "2500"  # the sampler and the actions of the preset
LAWS: dict[str, tuple[str, dict[str, str]]] = {
    UNIFORM: ("csac", {}),
    "prioritised": ("csac_per", {}),
    "Beta to (1, 12)": ("csac_beta", {}),
    "Beta to (1, 4)": ("csac_beta", {"end": "1.0 4.0"}),
    "Beta to (1, 1)": ("csac_beta", {"end": "1.0 1.0"}),
    "Beta from (1, 12) to (0.5, 0.5)": ("csac_beta", {"start": "1.0 12.0", "end": "0.5 0.5"}),
    "Beta to (1, 12) by reward": ("csac_beta", {"rank_by": "reward"}),
    "Beta (1, 2)": ("csac_beta", dict.fromkeys(("start", "middle", "end"), "1.0 2.0")),
}
"""Law of part 2, by which replay draws transitions -> algorithm, and what is changed of `replay`.
Beta laws begin at (0.5, 0.5) unless told."""


def _law(variant: Variant) -> str:
    """The law of a variant of part 2, and its task."""
    changed = dict(variant.changed)
    replay = {
        name.removeprefix("replay."): value
        for name, value in changed.items()
        if name.startswith("replay.")
    }
    law = next(law for law, known in LAWS.items() if known == (variant.algo, replay))
    task = "packed" if "scene.arranged" in changed else changed.get("task.kind", "target")
    return f"{law}, {task}"


def _replay(actions: str) -> Part:
    """Laws of part 2 in all tasks together, each against uniform replay."""
    groups = {law: tuple(f"{law}, {task}" for task in TASKS) for law in LAWS}
    methods = tuple(itertools.chain.from_iterable(groups.values()))
    pairs = tuple((law, UNIFORM) for law in LAWS if law != UNIFORM)
    title, tested = f"Part 2, replay, {actions} actions", len(pairs)
    also = tuple(f"1-{task}" for task in TASKS) if actions == LENGTH else ()
    return Part(title, methods, pairs, 100, 2, tested, AREA, _law, groups, also=also)


def _switch(variant: Variant) -> str:
    """The switch of a variant of part 5."""
    changed = {name for name, _ in variant.changed}
    return next(switch for switch, settings in SWITCHES.items() if settings.keys() == changed)


def _clutter() -> Part:
    """Numbers of blocks of part 7: more against fewer, then dense against loose."""
    counts, places = (5, 10, 15, 20, 30), ("loose", "dense")
    groups = {f"{n} blocks": tuple(f"{n} blocks, {place}" for place in places) for n in counts}
    methods = tuple(itertools.chain.from_iterable(groups.values()))
    more = [(many, few) for few, many in itertools.pairwise(groups)]
    pairs = (*more, *((dense, loose) for loose, dense in groups.values()))
    title, learning = "Part 7, more blocks", (ACTIONS, AREA)
    return Part(title, methods, pairs, 100, 6, len(pairs), ACTIONS, _blocks, groups, (), learning)


def _blocks(variant: Variant) -> str:
    """How many blocks a variant of part 7 drops, and how densely."""
    changed = dict(variant.changed)
    dense = changed.get("scene.drop_extent") == "0.18 0.18"
    return f"{changed.get('scene.min_blocks', '10')} blocks, {'dense' if dense else 'loose'}"


PRESET = "preset"
CELL, MAXIMUM, OFFSET = "policy.place argmax", "target.value max", "net.kind offset"
OFFSET_CELL, OFFSET_ACTOR = f"{OFFSET}, {CELL}", f"{OFFSET}, cem.start actor"
OFFSET_CELLS = f"{OFFSET}, cem.start cells"
MAXIMUM_CELL = f"{CELL}, {MAXIMUM}"
ACTOR, CELLS = "cem.start actor", "cem.start cells"
YAWS, COARSE = "net.rotations 8", "net.subcells 1"
BOTH = f"{YAWS}, {COARSE}"
PARTS = {
    "1-target": _algorithms("Part 1, the target task", 500),
    "1-clear": _algorithms("Part 1, the table cleared", 500),
    "1-packed": _algorithms("Part 1, packed scenes cleared", 500),
    "2-replay-250": _replay("250"),
    "2-replay-500": _replay("500"),
    "2-replay-1000": _replay("1000"),
    "2-replay-2500": _replay("2500"),
    "3-continuous": Part(
        "Part 3, continuous actions",
        (
            PRESET,
            CELL,
            MAXIMUM,
            MAXIMUM_CELL,
            ACTOR,
            CELLS,
            OFFSET,
            OFFSET_ACTOR,
            OFFSET_CELLS,
            OFFSET_CELL,
            *(YAWS, f"{YAWS}, {CELL}"),
            *(COARSE, f"{COARSE}, {CELL}"),
            *(BOTH, f"{BOTH}, {CELL}"),
        ),
        (
            (PRESET, CELL),
            (OFFSET_ACTOR, OFFSET),
            (OFFSET_ACTOR, OFFSET_CELLS),
            (OFFSET_ACTOR, OFFSET_CELL),
            (MAXIMUM, MAXIMUM_CELL),
            (OFFSET, OFFSET_CELL),
            (OFFSET, PRESET),
            (PRESET, MAXIMUM),
            (ACTOR, PRESET),
            (CELLS, PRESET),
            *((changed, PRESET) for changed in (YAWS, COARSE, BOTH)),
            *((changed, f"{changed}, {CELL}") for changed in (YAWS, COARSE, BOTH)),
        ),
        100,
        hypothesis=3,
        tested=4,
        by=AREA,
        name=_changes,
    ),
    "4-target": _pushes("Part 4, pushes in the target task"),
    "4-packed": _pushes("Part 4, pushes in packed scenes", 3),
    "5-realism": Part(
        "Part 5, nearer to the paper's robot",
        tuple(SWITCHES),
        tuple((switch, "none") for switch in SWITCHES if switch != "none"),
        100,
        hypothesis=5,
        tested=len(SWITCHES) - 1,
        by="completion",
        name=_switch,
    ),
    "6-paper": _algorithms("Part 6, the paper's network in the target task", 100),
    "7-clutter": _clutter(),
}
"""Name of an archive -> what is shown of it."""
POINT = 0.01  # within which methods are equivalent


class Gap(NamedTuple):
    """How far a method or group is ahead of another by a metric."""

    method: str
    less: str
    metric: str
    where: str  # the suite, where it is not scenes like the training's
    band: Band
    told: str  # what the protocol makes of it

    @property
    def shown(self) -> str:
        """The difference with its interval, and what is told."""
        return f"{_shown(self.band, self.metric, sign='+')}: {self.told}"


class Found(NamedTuple):
    """What an archive holds of each method of a part."""

    part: Part
    curves: dict[str, Curve]
    scores: dict[str, dict[str, Score]]  # by suite

    def gaps(self, a: str, b: str) -> list[Gap]:
        """Of a pair by all metrics, training's first; none where a method has not run twice."""
        ours, theirs = (self.part.groups.get(name, (name,)) for name in (a, b))
        measured = self.scores if self.part.metrics else {}
        known = (self.curves, *measured.values())
        if not all({*ours, *theirs} <= one.keys() for one in known):
            return []
        if any(len(self.curves[name].final) < 2 for name in (*ours, *theirs)):
            return []
        found = []
        for metric in self.part.learning:
            learned = [[LEARNING[metric](self.curves[k]) for k in one] for one in (ours, theirs)]
            found.append(_gap(a, b, metric, "", *learned))
        for (suite, scores), metric in itertools.product(measured.items(), self.part.metrics):
            strata = [
                list(itertools.chain.from_iterable(scores[k].strata(metric) for k in one))
                for one in (ours, theirs)
            ]
            where = "" if suite == IN_DISTRIBUTION else suite
            found.append(_gap(a, b, metric, where, *strata))
        return found


def archives() -> dict[str, Path]:
    """The archives that there are, by name."""
    paths = {name: ARCHIVES / f"{name}{results.ARCHIVE}" for name in PARTS}
    return {name: path for name, path in paths.items() if path.exists()}


@functools.cache
def read(path: Path) -> results.Results:
    """What an archive holds, read once."""
    return results.read([path])


def page() -> str:
    """docs/study.md with the tables of today's archives."""
    protocol, _, _ = PAGE.read_text().partition(BEGIN)
    return protocol + BEGIN + "".join(map(_part, found().values()))


@functools.cache
def found() -> dict[str, Found]:
    """What each archive holds, by its name."""
    return {name: _found(PARTS[name], path) for name, path in archives().items()}


def tested() -> dict[str, list[Gap]]:
    """The differences that test hypotheses, by archive, of those that have any."""
    every = {
        name: [
            gap
            for pair in one.part.pairs[: one.part.tested]
            for gap in one.gaps(*pair)
            if (gap.metric, gap.where) == (one.part.by, "")
        ]
        for name, one in found().items()
    }
    return {name: gaps for name, gaps in every.items() if gaps}


def with_study(page: str) -> str:
    """The text of docs/results.md with the section of the study."""
    rows: Table = [
        {
            "hypothesis": str(PARTS[name].hypothesis),
            "part": PARTS[name].title.partition(", ")[2],
            "method": gap.method,
            "less": gap.less,
            "metric": results.METRICS.get(gap.metric, gap.metric),
            "difference": gap.shown,
        }
        for name, gaps in tested().items()
        for gap in gaps
    ]
    section = (
        f"{TITLE}\nThe differences that test the hypotheses of [the study](study.md), over seeds "
        "that no search has used. Written by `python -m experiments.study`.\n\n"
        f"![Differences](figures/study.png)\n\n{tables.table_text(rows)}\n\n"
    )
    before, after, rest = without_study(page).partition(NEXT_TITLE)
    return before + section + after + rest


def without_study(page: str) -> str:
    """The text of docs/results.md without that section."""
    before, _, rest = page.partition(TITLE)
    return before + "".join(rest.partition(NEXT_TITLE)[1:])


def _found(part: Part, path: Path) -> Found:
    report = comparison.build(_joined(part, path))
    scores = {
        suite: _methods(part, [score for score in report.scores if score.suite == suite])
        for suite in part.suites()
    }
    curves = _methods(part, report.curves)
    return Found(part, curves, {suite: one for suite, one in scores.items() if one})


def _joined(part: Part, path: Path) -> results.Results:
    """What the part's archive holds, and what others hold of it."""
    own = read(path)
    others = [read(archives()[name]) for name in part.also]
    runs = [run for other in others for run in other.runs if _shared(run)]
    evaluations = [one for other in others for one in other.evaluations if _shared(one)]
    return results.Results([*own.runs, *runs], [*own.evaluations, *evaluations], own.notes)


def _shared(one: results.RecordedRun | results.Evaluation) -> bool:
    """What part 1 has is of a run that part 2 asks for, too."""
    samplers = [algo for algo, changed in LAWS.values() if not changed]
    suite = IN_DISTRIBUTION if isinstance(one, results.RecordedRun) else one.suite
    asked = one.variant.algo in samplers and one.config["seed"] in SEEDS
    return asked and suite == IN_DISTRIBUTION


def _part(one: Found) -> str:
    part = one.part
    titled = {"Training": _training(one)}
    titled |= {
        f"Greedy: {part.suites()[suite]}": _greedy(scores) for suite, scores in one.scores.items()
    }
    titled["Differences"] = list(_differences(one))
    shown = {title: table for title, table in titled.items() if table}
    text = "".join(f"\n**{title}**\n\n{tables.table_text(one)}\n" for title, one in shown.items())
    return f"\n### {part.title}\n{text}"


def _methods(part: Part, found: Sequence[Any]) -> dict[str, Any]:
    """What was found by method, in their order."""
    by_name = {part.name(one.variant): one for one in found}
    assert by_name.keys() <= set(part.methods), by_name.keys() - set(part.methods)
    return {name: by_name[name] for name in part.methods if name in by_name}


def _training(one: Found) -> Table:
    rows = []
    for name, curve in one.curves.items():
        row = {"method": name, "seeds": str(len(curve.final))}
        if ACTIONS in one.part.learning:
            reached = sum(tables.first_good(run) is not None for run in curve.runs)
            row[ACTIONS] = _shown(statistics.band([_actions(curve)]), ACTIONS)
            row["seeds that reach it"] = str(reached)
        row["last 200 grasps"] = tables.shown(statistics.band([curve.final]))
        row["area under the curve"] = tables.shown(statistics.band([curve.area]))
        rows.append(row)
    return rows


def _actions(curve: Curve) -> list[np.ndarray]:
    """Actions of each run until nine of ten grasps lift; all where that never is, by seed."""
    there = [tables.first_good(run) for run in curve.runs]
    each = [run.actions[-1 if k is None else k] for run, k in zip(curve.runs, there, strict=True)]
    return curve.by_seed(each)


LEARNING = {AREA: lambda curve: curve.area, ACTIONS: _actions}
"""Metric of training -> its values of a curve, by seed."""


def _shown(band: Band, metric: str, sign: str = "") -> str:
    """A band by a metric; with a sign, as a difference."""
    if metric != ACTIONS:
        return tables.shown(band, sign, "" if metric == AREA else metric)
    value, low, high = (f"{x:{sign},.0f}" for x in band[:3] if x is not None)
    return f"{value} ({low} to {high})"


def _greedy(scores: dict[str, Score]) -> Table:
    return [
        {"method": name, "seeds": str(score.seeds)}
        | {results.METRICS[key]: tables.shown(score.band(key), metric=key) for key in METRICS}
        for name, score in scores.items()
    ]


def _differences(one: Found) -> Iterator[dict[str, str]]:
    for pair in one.part.pairs:
        if gaps := one.gaps(*pair):
            row = dict(zip(("method", "less"), pair, strict=True))
            for gap in gaps:
                where = f", suite `{gap.where}`" if gap.where else ""
                row[f"{results.METRICS.get(gap.metric, gap.metric)}{where}"] = gap.shown
            yield row


def _gap(a: str, b: str, metric: str, where: str, ours: Any, theirs: Any) -> Gap:
    """A difference of strata, and what the protocol makes of it; where they differ with the
    probability of improvement, that a seed of ours is above one of theirs. Only shares can be
    equivalent."""
    band = statistics.difference(ours, theirs)
    assert band.low is not None
    assert band.high is not None
    small = metric not in (PUSHES, ACTIONS) and max(-band.low, band.high) <= POINT
    if not band.low <= 0.0 <= band.high:
        told = "differ, by less than a point" if small else "differ"
        told += f", P {100 * statistics.improvement(ours, theirs).value:.0f} %"
    else:
        told = "equivalent" if small else "not told"
    return Gap(a, b, metric, where, band, told)


if __name__ == "__main__":
    PAGE.write_text(page())
    RESULTS_PAGE.write_text(with_study(RESULTS_PAGE.read_text()))
