"""Recorded runs and evaluations grouped over their seeds, and how variants differ."""

from collections.abc import Callable, Iterable, Sequence
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
}
METRICS = {
    "grasp_success": "grasp success",
    "completion": "completion",
    "completion_reachable": "completion, reachable blocks",
    "action_efficiency": "blocks / actions",
    "action_efficiency_completed": "blocks / actions, completed episodes",
}
"""Metric -> its title in tables; `evaluation.metrics` defines them."""


class Curve(NamedTuple):
    """The runs of a variant together."""

    variant: Variant
    runs: list[RecordedRun]

    @property
    def ends(self) -> list[int]:
        """Actions that runs end at, each once, rising."""
        return sorted({int(run.actions[-1]) for run in self.runs})

    @property
    def last(self) -> np.ndarray:
        """Success over the last grasps of each run, wherever it ends, [seeds]."""
        return np.array([run.success[-1] for run in self.runs])

    @property
    def final(self) -> Band:
        """IQM of `last`."""
        return statistics.band([self.last])

    def points(self) -> tuple[np.ndarray, list[Band]]:
        """Actions [m], up to where the shortest run ends, and the success there."""
        return statistics.curves([(run.actions, run.success) for run in self.runs])


class EvaluatedPart(NamedTuple):
    """What the evaluations of one score have in common."""

    variant: Variant
    policy: str
    suite: str
    part: str
    physics: str
    robot: str
    seed: int  # of the evaluation
    episodes: int  # of each evaluation: they decide which scenes it draws; 0 where not recorded

    @property
    def world(self) -> str:
        """Physics, robot and seed of the evaluation."""
        return f"{self.physics}, {self.robot}, {self.seed}"


class Score(NamedTuple):
    """The evaluations of a variant in one part of a suite together."""

    place: EvaluatedPart
    evaluations: list[Evaluation]

    def band(self, metric: str) -> Band | None:
        """IQM of the runs; of one run its own value and interval; None where there are no cases."""
        entries = self._entries(metric)
        if len(entries) == 1:
            return Band(entries[0]["value"], entries[0]["low"], entries[0]["high"], 1)
        return statistics.band([self.values(metric)]) if entries else None

    def values(self, metric: str) -> np.ndarray:
        """The values of the runs that have any cases."""
        return np.array([entry["value"] for entry in self._entries(metric)])

    def _entries(self, metric: str) -> list[recorded.Json]:
        found = [one.metrics.get(metric, {}) for one in self.evaluations]
        return [entry for entry in found if entry.get("n")]


class Gap(NamedTuple):
    """CSAC-beta less another variant in some parts of a suite; several seeds of both."""

    ours: Variant  # CSAC-beta with the fewest settings changed
    theirs: Variant
    suite: str
    parts: tuple[str, ...]
    world: str
    bands: dict[str, Band]  # metric -> ours less theirs


class Report(NamedTuple):
    """Everything that tables and figures are made of."""

    curves: list[Curve]
    scores: list[Score]
    results: Results
    notes: list[str]


def build(results: Results) -> Report:
    """Runs and evaluations grouped over their seeds."""
    curves = [
        Curve(*group)
        for group in _grouped(results.runs, lambda run: recorded.variant(run.config)).items()
    ]
    scores = [Score(*group) for group in _grouped(results.evaluations, _place).items()]
    notes = [note for curve in curves for note in _curve_notes(curve)]
    return Report(curves, scores, results, [*results.notes, *notes])


