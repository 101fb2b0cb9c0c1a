"""The figures of a report, with matplotlib: figures 6, 7 and 9 of the paper, and whatever else was
varied."""

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib

matplotlib.use("Agg")  # no display
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from csac_jax.evaluation import statistics
from csac_jax.report import report as reporting
from csac_jax.report.report import (
    NAMES,
    PAPER_ACTIONS,
    PAPER_CASES,
    PAPER_TRAINING,
    Curve,
    Report,
    Score,
)
from csac_jax.report.results import Variant

SAMPLERS = ("csac", "csac_per", "csac_beta")
COLOURS = dict(
    zip(NAMES, ("#9c755f", "#bab0ac", "#4e79a7", "#f28e2b", "#59a14f", "#e15759"), strict=True)
)
FIGURE_9 = {"completion": "completion", "action_efficiency": "action efficiency (blocks / actions)"}
NAMED = 3  # settings that a legend names
WIDE = 56  # characters of a line of a legend
BESIDE = 6  # curves whose legend has room among them
FOUR = ("cases", "target")  # suites whose parts are the four cases


class Chart(NamedTuple):
    """A figure that was drawn."""

    name: str  # of its file
    title: str
    svg: str


def draw(report: Report) -> list[Chart]:
    """Every figure that there are results for."""
    return [Chart(name, title, _svg(figure)) for name, title, figure in figures(report)]


def figures(report: Report) -> list[tuple[str, str, Figure]]:
    """Name, title and figure. Each preset has its own: their runs differ in more than the
    method."""
    found = []
    for preset in dict.fromkeys(curve.variant.preset for curve in report.curves):
        own = [curve for curve in report.curves if curve.variant.preset == preset]
        methods = [curve for curve in own if curve.variant.method]
        samplers = [curve for curve in methods if curve.variant.algo in SAMPLERS]
        varied = [curve for curve in own if not curve.variant.method]
        if methods:
            title = f"Grasp success of the methods (figure 6), preset {preset}"
            found.append((f"methods-{preset}", title, _lines(methods)))
        if len({curve.variant.algo for curve in samplers}) > 1:
            title = f"Grasp success of the samplers (figure 7), preset {preset}"
            found.append((f"samplers-{preset}", title, _lines(samplers)))
        if varied:
            title = f"Grasp success of the variants, preset {preset}"
            base = [
                curve
                for curve in methods
                if curve.variant.algo in {one.variant.algo for one in varied}
            ]
            found.append((f"variants-{preset}", title, _lines([*base, *varied])))
    measured = dict.fromkeys(
        (score.suite, score.variant.preset) for score in report.scores if score.suite in FOUR
    )
    for suite, preset in measured:
        scores = [
            score
            for score in report.scores
            if (score.suite, score.variant.preset) == (suite, preset)
        ]
        title = f"The four cases (figure 9), suite {suite}, preset {preset}"
        found.append((f"four-cases-{suite}-{preset}", title, _cases(scores)))
    return found


def _lines(curves: Sequence[Curve]) -> Figure:
    """Success against actions, a line and its band per variant, the paper's values as marks at
    2,500 actions."""
    figure, axes = plt.subplots(figsize=(8.0, 4.2), layout="constrained")
    drawn: set[str] = set()
    spare = iter(plt.get_cmap("tab20").colors)
    for curve in curves:
        algo = curve.variant.algo
        colour = next(spare) if algo in drawn or algo not in COLOURS else COLOURS[algo]
        drawn.add(algo)
        value = [100 * band.value for band in curve.success]
        name = f"{reporting.label(curve.variant, preset=False, most=NAMED)} ({len(curve.runs)})"
        axes.plot(curve.actions, value, color=colour, label=textwrap.fill(name, WIDE))
        banded = [
            (x, b) for x, b in zip(curve.actions, curve.success, strict=True) if b.low is not None
        ]
        if banded:
            low, high = ([100 * getattr(b, side) for _, b in banded] for side in ("low", "high"))
            axes.fill_between(
                [x for x, _ in banded], low, high, color=colour, alpha=0.2, linewidth=0
            )
        if curve.variant.method and algo in PAPER_TRAINING:
            axes.plot(
                PAPER_ACTIONS,
                100 * PAPER_TRAINING[algo],
                "D",
                color=colour,
                markeredgecolor="black",
            )
    axes.plot(
        [],
        [],
        "D",
        color="white",
        markeredgecolor="black",
        label="paper: ten blocks, 2,500 actions",
    )
    axes.set(xlabel="actions", ylabel="success over the last 200 grasps, %", ylim=(0, 101))
    axes.set_xlim(left=0)
    axes.grid(alpha=0.3)
    if len(curves) <= BESIDE:
        axes.legend(title="method (runs)", fontsize="small", loc="lower right")
        return figure
    figure.set_figheight(figure.get_figheight() + 0.2 * len(curves))
    figure.legend(title="method (runs)", fontsize="small", loc="outside lower center", ncols=2)
    return figure


