"""Writes the tables of the study into docs/study.md, from archives in experiments/results/study.

An archive PART-NAME.tar.xz holds sweeps of a part. `csac-jax report` reads it too.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from csac_jax.evaluation import statistics
from csac_jax.evaluation.suites import IN_DISTRIBUTION
from csac_jax.report import comparison, results, tables
from csac_jax.report.comparison import NAMES, Curve, Score
from csac_jax.report.results import Variant
from csac_jax.report.tables import Table
from csac_jax.sweeps.grid import SWITCHES, TASKS

ROOT = Path(__file__).resolve().parents[1]
ARCHIVES = ROOT / "experiments" / "results" / "study"
PAGE = ROOT / "docs" / "study.md"
BEGIN = "<!-- The rest is written by `python -m experiments.study`. -->\n"
METRICS = ("completion", "grasp_success", "action_efficiency", PUSHES := "pushes_per_episode")


class Part(NamedTuple):
    """What the tables of an archive show."""

    title: str
    methods: tuple[str, ...]  # in order; names of algorithms, or the settings that are changed
    pairs: tuple[tuple[str, str], ...]  # of methods or groups that are compared
    episodes: int  # of an evaluation in scenes like the training's
    name: Callable[[Variant], str] = lambda variant: NAMES[variant.algo]
    groups: Mapping[str, tuple[str, ...]] = {}  # each of methods, which are its strata
    metrics: tuple[str, ...] = ("completion",)  # whose differences are shown, beside the area's

    def suites(self) -> dict[str, str]:
        """Suite -> what it is called."""
        own = f"scenes like the training's, {self.episodes} episodes"
        return {IN_DISTRIBUTION: own, "target": "suite `target`"}


def _algorithms(title: str) -> Part:
    """Methods of part 1: pushes against none, samplers against uniform replay."""
    methods = ("grasp_only", "reactive", "vpg", "csac", "csac_per", "csac_beta")
    grasp_only, reactive, vpg, csac, per, beta = names = tuple(NAMES[name] for name in methods)
    pairs = [(name, grasp_only) for name in (csac, per, beta, reactive, vpg)]
    return Part(title, names, (*pairs, (per, csac), (beta, csac), (beta, vpg)), 500)


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


def _pushes(title: str) -> Part:
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
    return Part(title, methods, pairs, 100, _pushing, groups, ("completion", PUSHES))


LAWS = (
    "uniform",
    "prioritised",
    "Beta to (1, 12)",
    "Beta to (1, 4)",
    "Beta to (1, 1)",
    "Beta from (1, 12) to (0.5, 0.5)",
    "Beta to (1, 12) by reward",
    "Beta (1, 2)",
)
"""Laws of part 2, by which replay draws transitions. Beta laws begin at (0.5, 0.5) unless told."""


def _law(variant: Variant) -> str:
    """The law of a variant of part 2, and its task."""
    changed = dict(variant.changed)
    places = [changed.get(f"replay.{place}") for place in ("start", "end")]
    other = {
        (None, "1.0 4.0"): "Beta to (1, 4)",
        (None, "1.0 1.0"): "Beta to (1, 1)",
        ("1.0 12.0", "0.5 0.5"): "Beta from (1, 12) to (0.5, 0.5)",
        ("1.0 2.0", "1.0 2.0"): "Beta (1, 2)",
    }
    if "replay.rank_by" in changed:
        law = "Beta to (1, 12) by reward"
    elif any(places):
        law = other[places[0], places[1]]
    else:
        law = {"csac": "uniform", "csac_per": "prioritised", "csac_beta": LAWS[2]}[variant.algo]
    task = "packed" if "scene.arranged" in changed else changed.get("task.kind", "target")
    return f"{law}, {task}"


def _replay(actions: str) -> Part:
    """Laws of part 2 in all tasks together, each against uniform replay."""
    groups = {law: tuple(f"{law}, {task}" for task in TASKS) for law in LAWS}
    methods = tuple(itertools.chain.from_iterable(groups.values()))
    pairs = tuple((law, LAWS[0]) for law in LAWS[1:])
    return Part(f"Part 2, replay, {actions} actions", methods, pairs, 100, _law, groups)


def _switch(variant: Variant) -> str:
    """The switch of a variant of part 5."""
    changed = {name for name, _ in variant.changed}
    return next(switch for switch, settings in SWITCHES.items() if settings.keys() == changed)


PRESET = "preset"
CELL, MAXIMUM, OFFSET = "policy.place argmax", "target.value max", "net.kind offset"
OFFSET_CELL, OFFSET_ACTOR = f"{OFFSET}, {CELL}", f"{OFFSET}, cem.start actor"
OFFSET_CELLS = f"{OFFSET}, cem.start cells"
MAXIMUM_CELL = f"{CELL}, {MAXIMUM}"
ACTOR, CELLS = "cem.start actor", "cem.start cells"
YAWS, COARSE = "net.rotations 8", "net.subcells 1"
BOTH = f"{YAWS}, {COARSE}"
PARTS = {
    "1-target": _algorithms("Part 1, the target task"),
    "1-clear": _algorithms("Part 1, the table cleared"),
    "1-packed": _algorithms("Part 1, packed scenes cleared"),
    "2-replay-250": _replay("250"),
    "2-replay-500": _replay("500"),
    "3-continuous": Part(
        "Part 3, continuous actions",
        (
            *(
                PRESET,
                CELL,
                MAXIMUM,
                MAXIMUM_CELL,
                ACTOR,
                CELLS,
                OFFSET,
                OFFSET_ACTOR,
                OFFSET_CELLS,
            ),
            *(
                OFFSET_CELL,
                YAWS,
                f"{YAWS}, {CELL}",
                COARSE,
                f"{COARSE}, {CELL}",
                BOTH,
                f"{BOTH}, {CELL}",
            ),
        ),
        (
            (PRESET, CELL),
            (MAXIMUM, MAXIMUM_CELL),
            (OFFSET_ACTOR, OFFSET),
            (OFFSET_ACTOR, OFFSET_CELL),
            (OFFSET, OFFSET_CELL),
            (OFFSET, PRESET),
            (PRESET, MAXIMUM),
            (ACTOR, PRESET),
            (CELLS, PRESET),
            (OFFSET_CELLS, OFFSET_ACTOR),
            *((changed, PRESET) for changed in (YAWS, COARSE, BOTH)),
            *((changed, f"{changed}, {CELL}") for changed in (YAWS, COARSE, BOTH)),
        ),
        100,
        _changes,
    ),
    "4-target": _pushes("Part 4, pushes in the target task"),
    "4-packed": _pushes("Part 4, pushes in packed scenes"),
    "5-realism": Part(
        "Part 5, what is nearer to the paper's robot",
        tuple(SWITCHES),
        tuple((switch, "none") for switch in SWITCHES if switch != "none"),
        100,
        _switch,
    ),
}
"""Name of an archive -> what is shown of it."""
POINT = 0.01  # within which methods are equivalent


def archives() -> dict[str, Path]:
    """The archives that there are, by name."""
    paths = {name: ARCHIVES / f"{name}{results.ARCHIVE}" for name in PARTS}
    return {name: path for name, path in paths.items() if path.exists()}


def page() -> str:
    """docs/study.md with the tables of today's archives."""
    protocol, _, _ = PAGE.read_text().partition(BEGIN)
    return protocol + BEGIN + "".join(_part(*one) for one in archives().items())