def _grouped(items: Iterable[Any], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    found: dict[Any, list[Any]] = {}
    for item in items:
        found.setdefault(key(item), []).append(item)
    return found


def _place(one: Evaluation) -> EvaluatedPart:
    variant = recorded.variant(one.config)
    if one.policy != "learned":  # what its run was trained with does not matter
        variant = Variant(variant.preset, one.policy, ())
    episodes = one.metrics.get("counts", {}).get("episodes", 0)
    world = recorded.world(one.config)
    return EvaluatedPart(variant, one.policy, one.suite, one.part, *world, one.seed, episodes)


def _curve_notes(curve: Curve) -> Iterable[str]:
    if len(ends := curve.ends) > 1:
        several = ", ".join(f"{end:,}" for end in ends)
        drawn = f"their curve is drawn up to {ends[0]:,}"
        yield f"{label(curve.variant)}: runs end at {several} actions; {drawn}"
    if len(curve.runs) < 2:
        yield f"{label(curve.variant)}: one run only, so its curve has no band"


def label(variant: Variant, preset: bool = True, most: int | None = None) -> str:
    """Name of a variant, with at most `most` of the settings that it changes."""
    name = NAMES.get(variant.algo, variant.algo)
    changed = [f"{setting} {value}" for setting, value in variant.changed]
    if most is not None and len(changed) > most:
        changed[most:] = [f"others ({len(changed) - most})"]
    return ", ".join([f"{name} ({variant.preset})" if preset else name, *changed])


def together(scores: Iterable[Score]) -> Iterable[tuple[EvaluatedPart, list[Score]]]:
    """Scores that differ in their part alone, with what they share."""
    return _grouped(scores, lambda score: score.place._replace(part="")).items()


def mean(scores: Sequence[Score], metric: str) -> Band | None:
    """Mean over parts of the IQM over runs; None where a part has no value."""
    strata = [score.values(metric) for score in scores]
    return statistics.band(strata) if all(len(stratum) for stratum in strata) else None


def gaps(report: Report) -> list[Gap]:
    """CSAC-beta less every variant measured in the same scenes, in each part and in all parts.

    Only of several seeds of both.
    """
    several = [
        one for one in report.scores if one.place.policy == "learned" and len(one.evaluations) > 1
    ]
    found: list[Gap] = []
    for scores in _grouped(several, _scenes).values():
        by_variant = _grouped(scores, lambda score: score.place.variant)
        first = min(by_variant, key=lambda one: (one.algo != "csac_beta", len(one.changed)))
        others = [one for one in by_variant if one != first and first.algo == "csac_beta"]
        for other in others:
            found += _gaps(first, other, by_variant[first], by_variant[other])
    return found


def _scenes(score: Score) -> tuple[Any, ...]:
    """What scores must share to be compared."""
    its = score.place
    return its.variant.preset, its.suite, its.world, its.episodes


def _gaps(ours: Variant, theirs: Variant, a: list[Score], b: list[Score]) -> Iterable[Gap]:
    """The difference in each part that both were measured in, then over these parts."""
    of = {score.place.part: score for score in b}
    pairs = [(score, of[score.place.part]) for score in a if score.place.part in of]
    for shared in [[pair] for pair in pairs] + ([pairs] if len(pairs) > 1 else []):
        place = shared[0][0].place
        parts = tuple(score.place.part for score, _ in shared)
        yield Gap(ours, theirs, place.suite, parts, place.world, _bands(shared))


def _bands(pairs: Sequence[tuple[Score, Score]]) -> dict[str, Band]:
    """The difference in every metric that all evaluations have."""
    bands = {}
    for metric in METRICS:
        ours, theirs = ([one.values(metric) for one in side] for side in zip(*pairs, strict=True))
        if min(len(values) for values in (*ours, *theirs)) > 1:
            bands[metric] = statistics.difference(ours, theirs)
    return bands


def lead(report: Report, curve: Curve) -> Band | None:
    """Final success of CSAC-beta with the fewest settings changed, less that of another variant.

    Only of variants trained as long in the same scenes and task, with several seeds of both.
    """
    alike = [
        one
        for one in report.curves
        if _trained(one) == _trained(curve) and one.variant.algo == "csac_beta"
    ]
    first = min(alike, key=lambda one: len(one.variant.changed), default=curve)
    if first is curve or min(len(first.runs), len(curve.runs)) < 2:
        return None
    return statistics.difference([first.last], [curve.last])


def _trained(curve: Curve) -> tuple[Any, ...]:
    """What curves must share to be compared."""
    sections = ("task.", "scene.", recorded.LENGTH)
    same = [change for change in curve.variant.changed if change[0].startswith(sections)]
    return curve.variant.preset, curve.ends[0], *same