def _cases(scores: Sequence[Score]) -> Figure:
    """Completion and action efficiency by case and variant, with bands; the paper's means of
    cleared cases as lines."""
    parts = list(dict.fromkeys(score.part for score in scores))
    groups = list(dict.fromkeys(_group(score) for score in scores))
    figure, panels = plt.subplots(
        1, len(FIGURE_9), figsize=(11.0, 4.2), sharey=True, layout="constrained"
    )
    for panel, (metric, title) in zip(panels, FIGURE_9.items(), strict=True):
        width = 0.8 / len(groups)
        for index, group in enumerate(groups):
            own = [score for score in scores if _group(score) == group]
            _marks(panel, own, parts, metric, (index + 0.5) * width - 0.4, index)
        ticks = [*parts, "mean"]
        panel.set_xticks(range(len(ticks)), ticks)
        panel.set(title=title, ylim=(0, 104))
        panel.grid(alpha=0.3, axis="y")
        paper = PAPER_CASES[metric] if scores[0].suite == "cases" else {}
        for algo, value in paper.items():
            name = f"paper, mean of the cases, {NAMES[algo]}"
            panel.axhline(100 * value, color=COLOURS[algo], linestyle="--", linewidth=1, label=name)
        panel.set_xlim(-0.5, len(parts) + 0.5)
    panels[0].set_ylabel("%")
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        fontsize="small",
        loc="outside lower center",
        ncols=2,
    )
    return figure


def _group(score: Score) -> tuple[Variant, str, str, str, int]:
    """What the marks of one colour have in common."""
    return score.variant, score.policy, score.physics, score.robot, score.seed


def _marks(
    panel: Axes, own: Sequence[Score], parts: Sequence[str], metric: str, offset: float, index: int
) -> None:
    """The marks of one variant: a case each, and the mean of all of them."""
    by_part = {score.part: score for score in own}
    bands = {i: by_part[part].band(metric) for i, part in enumerate(parts) if part in by_part}
    strata = [
        np.array(
            [one.metrics[metric]["value"] for one in score.evaluations if one.metrics[metric]["n"]]
        )
        for score in own
    ]
    if len(own) == len(parts) and all(len(stratum) for stratum in strata):
        bands[len(parts)] = statistics.band(strata)
    first = own[0]
    name = (
        reporting.label(first.variant, preset=False, most=NAMED)
        if first.policy == "learned"
        else first.policy
    )
    name += f", {first.physics}, {first.robot} ({len(first.evaluations)})"
    name = textwrap.fill(name, WIDE)
    known = COLOURS.get(first.variant.algo)
    colour = known if known and first.variant.method else plt.get_cmap("tab20")(index)
    for i, (place, band) in enumerate(bands.items()):
        if band is None:
            continue
        value, error = 100 * band.value, None
        if band.low is not None and band.high is not None:
            error = [[max(value - 100 * band.low, 0.0)], [max(100 * band.high - value, 0.0)]]
        panel.errorbar(
            place + offset,
            value,
            error,
            fmt="o",
            color=colour,
            capsize=3,
            label=name if i == 0 else None,
        )


def _svg(figure: Figure) -> str:
    """The figure as the element <svg>."""
    file = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "csac_jax"}):
        figure.savefig(file, format="svg", metadata={"Date": None})
    plt.close(figure)
    text = file.getvalue()
    return text[text.index("<svg") :]


def save(report: Report, folder: Path) -> list[Path]:
    """Writes every figure as a PNG; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, _, figure in figures(report):
        files.append(folder / f"{name}.png")
        figure.savefig(files[-1], dpi=110, metadata={"Software": None})
        plt.close(figure)
    return files
