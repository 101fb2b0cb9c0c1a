"""Recorded runs and evaluations grouped over their seeds, and how variants differ."""

import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from csac_jax.evaluation import statistics
from csac_jax.evaluation.statistics import Band
from csac_jax.report import variants
from csac_jax.report.results import Evaluation, RecordedRun, Results
from csac_jax.report.variants import Variant, label
from csac_jax.section import require

REFERENCE = "csac_beta"  # algorithm that the others are compared with


class Curve(NamedTuple):
    """The runs of a variant together."""

    variant: Variant
    runs: list[RecordedRun]

    @property
    def ends(self) -> list[int]:
        """Returns the numbers of actions that runs end at, each once, rising."""
        return sorted({int(run.actions[-1]) for run in self.runs})

    @property
    def seeds(self) -> list[int]:
        """Returns the seed of each run."""
        return seeds_of(self.runs)

    @property
    def final(self) -> list[np.ndarray]:
        """Returns the success over the last grasps of each run, by seed."""
        return self._by_seed([run.success[-1] for run in self.runs])

    @property
    def area(self) -> list[np.ndarray]:
        """Returns the mean success over the actions that all runs have, by seed."""
        end = self.ends[0]
        return self._by_seed([statistics.area(run.actions, run.success, end) for run in self.runs])

    def _by_seed(self, values: Sequence[float] | np.ndarray) -> list[np.ndarray]:
        return statistics.by_seed(self.seeds, values)

    def rate(self, above: Sequence[str], below: Sequence[str]) -> Band | None:
        """Divides sums of totals over all of training; None where a run lacks some."""
        if not all(run.totals.keys() >= {*above, *below} for run in self.runs):
            return None
        over = np.array([sum(run.totals[name] for name in above) for run in self.runs])
        under = np.array([sum(run.totals[name] for name in below) for run in self.runs])
        return statistics.band([self._by_seed(over / under)]) if under.all() else None

    def points(self) -> tuple[np.ndarray, list[Band]]:
        """Returns actions [m], up to where the shortest run ends, and the success there."""
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
    def name(self) -> str:
        """Returns the label of a learned variant, else the policy and its changed settings."""
        if self.policy == "learned":
            return label(self.variant)
        return ", ".join([self.policy, *map(" ".join, self.variant.changed)])

    @property
    def world(self) -> str:
        """Returns physics, robot and seed of the evaluation."""
        return f"{self.physics}, {self.robot}, {self.seed}"

    @property
    def most_runs(self) -> int:
        """Returns the number of evaluations of the part that has most."""
        return max(map(len, self.parts.values()))

    @property
    def seeds(self) -> int:
        """Returns the number of seeds of the part that has fewest."""
        return min(len(set(seeds_of(runs))) for runs in self.parts.values())

    def only(self, *parts: str) -> "Score":
        """Returns the score in those of these parts that it has."""
        return self._replace(parts={name: self.parts[name] for name in parts if name in self.parts})

    def split(self) -> "list[Score]":
        """Returns the score in each part and, if there are several, in all."""
        single = [self.only(part) for part in self.parts]
        return [*single, self] if len(single) > 1 else single

    def band(self, metric: str) -> Band | None:
        """Computes the mean over parts of the IQM over runs; None without cases. A single value
        keeps the interval of its episodes."""
        counted = [_with_cases(runs, metric) for runs in self.parts.values()]
        if [len(runs) for runs in counted] == [1]:
            share = counted[0][0].metrics[metric]
            return Band(share["value"], share["low"], share["high"], 1)
        return statistics.band(self.strata(metric)) if all(counted) else None

    def strata(self, metric: str) -> list[list[np.ndarray]]:
        """Returns the values of the runs with cases: per part and seed an array [hosts]."""
        return [
            statistics.by_seed(seeds_of(runs), [one.metrics[metric]["value"] for one in runs])
            for runs in (_with_cases(runs, metric) for runs in self.parts.values())
        ]


def seeds_of(runs: Sequence[RecordedRun | Evaluation]) -> list[int]:
    """Returns the training seed of each; the first records name none."""
    return [one.config.get("seed", 0) for one in runs]


def _with_cases(runs: Sequence[Evaluation], metric: str) -> list[Evaluation]:
    return [one for one in runs if one.metrics.get(metric, {}).get("n")]


