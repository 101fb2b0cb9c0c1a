"""Recorded runs and evaluations grouped over their seeds, and how variants differ."""

import operator
from collections.abc import Callable, Iterable, Iterator
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
    def last(self) -> np.ndarray:
        """Success over the last grasps of each run, wherever it ends, [seeds]."""
        return np.array([run.success[-1] for run in self.runs])

    def points(self) -> tuple[np.ndarray, list[Band]]:
        """Actions [m], up to where the shortest run ends, and the success there."""
        return statistics.curves([(run.actions, run.success) for run in self.runs])


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

    def only(self, *parts: str) -> "Score":
        """The score in those of these parts that it has, in their order."""
        return self._replace(parts={name: self.parts[name] for name in parts if name in self.parts})

    def split(self) -> "list[Score]":
        """The score in each part by itself and, of several parts, in all."""
        each = [self.only(part) for part in self.parts]
        return [*each, self] if len(each) > 1 else each

    def band(self, metric: str) -> Band | None:
        """Mean over parts of the IQM over runs, a single value as it is; None without cases."""
        strata = self.strata(metric)
        if [len(runs) for runs in strata] == [1]:
            return Band._make((*strata[0][0], 1))
        fewest = min(map(len, strata), default=0)
        return statistics.band([runs[:, 0] for runs in strata]) if fewest else None

    def strata(self, metric: str) -> list[np.ndarray]:
        """Of each part value, low and high of the runs that have any cases, [runs, 3]."""
        found = [[one.metrics.get(metric, {}) for one in runs] for runs in self.parts.values()]
        rows = [[[e["value"], e["low"], e["high"]] for e in runs if e.get("n")] for runs in found]
        return [np.array(runs, float).reshape(-1, 3) for runs in rows]


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
    """Name of a variant, with at most `most` of the settings that it changes."""
    name = NAMES.get(variant.algo, variant.algo)
    changed = [f"{setting} {value}" for setting, value in variant.changed]
    if most is not None and len(changed) > most:
        changed[most:] = [f"others ({len(changed) - most})"]
    return ", ".join([f"{name} ({variant.preset})" if preset else name, *changed])


def _pairs(items: Iterable[Any], alike: Callable[[Any], Any]) -> Iterator[tuple[Any, Any]]:
    """CSAC-beta with the fewest settings changed, and each other item that is alike."""
    for group in grouped(items, alike).values():
        betas = [item for item in group if item.variant.algo == "csac_beta"]
        ours = min(betas, key=lambda item: len(item.variant.changed), default=None)
        yield from ((ours, item) for item in group if betas and item is not ours)


def gaps(report: Report) -> Iterator[tuple[Score, Score, dict[str, Band]]]:
    """CSAC-beta, another variant measured in the same scenes, and ours less theirs by metric: in
    each part and in all parts of which both have several seeds."""
    learned = [score for score in report.scores if score.policy == "learned"]
    several = [s.only(*(part for part in s.parts if len(s.parts[part]) > 1)) for s in learned]
    alike = operator.attrgetter("variant.preset", "suite", "world", "episodes")
    for ours, other in _pairs([score for score in several if score.parts], alike):
        theirs = other.only(*ours.parts)
        for a, b in zip(ours.only(*theirs.parts).split(), theirs.split(), strict=True):
            yield a, b, _difference(a, b)


def _difference(ours: Score, theirs: Score) -> dict[str, Band]:
    """In every metric that all evaluations have."""
    bands = {}
    for metric in recorded.METRICS:
        a, b = ([runs[:, 0] for runs in score.strata(metric)] for score in (ours, theirs))
        if min(map(len, (*a, *b))) > 1:
            bands[metric] = statistics.difference(a, b)
    return bands


def leads(report: Report) -> dict[Variant, Band]:
    """Final success of CSAC-beta less that of each variant trained as long in the same scenes and
    task; only of several seeds of both."""
    return {
        theirs.variant: statistics.difference([ours.last], [theirs.last])
        for ours, theirs in _pairs(report.curves, _trained)
        if min(len(ours.runs), len(theirs.runs)) > 1
    }


def _trained(curve: Curve) -> tuple[Any, ...]:
    """What curves must share to be compared."""
    sections = ("task.", "scene.", recorded.LENGTH)
    same = [change for change in curve.variant.changed if change[0].startswith(sections)]
    return curve.variant.preset, curve.ends[0], *same
