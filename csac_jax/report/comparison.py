"""Recorded runs and evaluations grouped over their seeds, and how variants differ."""

import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from csac_jax.evaluation import statistics
from csac_jax.evaluation.statistics import Band
from csac_jax.report import results as recorded
from csac_jax.report.results import Evaluation, RecordedRun, Results, Variant

NAMES = {
    "grasp_only": "Grasping-only",
    "reactive": "P+G reactive",
    "vpg": "VPG",
    "csac": "CSAC",
    "csac_per": "CSAC-PER",
    "csac_beta": "CSAC-beta",
    "vpg_episodic": "VPG, episodic",
}


class Curve(NamedTuple):
    """The runs of a variant together."""

    variant: Variant
    runs: list[RecordedRun]

    @property
    def ends(self) -> list[int]:
        """Actions that runs end at, each once, rising."""
        return sorted({int(run.actions[-1]) for run in self.runs})

    @property
    def seeds(self) -> list[int]:
        """The seed of each run."""
        return seeds_of(self.runs)

    @property
    def final(self) -> list[np.ndarray]:
        """Success over the last grasps of the runs, wherever they end, by seed."""
        return self.by_seed([run.success[-1] for run in self.runs])

    @property
    def area(self) -> list[np.ndarray]:
        """Area under the curve of success over its length, up to where the shortest run ends."""
        end = self.ends[0]
        return self.by_seed([statistics.area(run.actions, run.success, end) for run in self.runs])

    def by_seed(self, values: Sequence[float] | np.ndarray) -> list[np.ndarray]:
        """Values of the runs as a stratum: an array [hosts] per seed."""
        return statistics.by_seed(self.seeds, values)

    def rate(self, above: Sequence[str], below: Sequence[str]) -> Band | None:
        """Of all training together, sum of these totals over sum of those; None where a run has
        not recorded them."""
        if not all(run.totals.keys() >= {*above, *below} for run in self.runs):
            return None
        over, under = (
            np.array([sum(run.totals[name] for name in names) for run in self.runs])
            for names in (above, below)
        )
        return statistics.band([self.by_seed(over / under)]) if under.all() else None

    def points(self) -> tuple[np.ndarray, list[Band]]:
        """Actions [m], up to where the shortest run ends, and the success there."""
        return statistics.curves([(run.actions, run.success) for run in self.runs], self.seeds)


class Score(NamedTuple):
    """The evaluations of a variant in some parts of a suite together."""

    variant: Variant
    policy: str
    suite: str
    physics: str
    robot: str
    seed: int  # of the evaluation
    episodes: int  # of each evaluation: they decide which scenes it draws; 0 where not recorded
    parts: dict[str, list[Evaluation]]

    @property
    def world(self) -> str:
        """Physics, robot and seed of the evaluation."""
        return f"{self.physics}, {self.robot}, {self.seed}"

    @property
    def most_runs(self) -> int:
        """Evaluations of the part that has most."""
        return max(map(len, self.parts.values()))

    @property
    def seeds(self) -> int:
        """Seeds of the part that has fewest."""
        return min(len(set(seeds_of(runs))) for runs in self.parts.values())

    def only(self, *parts: str) -> "Score":
        """The score in those of these parts that it has, in their order."""
        return self._replace(parts={name: self.parts[name] for name in parts if name in self.parts})

    def split(self) -> "list[Score]":
        """The score in each part by itself and, of several parts, in all."""
        each = [self.only(part) for part in self.parts]
        return [*each, self] if len(each) > 1 else each

    def band(self, metric: str) -> Band | None:
        """Mean over parts of the IQM over runs, a single value as it is; None without cases."""
        found = [_with_cases(runs, metric) for runs in self.parts.values()]
        if [len(runs) for runs in found] == [1]:
            share = found[0][0].metrics[metric]
            return Band(share["value"], share["low"], share["high"], 1)
        return statistics.band(self.strata(metric)) if all(found) else None

    def strata(self, metric: str) -> list[list[np.ndarray]]:
        """Of each part the values of the runs that have any cases: an array [hosts] per seed."""
        found = [_with_cases(runs, metric) for runs in self.parts.values()]
        return [
            statistics.by_seed(seeds_of(runs), [one.metrics[metric]["value"] for one in runs])
            for runs in found
        ]


def seeds_of(runs: Sequence[RecordedRun | Evaluation]) -> list[int]:
    """The training's seed of each; the first records name none."""
    return [one.config.get("seed", 0) for one in runs]


def _with_cases(runs: Sequence[Evaluation], metric: str) -> list[Evaluation]:
    return [one for one in runs if one.metrics.get(metric, {}).get("n")]


class Lead(NamedTuple):
    """How far CSAC-beta is ahead of another variant in training."""

    final: Band  # difference of the success at the end
    area: Band  # difference of the area under the curve
    improvement: Band  # probability that a seed of CSAC-beta ends above one of the other


