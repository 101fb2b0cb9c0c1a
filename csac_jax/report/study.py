"""Methods by task and number of actions: one table and one figure of an evaluated sweep."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from csac_jax.evaluation import statistics
from csac_jax.report import curves, results, tables
from csac_jax.report.comparison import Curve, Report, Score, grouped, label, seeds_of

AXES = ("train.actions", "task.kind", "scene.arranged")  # settings that are columns here
SCENES = {0.0: "clear", 1.0: "packed"}  # name of the clearing task by the share of packed scenes
PANELS = ("grasp_success", "completion", "action_efficiency")  # of the figure, top down


class Cell(NamedTuple):
    """What one method reached on one task with so many actions."""

    task: str
    actions: int
    method: str
    algo: str
    score: Score
    curve: Curve | None  # of its training, if that was recorded


def cells(report: Report) -> list[Cell]:
    """The evaluated methods by task, actions and name."""
    trained = {curve.variant: curve for curve in report.curves}
    learned = [score for score in report.scores if score.policy == "learned"]
    found = [_cell(score, trained.get(score.variant)) for score in learned]
    return sorted(found, key=lambda cell: (cell.task, cell.actions, cell.method))


def _cell(score: Score, curve: Curve | None) -> Cell:
    (first, *_), *_ = score.parts.values()
    scene, task, train = (first.config.get(name, {}) for name in ("scene", "task", "train"))
    name = SCENES.get(scene.get("arranged", 0.0), "partly packed")
    if task.get("kind") == "target":
        name = "target" if name == "clear" else f"target, {name}"
    changed = tuple(change for change in score.variant.changed if change[0] not in AXES)
    method = label(dataclasses.replace(score.variant, changed=changed), preset=False)
    return Cell(name, train.get("actions", 0), method, score.variant.algo, score, curve)


def table(report: Report) -> tables.Table:
    """A row per task, actions and method; methods of one task and length stand together."""
    return [_row(cell) for cell in cells(report)]


def _row(cell: Cell) -> dict[str, str]:
    seeds = sorted({seed for runs in cell.score.parts.values() for seed in seeds_of(runs)})
    final = cell.curve and statistics.band([cell.curve.final])
    area = cell.curve and statistics.band([cell.curve.area])
    return {
        "task": cell.task,
        "actions": f"{cell.actions:,}",
        "method": cell.method,
        "seeds": str(len(seeds)),
        f"training: {tables.LAST}": tables.shown(final),
        f"training: {tables.AREA}": tables.shown(area),
    } | {
        title: tables.shown(cell.score.band(metric), metric=metric)
        for metric, title in results.METRICS.items()
    }


def figure(report: Report) -> Figure:
    """Metrics of the final policies against actions: a column per task, a line per method."""
    by_task = grouped(cells(report), lambda cell: cell.task)
    size = (1.0 + 3.6 * len(by_task), 2.6 * len(PANELS))
    drawn, panels = plt.subplots(
        len(PANELS),
        len(by_task),
        figsize=size,
        sharex=True,
        sharey="row",
        squeeze=False,
        layout="constrained",
    )
    for column, (task, found) in enumerate(by_task.items()):
        for row, metric in enumerate(PANELS):
            _lines(panels[row, column], metric, found)
        panels[0, column].set_title(task)
        panels[-1, column].set_xlabel("actions of training")
    for row, metric in enumerate(PANELS):
        panels[row, 0].set_ylabel(f"{results.METRICS[metric]}, %")
    handles = panels[0, 0].get_legend_handles_labels()
    drawn.legend(*handles, fontsize="small", loc="outside lower center", ncols=3)
    return drawn


def _lines(panel: Axes, metric: str, found: Sequence[Cell]) -> None:
    spare = itertools.cycle(curves.PALETTE)
    methods = grouped(found, lambda cell: cell.method)
    plain = [name for name in methods if "," not in name]
    for method, own in methods.items():
        known = curves.COLOURS.get(own[0].algo) if method in plain else None
        actions = [cell.actions for cell in own]
        value, low, high = curves.percent([cell.score.band(metric) for cell in own])
        colour = known or next(spare)
        panel.plot(actions, value, "o-", color=colour, label=method)
        panel.fill_between(actions, low, high, color=colour, alpha=0.15, linewidth=0)
    panel.grid(alpha=0.3)