class ResultReport(NamedTuple):
    """The data of all tables and figures."""

    curves: list[Curve]
    scores: list[Score]
    results: Results
    notes: list[str]
    reference: str  # algorithm that the others are compared with


def build(results: Results, reference: str | None = None) -> ResultReport:
    """Groups runs and evaluations by seeds. Raises SettingsError for an unknown reference."""
    curves = [Curve(*group) for group in grouped(results.runs, lambda run: run.variant).items()]
    scores = [
        Score._make((*key, grouped(group, lambda one: one.part)))
        for key, group in grouped(results.evaluations, _score_key).items()
    ]
    algorithms = sorted({one.variant.algo for one in (*curves, *scores)})
    known = ", ".join(algorithms) or "none"
    require(reference in (None, *algorithms), f"no result of {reference}; there are: {known}")
    notes = [*results.notes, *(note for curve in curves for note in _curve_notes(curve))]
    return ResultReport(curves, scores, results, notes, reference or REFERENCE)


def grouped(items: Iterable[Any], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """Groups items by their key, both in order of appearance."""
    groups: dict[Any, list[Any]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def _score_key(one: Evaluation) -> tuple[Any, ...]:
    """Returns the fields of the score that an evaluation counts in."""
    variant = one.variant
    if one.policy != "learned":  # its run's training does not matter
        world = tuple(change for change in variant.changed if change[0].startswith(variants.WORLD))
        variant = Variant(variant.preset, one.policy, world)
    episodes = one.metrics.get("counts", {}).get("episodes", 0)
    return variant, one.policy, one.suite, *variants.world(one.config), one.seed, episodes


def _curve_notes(curve: Curve) -> Iterator[str]:
    name, ends = label(curve.variant), [f"{end:,}" for end in curve.ends]
    if len(ends) > 1:
        yield f"{name}: runs end at {', '.join(ends)} actions; their curve is drawn up to {ends[0]}"
    if len(curve.runs) < 2:
        yield f"{name}: one run only, so its curve has no band"


def _pairs(
    items: Iterable[Any], reference: str, alike: Callable[[Any], Any]
) -> Iterator[tuple[Any, Any]]:
    """Yields the reference with the fewest changes, and each other item that is alike."""
    for group in grouped(items, alike).values():
        candidates = [item for item in group if item.variant.algo == reference]
        ours = min(candidates, key=lambda item: len(item.variant.changed), default=None)
        yield from ((ours, item) for item in group if candidates and item is not ours)


def pairs(report: ResultReport) -> Iterator[tuple[Score, Score]]:
    """Yields the reference and another variant, in each part and in all parts: both measured in the
    same scenes, with several seeds."""
    several = [
        score.only(*(part for part, runs in score.parts.items() if len(set(seeds_of(runs))) > 1))
        for score in report.scores
        if score.policy == "learned"
    ]
    alike = operator.attrgetter("variant.preset", "suite", "world", "episodes")
    measured = [score for score in several if score.parts]
    for ours, other in _pairs(measured, report.reference, alike):
        theirs = other.only(*ours.parts)
        yield from zip(ours.only(*theirs.parts).split(), theirs.split(), strict=True)


def curve_pairs(report: ResultReport) -> Iterator[tuple[Curve, Curve]]:
    """Yields the reference and another variant that was trained alike, of several seeds both."""
    for pair in _pairs(report.curves, report.reference, _training_key):
        if all(len(curve.final) > 1 for curve in pair):
            yield pair


def compared(
    ours: Score, theirs: Score, compare: Callable[..., Band], metrics: Iterable[str]
) -> dict[str, Band]:
    """Compares each metric of which all parts have several seeds."""
    strata = {metric: (ours.strata(metric), theirs.strata(metric)) for metric in metrics}
    return {
        metric: compare(a, b) for metric, (a, b) in strata.items() if min(map(len, (*a, *b))) > 1
    }


def _training_key(curve: Curve) -> tuple[Any, ...]:
    """Returns what curves must share to be compared: length, scenes and task."""
    sections = ("task.", "scene.", variants.LENGTH)
    same = [change for change in curve.variant.changed if change[0].startswith(sections)]
    return curve.variant.preset, curve.ends[0], *same
