"""Figures of a report, with matplotlib: figures 6, 7 and 9 of the paper, and variants."""

import io
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")  # no display
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from csac_jax.evaluation.statistics import Band
from csac_jax.report import comparison
from csac_jax.report.comparison import NAMES, Curve, EvaluatedPart, Report, Score, label
from csac_jax.report.results import Variant
from csac_jax.report.tables import PAPER_ACTIONS, PAPER_CASES, PAPER_TRAINING

SAMPLERS = ("csac", "csac_per", "csac_beta")
COLOURS = dict(
    zip(NAMES, ("#9c755f", "#bab0ac", "#4e79a7", "#f28e2b", "#59a14f", "#e15759"), strict=True)
)
FIGURE_9 = {"completion": "completion", "action_efficiency": "action efficiency (blocks / actions)"}
FOUR = ("cases", "target")  # suites whose parts are the four cases
MOST_SETTINGS = 3  # that a legend names
LEGEND_WIDTH = 56  # characters
INSIDE = 6  # curves whose legend has room among them
PAPER_MARK: dict[str, Any] = {"marker": "D", "markeredgecolor": "black", "linestyle": ""}


class Chart(NamedTuple):
    """A figure that was drawn."""

    name: str  # of its file
    title: str
    figure: Figure


def draw(report: Report) -> Iterator[Chart]:
    """Every figure that there are results for. Each preset has its own."""
    for preset in dict.fromkeys(curve.variant.preset for curve in report.curves):
        yield from _training([one for one in report.curves if one.variant.preset == preset])
    four = [score for score in report.scores if score.place.suite in FOUR]
    for suite, preset in dict.fromkeys(map(_suite, four)):
        title = f"The four cases (figure 9), suite {suite}, preset {preset}"
        figure = _cases([score for score in four if _suite(score) == (suite, preset)])
        yield Chart(f"four-cases-{suite}-{preset}", title, figure)


def _suite(score: Score) -> tuple[str, str]:
    return score.place.suite, score.place.variant.preset


def _training(curves: Sequence[Curve]) -> Iterator[Chart]:
    """The figures of one preset's curves."""
    preset = curves[0].variant.preset
    methods = [curve for curve in curves if curve.variant.unchanged]
    samplers = [curve for curve in methods if curve.variant.algo in SAMPLERS]
    varied = [curve for curve in curves if not curve.variant.unchanged]
    algos = {curve.variant.algo for curve in varied}
    base = [curve for curve in methods if curve.variant.algo in algos]
    if methods:
        title = f"Grasp success of the methods (figure 6), preset {preset}"
        yield Chart(f"methods-{preset}", title, success(methods))
    if len({curve.variant.algo for curve in samplers}) > 1:
        title = f"Grasp success of the samplers (figure 7), preset {preset}"
        yield Chart(f"samplers-{preset}", title, success(samplers))
    if varied:
        title = f"Grasp success of the variants, preset {preset}"
        yield Chart(f"variants-{preset}", title, success([*base, *varied]))


def success(curves: Sequence[Curve]) -> Figure:
    """Success against actions: a line and band per variant, the paper's values as marks."""
    figure, axes = plt.subplots(figsize=(8.0, 4.2), layout="constrained")
    drawn: set[str] = set()
    spare = iter(plt.get_cmap("tab20").colors)
    for curve in curves:
        algo = curve.variant.algo
        colour = next(spare) if algo in drawn or algo not in COLOURS else COLOURS[algo]
        drawn.add(algo)
        _line(axes, curve, colour)
        if curve.variant.unchanged and algo in PAPER_TRAINING:
            axes.plot(PAPER_ACTIONS, 100 * PAPER_TRAINING[algo], color=colour, **PAPER_MARK)
    axes.plot([], [], color="white", label="paper: ten blocks, 2,500 actions", **PAPER_MARK)
    axes.set(xlabel="actions", ylabel="success over the last 200 grasps, %", ylim=(0, 101))
    axes.set_xlim(left=0)
    axes.grid(alpha=0.3)
    legend: dict[str, Any] = {"title": "method (runs)", "fontsize": "small"}
    if len(curves) <= INSIDE:
        axes.legend(loc="lower right", **legend)
        return figure
    figure.set_figheight(figure.get_figheight() + 0.2 * len(curves))
    figure.legend(loc="outside lower center", ncols=2, **legend)
    return figure


