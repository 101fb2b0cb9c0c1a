"""Figures 6, 7 and 9 of the paper and of variants."""

import functools
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")  # no display
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from csac_jax.evaluation import statistics
from csac_jax.evaluation.statistics import Band
from csac_jax.report.comparison import NAMES, Curve, Report, Score, grouped, label
from csac_jax.report.tables import PAPER_ACTIONS, PAPER_CASES, PAPER_TRAINING

SAMPLERS = ("csac", "csac_per", "csac_beta")
PALETTE = ("#9c755f", "#bab0ac", "#4e79a7", "#f28e2b", "#59a14f", "#e15759", "#b07aa1")
COLOURS = dict(zip(NAMES, PALETTE, strict=True))
FIGURE_9 = {"completion": "completion", "action_efficiency": "action efficiency (blocks / actions)"}
_short = functools.partial(label, preset=False, most=3)  # name of a variant in a legend
LEGEND_WIDTH = 56  # characters
PROFILED = np.linspace(0.0, 1.0, 101)  # values that a performance profile is drawn over
INSIDE = 6  # curves whose legend has room among them
PAPER_MARK: dict[str, Any] = {"marker": "D", "markeredgecolor": "black", "linestyle": ""}


class Chart(NamedTuple):
    """A figure that was drawn."""

    name: str  # of its file
    title: str
    figure: Figure


def draw(report: Report) -> Iterator[Chart]:
    """Every figure that there are results for. Each preset has its own."""
    for preset, curves in grouped(report.curves, lambda curve: curve.variant.preset).items():
        for name, (what, chosen) in _training(curves).items():
            if chosen:
                title = f"Grasp success of {what}, preset {preset}"
                yield Chart(f"{name}-{preset}", title, success(chosen))
    four = [score for score in report.scores if score.suite in ("cases", "target")]
    by_suite = grouped(four, lambda score: (score.suite, score.variant.preset))
    for (suite, preset), scores in by_suite.items():
        title = f"The four cases (figure 9), suite {suite}, preset {preset}"
        yield Chart(f"four-cases-{suite}-{preset}", title, _cases(scores))
        several = [score for score in scores if score.policy == "learned" and score.seeds > 1]
        if len(several) > 1:
            title = f"Performance profiles, suite {suite}, preset {preset}"
            yield Chart(f"profiles-{suite}-{preset}", title, _profiles(several))


def _training(curves: Sequence[Curve]) -> dict[str, tuple[str, list[Curve]]]:
    """The figures of one preset's curves: name -> what they show, and which curves."""
    methods = [curve for curve in curves if curve.variant.unchanged]
    samplers = [curve for curve in methods if curve.variant.algo in SAMPLERS]
    several = len({curve.variant.algo for curve in samplers}) > 1
    varied = [curve for curve in curves if not curve.variant.unchanged]
    algos = {curve.variant.algo for curve in varied}
    base = [curve for curve in methods if curve.variant.algo in algos]
    return {
        "methods": ("the methods (figure 6)", methods),
        "samplers": ("the samplers (figure 7)", samplers if several else []),
        "variants": ("the variants", [*base, *varied]),
    }


def success(curves: Sequence[Curve]) -> Figure:
    """Success against actions: a line and band per variant, the paper's values as marks."""
    figure, axes = plt.subplots(figsize=(8.0, 4.2), layout="constrained")
    colours, spare = dict(COLOURS), iter(plt.get_cmap("tab20").colors)
    for curve in curves:
        algo = curve.variant.algo
        colour = colours.pop(algo, None) or next(spare)
        _line(axes, curve, colour)
        if curve.variant.unchanged and algo in PAPER_TRAINING:
            axes.plot(PAPER_ACTIONS, 100 * PAPER_TRAINING[algo], color=colour, **PAPER_MARK)
    axes.plot([], [], color="white", label="paper: ten blocks, 2,500 actions", **PAPER_MARK)
    axes.set(xlabel="actions", ylabel="success over the last 200 grasps, %", ylim=(0, 101))
    axes.set_xlim(left=0)
    axes.grid(alpha=0.3)
    if len(curves) <= INSIDE:
        axes.legend(loc="lower right", title="method (runs)", fontsize="small")
        return figure
    figure.set_figheight(figure.get_figheight() + 0.2 * len(curves))
    figure.legend(loc="outside lower center", ncols=2, title="method (runs)", fontsize="small")
    return figure