class Report(NamedTuple):
    """Everything that tables and figures are made of."""

    curves: list[Curve]
    scores: list[Score]
    results: Results
    notes: list[str]


def build(results: Results) -> Report:
    """Runs and evaluations grouped over their seeds."""
    curves = [Curve(*group) for group in grouped(results.runs, lambda run: run.variant).items()]
    scores = [
        Score._make((*key, grouped(group, lambda one: one.part)))
        for key, group in grouped(results.evaluations, _scored).items()
    ]
    notes = [note for curve in curves for note in _curve_notes(curve)]
    return Report(curves, scores, results, [*results.notes, *notes])


def grouped(items: Iterable[Any], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """Key -> the items that have it, both in order of appearance."""
    found: dict[Any, list[Any]] = {}
    for item in items:
        found.setdefault(key(item), []).append(item)
    return found


def _scored(one: Evaluation) -> tuple[Any, ...]:
    """Fields of the score that an evaluation counts in."""
    learned = one.policy == "learned"  # else it does not matter what its run was trained with
    variant = one.variant if learned else Variant(one.variant.preset, one.policy, ())
    episodes = one.metrics.get("counts", {}).get("episodes", 0)
    return variant, one.policy, one.suite, *recorded.world(one.config), one.seed, episodes


def _curve_notes(curve: Curve) -> Iterator[str]:
    if len(ends := curve.ends) > 1:
        several = ", ".join(f"{end:,}" for end in ends)
        drawn = f"their curve is drawn up to {ends[0]:,}"
        yield f"{label(curve.variant)}: runs end at {several} actions; {drawn}"
    if len(curve.runs) < 2:
        yield f"{label(curve.variant)}: one run only, so its curve has no band"


def label(variant: Variant, preset: bool = True, most: int | None = None) -> str:
    """Name of a variant, with at most `most` of the settings that it changes. Without such a bound
    it is of many the name of its folder, whose command says what they are."""
    name = NAMES.get(variant.algo, variant.algo)
    changed = [f"{setting} {value}" for setting, value in variant.changed]
    if most is None and variant.is_long:
        changed = [variant.source]
    if most is not None and len(changed) > most:
        changed[most:] = [f"others ({len(changed) - most})"]
    return ", ".join([f"{name} ({variant.preset})" if preset else name, *changed])


def _pairs(items: Iterable[Any], alike: Callable[[Any], Any]) -> Iterator[tuple[Any, Any]]:
    """CSAC-beta with the fewest settings changed, and each other item that is alike."""
    for group in grouped(items, alike).values():
        betas = [item for item in group if item.variant.algo == "csac_beta"]
        ours = min(betas, key=lambda item: len(item.variant.changed), default=None)
        yield from ((ours, item) for item in group if betas and item is not ours)


def pairs(report: Report) -> Iterator[tuple[Score, Score]]:
    """CSAC-beta and another variant measured in the same scenes: in each part and in all parts of
    which both have several seeds."""
    learned = [score for score in report.scores if score.policy == "learned"]
    several = [
        s.only(*(part for part, runs in s.parts.items() if len(set(seeds_of(runs))) > 1))
        for s in learned
    ]
    alike = operator.attrgetter("variant.preset", "suite", "world", "episodes")
    for ours, other in _pairs([score for score in several if score.parts], alike):
        theirs = other.only(*ours.parts)
        yield from zip(ours.only(*theirs.parts).split(), theirs.split(), strict=True)


def compared(
    ours: Score, theirs: Score, compare: Callable[..., Band], metrics: Iterable[str]
) -> dict[str, Band]:
    """By metric, `statistics.difference` or `improvement` where all have several seeds."""
    strata = {metric: (ours.strata(metric), theirs.strata(metric)) for metric in metrics}
    return {
        metric: compare(a, b) for metric, (a, b) in strata.items() if min(map(len, (*a, *b))) > 1
    }


def leads(report: Report) -> dict[Variant, Lead]:
    """How far CSAC-beta is ahead of each variant trained as long in the same scenes and task; only
    of several seeds of both."""
    return {
        theirs.variant: _lead(ours, theirs)
        for ours, theirs in _pairs(report.curves, _trained)
        if min(len(ours.final), len(theirs.final)) > 1
    }


def _lead(ours: Curve, theirs: Curve) -> Lead:
    final = [ours.final], [theirs.final]
    area = statistics.difference([ours.area], [theirs.area])
    return Lead(statistics.difference(*final), area, statistics.improvement(*final))


def _trained(curve: Curve) -> tuple[Any, ...]:
    """What curves must share to be compared."""
    sections = ("task.", "scene.", recorded.LENGTH)
    same = [change for change in curve.variant.changed if change[0].startswith(sections)]
    return curve.variant.preset, curve.ends[0], *same
