"""Methods by task and number of actions: the table of an evaluated sweep."""

import dataclasses
from typing import NamedTuple

from csac_jax.evaluation import statistics
from csac_jax.report import result_tables
from csac_jax.report.comparison import Curve, ResultReport, Score
from csac_jax.report.results import METRICS
from csac_jax.report.variants import label

AXES = ("train.actions", "task.kind", "scene.packed_fraction")  # settings that are columns here
SCENES = {0.0: "clear", 1.0: "packed"}  # name of the clearing task by the share of packed scenes
PANELS = {name: METRICS[name] for name in ("grasp_success", "completion", "action_efficiency")}
"""Metrics of the figure, top down, and their titles."""


class StudyRow(NamedTuple):
    """The result of one method on one task after so many actions."""

    task: str
    actions: int
    method: str
    score: Score
    curve: Curve | None  # of its training, if that was recorded


def rows(report: ResultReport) -> list[StudyRow]:
    """Lists the evaluated methods by task, actions and name."""
    trained = {curve.variant: curve for curve in report.curves}
    learned = [score for score in report.scores if score.policy == "learned"]
    unsorted = (_row(score, trained.get(score.variant)) for score in learned)
    return sorted(unsorted, key=lambda row: row[:3])


def _row(score: Score, curve: Curve | None) -> StudyRow:
    (first, *_), *_ = score.parts.values()
    scene, task, train = (first.config.get(name, {}) for name in ("scene", "task", "train"))
    name = SCENES.get(scene.get("packed_fraction", 0.0), "partly packed")
    if task.get("kind") == "target":
        name = "target" if name == "clear" else f"target, {name}"
    changed = tuple(change for change in score.variant.changed if change[0] not in AXES)
    method = label(dataclasses.replace(score.variant, changed=changed), preset=False)
    return StudyRow(name, train.get("actions", 0), method, score, curve)


def table(report: ResultReport) -> result_tables.ResultTable:
    """Builds a row per task, actions and method."""
    return [_cells(row) for row in rows(report)]


def _cells(row: StudyRow) -> dict[str, str]:
    final = row.curve and statistics.band([row.curve.final])
    area = row.curve and statistics.band([row.curve.area])
    return {
        "task": row.task,
        "actions": f"{row.actions:,}",
        "method": row.method,
        "seeds": str(row.score.seeds),
        f"training: {result_tables.LAST}": result_tables.shown(final),
        f"training: {result_tables.AREA}": result_tables.shown(area),
        **result_tables.metric_cells(row.score),
    }