def _line(axes: Axes, curve: Curve, colour: Any) -> None:
    actions, bands = curve.points()
    name = f"{_short(curve.variant)} ({len(curve.runs)})"
    axes.plot(
        actions,
        [100 * band.value for band in bands],
        color=colour,
        label=textwrap.fill(name, LEGEND_WIDTH),
    )
    limits = [
        (100 * b.low, 100 * b.high) for b in bands if b.low is not None and b.high is not None
    ]
    if len(limits) == len(actions):
        low, high = zip(*limits, strict=True)
        axes.fill_between(actions, low, high, color=colour, alpha=0.2, linewidth=0)


def _short(variant: Variant) -> str:
    return label(variant, preset=False, most=MOST_SETTINGS)


def _cases(scores: Sequence[Score]) -> Figure:
    """Completion and action efficiency by case and variant; the paper's means as lines."""
    parts = list(dict.fromkeys(score.place.part for score in scores))
    groups = dict(comparison.together(scores))
    width = 0.8 / len(groups)
    figure, panels = plt.subplots(
        1, len(FIGURE_9), figsize=(11.0, 4.2), sharey=True, layout="constrained"
    )
    for panel, (metric, title) in zip(panels, FIGURE_9.items(), strict=True):
        for index, (group, own) in enumerate(groups.items()):
            bands = {parts.index(score.place.part): score.band(metric) for score in own}
            if len(own) == len(parts):
                bands[len(parts)] = comparison.mean(own, metric)
            style = _style(group, len(own[0].evaluations), index)
            _marks(panel, bands, (index + 0.5) * width - 0.4, style)
        panel.set_xticks(range(len(parts) + 1), [*parts, "mean"])
        panel.set(title=title, ylim=(0, 104), xlim=(-0.5, len(parts) + 0.5))
        panel.grid(alpha=0.3, axis="y")
        paper = PAPER_CASES[metric] if scores[0].place.suite == "cases" else {}
        for algo, value in paper.items():
            name = f"paper, mean of the cases, {NAMES[algo]}"
            panel.axhline(100 * value, color=COLOURS[algo], linestyle="--", linewidth=1, label=name)
    panels[0].set_ylabel("%")
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, fontsize="small", loc="outside lower center", ncols=2)
    return figure


def _style(group: EvaluatedPart, runs: int, index: int) -> dict[str, Any]:
    """Name and colour of a variant's marks."""
    variant = group.variant
    name = _short(variant) if group.policy == "learned" else group.policy
    name = textwrap.fill(f"{name}, {group.physics}, {group.robot} ({runs})", LEGEND_WIDTH)
    known = variant.unchanged and variant.algo in COLOURS
    return {
        "label": name,
        "color": COLOURS[variant.algo] if known else plt.get_cmap("tab20")(index),
    }


def _marks(
    panel: Axes, bands: dict[int, Band | None], offset: float, style: dict[str, Any]
) -> None:
    """The marks of one variant: a case each, and their mean."""
    for place, band in bands.items():
        if band is None:
            continue
        error = None
        if band.low is not None and band.high is not None:
            below, above = band.value - band.low, band.high - band.value
            error = [[100 * max(below, 0.0)], [100 * max(above, 0.0)]]
        panel.errorbar(place + offset, 100 * band.value, error, fmt="o", capsize=3, **style)
        style = style | {"label": "_"}  # the legend names it once


def svg(figure: Figure) -> str:
    """The figure as the element <svg>."""
    file = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "csac_jax"}):
        figure.savefig(file, format="svg", metadata={"Date": None})
    plt.close(figure)
    text = file.getvalue()
    return text[text.index("<svg") :]


def save(figure: Figure, path: Path) -> None:
    """Writes a PNG that is the same bytes for the same figure."""
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)