def _part(name: str, path: Path) -> str:
    part, report = PARTS[name], comparison.build(results.read([path]))
    curves = _methods(part, report.curves)
    scores = {
        suite: _methods(part, [score for score in report.scores if score.suite == suite])
        for suite in part.suites()
    }
    scores = {suite: found for suite, found in scores.items() if found}
    titled = {"Training": _training(curves)}
    titled |= {f"Greedy: {part.suites()[suite]}": _greedy(found) for suite, found in scores.items()}
    titled["Differences"] = list(_differences(part, curves, scores))
    text = "".join(f"\n**{title}**\n\n{tables.table_text(one)}\n" for title, one in titled.items())
    return f"\n### {part.title}\n{text}"


def _methods(part: Part, found: Sequence[Any]) -> dict[str, Any]:
    """What was found by method, in their order."""
    by_name = {part.name(one.variant): one for one in found}
    assert by_name.keys() <= set(part.methods), by_name.keys() - set(part.methods)
    return {name: by_name[name] for name in part.methods if name in by_name}


def _training(curves: dict[str, Curve]) -> Table:
    return [
        {
            "method": name,
            "seeds": str(len(curve.final)),
            "last 200 grasps": tables.shown(statistics.band([curve.final])),
            "area under the curve": tables.shown(statistics.band([curve.area])),
        }
        for name, curve in curves.items()
    ]


def _greedy(scores: dict[str, Score]) -> Table:
    return [
        {"method": name, "seeds": str(score.seeds)}
        | {results.METRICS[key]: tables.shown(score.band(key), metric=key) for key in METRICS}
        for name, score in scores.items()
    ]


def _differences(
    part: Part, curves: dict[str, Curve], scores: dict[str, dict[str, Score]]
) -> Iterator[dict[str, str]]:
    for a, b in part.pairs:
        ours, theirs = (part.groups.get(name, (name,)) for name in (a, b))
        if all({*ours, *theirs} <= known.keys() for known in (curves, *scores.values())):
            row = {"method": a, "less": b}
            row["area"] = _verdict(*([curves[k].area for k in one] for one in (ours, theirs)))
            for (suite, known), metric in itertools.product(scores.items(), part.metrics):
                where = "" if suite == IN_DISTRIBUTION else f", suite `{suite}`"
                strata = [[known[k].strata(metric) for k in one] for one in (ours, theirs)]
                row[f"{results.METRICS[metric]}{where}"] = _verdict(
                    *(list(itertools.chain.from_iterable(one)) for one in strata), metric
                )
            yield row


def _verdict(ours: Any, theirs: Any, metric: str = "") -> str:
    """A difference of strata, and what the protocol makes of it; where they differ with the
    probability of improvement, that a seed of ours is above one of theirs. Only shares can be
    equivalent."""
    gap = statistics.difference(ours, theirs)
    assert gap.low is not None
    assert gap.high is not None
    small = metric != PUSHES and max(-gap.low, gap.high) <= POINT
    if not gap.low <= 0.0 <= gap.high:
        told = "differ, by less than a point" if small else "differ"
        told += f", P {100 * statistics.improvement(ours, theirs).value:.0f} %"
    else:
        told = "equivalent" if small else "not told"
    return f"{tables.shown(gap, sign='+', metric=metric)}: {told}"


if __name__ == "__main__":
    PAGE.write_text(page())
