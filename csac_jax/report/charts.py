"""Figures 6, 7 and 9 of the paper and of variants."""

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
from csac_jax.report.comparison import NAMES, Curve, Report, Score, grouped
from csac_jax.report.curves import (
    COLOURS,
    LEGEND_WIDTH,
    REFERENCE,
    Changes,
    floor,
    lowest,
    percent,
    say_shared,
    shared_changes,
    short,
    success,
    without,
)
from csac_jax.report.tables import PAPER_CASES

SAMPLERS = ("csac", "csac_per", "csac_beta")
FIGURE_9 = {"completion": "completion", "action_efficiency": "action efficiency (blocks / actions)"}
PROFILED = np.linspace(0.0, 1.0, 101)  # values that a performance profile is drawn over
MARKERS = "os^DvP*"


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
                yield Chart(f"{name}-{preset}", title, success(chosen, paper=name != "variants"))
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
    plain = [curve for curve in curves if curve.variant.unchanged]
    methods = plain or _most_run(curves)
    samplers = [curve for curve in methods if curve.variant.algo in SAMPLERS]
    several = len({curve.variant.algo for curve in samplers}) > 1
    varied = [curve for curve in curves if not curve.variant.unchanged]
    algos = {curve.variant.algo for curve in varied}
    base = [curve for curve in plain if curve.variant.algo in algos]
    return {
        "methods": ("the methods (figure 6)", methods),
        "samplers": ("the samplers (figure 7)", samplers if several else []),
        "variants": ("the variants", [*base, *varied]),
    }


def _most_run(curves: Sequence[Curve]) -> list[Curve]:
    """Of each algorithm the variant of most runs; none of several variants of one algorithm."""
    by_algo = grouped(curves, lambda curve: curve.variant.algo).values()
    if len(by_algo) == 1 < len(curves):
        return []
    return [max(one, key=lambda curve: len(curve.runs)) for one in by_algo]


def _cases(scores: Sequence[Score]) -> Figure:
    """Completion and action efficiency by case and variant; the paper's means as lines."""
    figure, panels = plt.subplots(1, 2, figsize=(11.0, 4.2), sharey=True, layout="constrained")
    shared = shared_changes([score.variant for score in scores])
    bottoms = []
    for panel, (metric, title) in zip(panels, FIGURE_9.items(), strict=True):
        bottoms.append(_marks(panel, metric, scores, shared))
        panel.set(title=title)
        panel.grid(alpha=0.3, axis="y")
        paper = PAPER_CASES[metric] if scores[0].suite == "cases" else {}
        for algo, value in paper.items():
            name = f"paper, mean of the cases, {NAMES[algo]}"
            panel.axhline(100 * value, color=COLOURS[algo], linestyle="--", linewidth=1, label=name)
            bottoms.append(100 * value)
    panels[0].set(ylabel="%", ylim=(floor(min(bottoms)), 104))
    _finish(figure, panels[0], shared)
    return figure


def _finish(figure: Figure, panel: Axes, shared: Changes) -> None:
    """The legend of a panel for the whole figure, and what all variants share."""
    handles = panel.get_legend_handles_labels()
    figure.legend(*handles, fontsize="small", loc="outside lower center", ncols=3)
    say_shared(figure, shared)


def _marks(panel: Axes, metric: str, scores: Sequence[Score], shared: Changes) -> float:
    """A mark of each variant in each case, and in the mean of all if it has all; returns the
    lowest value, %."""
    parts = list(dict.fromkeys(part for score in scores for part in score.parts))
    places, bottoms = np.arange(len(parts) + 1), []
    for index, score in enumerate(scores):
        bands = [score.only(part).band(metric) for part in parts]
        bands.append(score.band(metric) if len(score.parts) == len(parts) else None)
        value, low, high = percent(bands)
        error = np.maximum([value - low, high - value], 0.0)
        offset = (index + 0.5) * 0.8 / len(scores) - 0.4
        fmt, style = MARKERS[index % len(MARKERS)], _style(scores, index, shared)
        panel.errorbar(places + offset, value, error, fmt=fmt, capsize=3, **style)
        bottoms.append(lowest(low))
    panel.set_xticks(places, [*parts, "mean"])
    panel.set_xlim(-0.5, len(parts) + 0.5)
    return min(bottoms)


def _profiles(scores: Sequence[Score]) -> Figure:
    """Share of the seeds above each value, mean of the parts, by variant, arXiv:2108.13264."""
    figure, panels = plt.subplots(1, 2, figsize=(11.0, 4.2), sharey=True, layout="constrained")
    shared = shared_changes([score.variant for score in scores])
    for panel, (metric, title) in zip(panels, FIGURE_9.items(), strict=True):
        left = 100.0
        for index, score in enumerate(scores):
            value, low, high = percent(statistics.profile(score.strata(metric), PROFILED))
            style = _style(scores, index, shared)
            panel.plot(100 * PROFILED, value, **style)
            panel.fill_between(100 * PROFILED, low, high, color=style["color"], alpha=0.15)
            left = min(left, 100 * PROFILED[np.argmax(value < 100.0)])
        panel.set(xlabel=f"{title}, %", xlim=(floor(left), 100), ylim=(0, 101))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("seeds above, %")
    _finish(figure, panels[0], shared)
    return figure


def _style(scores: Sequence[Score], index: int, shared: Changes) -> dict[str, Any]:
    """Name and colour of a variant's marks. Each algorithm's first variant has its colour."""
    score = scores[index]
    variant = without(score.variant, shared)
    words = [short(variant) if score.policy == "learned" else score.policy]
    words += [
        one
        for one, every in ((score.physics, "physics"), (score.robot, "robot"))
        if len({getattr(other, every) for other in scores}) > 1
    ]
    firsts = [other.variant.algo for other in scores]
    spare = [colour for algo, colour in COLOURS.items() if algo not in firsts] or [REFERENCE]
    first = firsts.index(variant.algo) == index
    colour = COLOURS[variant.algo] if first else spare[index % len(spare)]
    name = f"{', '.join(words)} ({score.most_runs})"
    return {"label": textwrap.fill(name, LEGEND_WIDTH), "color": colour}


def save(figure: Figure, path: Path) -> None:
    """Writes a PNG that is the same bytes for the same figure."""
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)
