"""Training curves: success against actions, and what all figures share."""

import dataclasses
import functools
import textwrap
from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")  # no display
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from csac_jax.evaluation.statistics import Band
from csac_jax.report.comparison import NAMES, Curve, label
from csac_jax.report.results import Variant
from csac_jax.report.tables import PAPER_ACTIONS, PAPER_TRAINING

PALETTE = ("#000000", "#E69F00", "#0072B2", "#56B4E9", "#009E73", "#D55E00", "#CC79A7")
"""Okabe and Ito's, which colour-blind readers can tell apart."""
COLOURS = dict(zip(NAMES, PALETTE, strict=True))
short = functools.partial(label, preset=False, most=3)  # name of a variant in a legend
LEGEND_WIDTH = 56  # characters, below a figure
LEGEND: dict[str, Any] = {  # right of a panel, where no curve is
    "loc": "upper left",
    "bbox_to_anchor": (1.01, 1.02),
    "title": "method (runs)",
    "fontsize": "small",
    "frameon": False,
}
NAME_WIDTH = 36  # characters of a line of it
MOST = 6  # lines of a panel
REFERENCE = "#7F7F7F"  # colour of the variant that is in every panel
Changes = tuple[tuple[str, str], ...]  # as in `Variant.changed`
PAPER = "paper: ten blocks, 2,500 actions"
PAPER_MARK: dict[str, Any] = {"marker": "D", "markeredgecolor": "black", "linestyle": ""}


def success(curves: Sequence[Curve], paper: bool) -> Figure:
    """Success against actions: a line and band per variant; `paper`: the paper's values as marks.
    Panels have at most MOST lines; if there are several, the variant of most runs is in each."""
    groups, shared = _groups(curves), shared_changes([curve.variant for curve in curves])
    figure, panels = plt.subplots(
        len(groups),
        figsize=(9.0, 4.2 if len(groups) == 1 else 0.6 + 2.4 * len(groups)),
        sharex=True,
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    bottoms = []
    for panel, group in zip(panels.flat, groups, strict=True):
        colours = _colours(group, len(groups) > 1)
        bottoms += [
            _line(panel, curve, colour, shared, paper)
            for curve, colour in zip(group, colours, strict=True)
        ]
        if paper:
            panel.plot([], [], color="white", label=PAPER, **PAPER_MARK)
        panel.grid(alpha=0.3)
        panel.legend(**LEGEND)
    panels[0, 0].set(xlim=(0, None), ylim=(floor(min(bottoms)), 101))
    figure.supxlabel("actions", fontsize="medium")
    figure.supylabel("success over the last 200 grasps, %", fontsize="medium")
    say_shared(figure, shared)
    return figure


def _groups(curves: Sequence[Curve]) -> list[list[Curve]]:
    """At most MOST curves each, the reference first where there are several groups."""
    if len(curves) <= MOST:
        return [list(curves)]
    reference = max(curves, key=lambda curve: len(curve.runs))
    others = [curve for curve in curves if curve is not reference]
    starts = range(0, len(others), MOST - 1)
    return [[reference, *others[start : start + MOST - 1]] for start in starts]


def _colours(curves: Sequence[Curve], reference: bool) -> list[str]:
    """A colour per curve, each once: the first curve of an algorithm has the algorithm's. With a
    `reference` the first curve has its own."""
    rest = [curve.variant.algo for curve in curves[1 if reference else 0 :]]
    spare = iter(colour for algo, colour in COLOURS.items() if algo not in rest)
    firsts = [rest.index(algo) == number for number, algo in enumerate(rest)]
    found = [
        COLOURS[algo] if first and algo in COLOURS else next(spare)
        for algo, first in zip(rest, firsts, strict=True)
    ]
    return [REFERENCE, *found] if reference else found


def _line(axes: Axes, curve: Curve, colour: str, shared: Changes, paper: bool) -> float:
    """Draws a variant and, if asked for, the paper's mark; returns the lowest value, %."""
    actions, bands = curve.points()
    value, low, high = percent(bands)
    name = f"{short(without(curve.variant, shared))} ({len(curve.runs)})"
    axes.plot(actions, value, color=colour, label=textwrap.fill(name, NAME_WIDTH))
    if len(curve.runs) > 1:
        axes.fill_between(actions, low, high, color=colour, alpha=0.15, linewidth=0)
    published = PAPER_TRAINING.get(curve.variant.algo) if paper else None
    if published is None:
        return lowest([value, low])
    axes.plot(PAPER_ACTIONS, 100 * published, color=colour, clip_on=False, **PAPER_MARK)
    return min(lowest([value, low]), 100 * published)


def shared_changes(variants: Sequence[Variant]) -> Changes:
    """Changes that all of several variants make, in their order."""
    first, *others = [variant.changed for variant in variants]
    return tuple(change for change in first if others and all(change in one for one in others))


def without(variant: Variant, shared: Changes) -> Variant:
    """The variant without changes that a figure names once for all."""
    return dataclasses.replace(
        variant, changed=tuple(one for one in variant.changed if one not in shared)
    )


def say_shared(figure: Figure, shared: Changes) -> None:
    """Names the changes that all variants of a figure make."""
    if shared:
        named = ", ".join(f"{setting} {value}" for setting, value in shared)
        figure.suptitle(f"all with {named}", fontsize="medium")


def lowest(values: Any) -> float:
    """The lowest of values that are there, %; 100 without any."""
    there = np.isfinite(values)
    return float(np.min(np.asarray(values)[there], initial=100.0))


def floor(percentage: float) -> float:
    """Where an axis begins, %: a whole ten a little below the data."""
    return max(10.0 * np.floor((percentage - 1.0) / 10.0), 0.0)


def percent(bands: Sequence[Band | None]) -> np.ndarray:
    """Value, low and high, [3, bands], %; NaN where there is none."""
    rows = [(None, None, None) if band is None else band[:3] for band in bands]
    return 100 * np.array(rows, float).reshape(-1, 3).T