def _line(axes: Axes, curve: Curve, colour: Any) -> None:
    actions, bands = curve.points()
    value, low, high = percent(bands)
    name = f"{_short(curve.variant)} ({len(curve.runs)})"
    axes.plot(actions, value, color=colour, label=textwrap.fill(name, LEGEND_WIDTH))
    if len(curve.runs) > 1:
        axes.fill_between(actions, low, high, color=colour, alpha=0.2, linewidth=0)


def percent(bands: Sequence[Band | None]) -> np.ndarray:
    """Value, low and high, [3, bands], %; NaN where there is none."""
    rows = [(None, None, None) if band is None else band[:3] for band in bands]
    return 100 * np.array(rows, float).reshape(-1, 3).T


def _cases(scores: Sequence[Score]) -> Figure:
    """Completion and action efficiency by case and variant; the paper's means as lines."""
    figure, panels = plt.subplots(1, 2, figsize=(11.0, 4.2), sharey=True, layout="constrained")
    for panel, (metric, title) in zip(panels, FIGURE_9.items(), strict=True):
        _marks(panel, metric, scores)
        panel.set(title=title, ylim=(0, 104))
        panel.grid(alpha=0.3, axis="y")
        paper = PAPER_CASES[metric] if scores[0].suite == "cases" else {}
        for algo, value in paper.items():
            name = f"paper, mean of the cases, {NAMES[algo]}"
            panel.axhline(100 * value, color=COLOURS[algo], linestyle="--", linewidth=1, label=name)
    panels[0].set_ylabel("%")
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, fontsize="small", loc="outside lower center", ncols=2)
    return figure


def _marks(panel: Axes, metric: str, scores: Sequence[Score]) -> None:
    """A mark of each variant in each case, and in the mean of all if it has all."""
    parts = list(dict.fromkeys(part for score in scores for part in score.parts))
    places = np.arange(len(parts) + 1)
    for index, score in enumerate(scores):
        bands = [score.only(part).band(metric) for part in parts]
        bands.append(score.band(metric) if len(score.parts) == len(parts) else None)
        value, low, high = percent(bands)
        error = np.maximum([value - low, high - value], 0.0)
        offset = (index + 0.5) * 0.8 / len(scores) - 0.4
        panel.errorbar(places + offset, value, error, fmt="o", capsize=3, **_style(score, index))
    panel.set_xticks(places, [*parts, "mean"])
    panel.set_xlim(-0.5, len(parts) + 0.5)


def _profiles(scores: Sequence[Score]) -> Figure:
    """Share of the seeds above each value, mean of the parts, by variant, arXiv:2108.13264."""
    figure, panels = plt.subplots(1, 2, figsize=(11.0, 4.2), sharey=True, layout="constrained")
    for panel, (metric, title) in zip(panels, FIGURE_9.items(), strict=True):
        for index, score in enumerate(scores):
            value, low, high = percent(statistics.profile(score.strata(metric), PROFILED))
            style = _style(score, index)
            panel.plot(100 * PROFILED, value, **style)
            panel.fill_between(100 * PROFILED, low, high, color=style["color"], alpha=0.15)
        panel.set(xlabel=f"{title}, %", xlim=(0, 100), ylim=(0, 101))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("seeds above, %")
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, fontsize="small", loc="outside lower center", ncols=2)
    return figure


def _style(score: Score, index: int) -> dict[str, Any]:
    """Name and colour of a variant's marks."""
    variant = score.variant
    name = _short(variant) if score.policy == "learned" else score.policy
    name = f"{name}, {score.physics}, {score.robot} ({score.most_runs})"
    known = variant.unchanged and variant.algo in COLOURS
    colour = COLOURS[variant.algo] if known else plt.get_cmap("tab20")(index)
    return {"label": textwrap.fill(name, LEGEND_WIDTH), "color": colour}


def save(figure: Figure, path: Path) -> None:
    """Writes a PNG that is the same bytes for the same figure."""
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)
