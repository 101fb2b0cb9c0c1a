"""Figures of a report: training curves, suites, performance profiles."""

import itertools
import textwrap
from collections.abc import Iterator, Sequence
from io import BytesIO
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
from csac_jax.report.comparison import Curve, ResultReport, Score, grouped
from csac_jax.report.variants import NAMES, OWN_LEARNER, Variant, label

PALETTE = ("#000000", "#E69F00", "#0072B2", "#56B4E9", "#009E73", "#D55E00", "#CC79A7")
"""Colours that colour-blind readers can tell apart (Okabe and Ito 2008)."""
COLOURS = dict(zip(NAMES, PALETTE, strict=False))
GREY = "#7F7F7F"
ALL = (*PALETTE, GREY, "#332288", "#117733", "#882255", "#999933", "#AA4499")
"""Those, and more of Paul Tol's, for the methods of a figure that have no colour of their own."""
MOST_LINES, MOST_SCORES = 6, 12  # of a panel; of a figure of a suite
NAME_WIDTH, LEGEND_WIDTH = 36, 46  # characters of a line: right of a panel, below a figure
LONGEST = 100  # characters of a name
LEGEND: dict[str, Any] = {  # right of a panel, where no curve is
    "loc": "upper left",
    "bbox_to_anchor": (1.01, 1.02),
    "title": "method (runs)",
    "fontsize": "small",
    "frameon": False,
}
SUITE_METRICS = {
    "completion": "completion",
    "action_efficiency": "action efficiency (blocks / actions)",
}
PROFILED = np.linspace(0.0, 1.0, 101)  # values that a performance profile is drawn over
MARKERS = "os^DvP*"


class Chart(NamedTuple):
    """A figure of a report."""

    name: str  # of its file
    title: str
    figure: Figure


def draw(report: ResultReport) -> Iterator[Chart]:
    """Draws every figure that the report has results for, each preset by itself."""
    for preset, curves in grouped(report.curves, lambda curve: curve.variant.preset).items():
        plain = [curve for curve in curves if curve.variant.unchanged]
        varied = [curve for curve in curves if not curve.variant.unchanged]
        algorithms = {curve.variant.algo for curve in varied}
        algorithms |= {report.reference} if OWN_LEARNER in algorithms else set()
        base = [curve for curve in plain if curve.variant.algo in algorithms]
        if plain:
            yield Chart(f"methods-{preset}", f"Training of {preset}: methods", training(plain))
        if varied:
            figure = training([*base, *varied])
            yield Chart(f"variants-{preset}", f"Training of {preset}: variants", figure)
    by_suite = grouped(report.scores, lambda score: (score.suite, score.variant.preset))
    for (suite, preset), scores in by_suite.items():
        title = f"{suite}, preset {preset}"
        if len(scores) <= MOST_SCORES and (len(scores) > 1 or len(scores[0].parts) > 1):
            kind = "four-cases" if suite in ("cases", "target") else "suite"
            yield Chart(f"{kind}-{suite}-{preset}", f"Suite {title}", _suite(scores))
        several = [score for score in scores if score.policy == "learned" and score.seeds > 1]
        if 1 < len(several) <= MOST_SCORES:
            figure = _profiles(several)
            yield Chart(
                f"profiles-{suite}-{preset}", f"Performance profiles, suite {title}", figure
            )


def training(curves: Sequence[Curve]) -> Figure:
    """Draws success against actions, a line and a band per variant, at most MOST_LINES a panel."""
    groups = [curves[i : i + MOST_LINES] for i in range(0, len(curves), MOST_LINES)]
    size = (9.0, 4.2 if len(groups) == 1 else 0.6 + 2.4 * len(groups))
    figure, panels = plt.subplots(
        len(groups), figsize=size, sharex=True, sharey=True, squeeze=False, layout="constrained"
    )
    for panel, group in zip(panels.flat, groups, strict=True):
        colours = _colours([curve.variant.algo for curve in group])
        for curve, colour in zip(group, colours, strict=True):
            actions, bands = curve.points()
            name = textwrap.fill(f"{_short(curve.variant)} ({len(curve.runs)})", NAME_WIDTH)
            _shaded(panel, actions, bands, color=colour, label=name)
        panel.legend(**LEGEND)
    panels[0, 0].set(xlim=(0, None), ylim=(None, 101))
    figure.supxlabel("actions", fontsize="medium")
    figure.supylabel("success over the last 200 grasps, %", fontsize="medium")
    return figure


def _shaded(panel: Axes, x: Any, bands: Sequence[Band | None], **style: Any) -> None:
    """Draws a line through values, %, and shades their intervals."""
    value, low, high = percent(bands)
    panel.plot(x, value, **style)
    panel.fill_between(x, low, high, color=style["color"], alpha=0.15, linewidth=0)
    panel.grid(alpha=0.3)


def _colours(algorithms: Sequence[str]) -> list[str]:
    """Returns a colour for each variant: an algorithm's own for its first one, else one that no
    other has, as long as there are any."""
    spare = [colour for colour in ALL if colour not in map(COLOURS.get, algorithms)] or [GREY]
    others = itertools.cycle(spare)
    return [
        COLOURS[algo] if algo in COLOURS and algo not in algorithms[:index] else next(others)
        for index, algo in enumerate(algorithms)
    ]


def _short(variant: Variant) -> str:
    return textwrap.shorten(label(variant, preset=False, most=3), LONGEST, placeholder=" ...")


def _suite(scores: Sequence[Score]) -> Figure:
    """Draws completion and action efficiency by part and variant."""
    figure, panels = plt.subplots(1, 2, figsize=(11.0, 4.2), sharey=True, layout="constrained")
    for panel, (metric, title) in zip(panels, SUITE_METRICS.items(), strict=True):
        _marks(panel, metric, scores)
        panel.set(title=title)
        panel.grid(alpha=0.3, axis="y")
    panels[0].set(ylabel="%", ylim=(None, 104))
    _legend_below(figure, panels[0])
    return figure


def _marks(panel: Axes, metric: str, scores: Sequence[Score]) -> None:
    """Draws a mark of each variant in each part and in their mean."""
    parts = list(dict.fromkeys(part for score in scores for part in score.parts))
    ticks = [*parts, "mean"] if len(parts) > 1 else parts
    places = np.arange(len(ticks))
    for index, score in enumerate(scores):
        bands = [score.only(part).band(metric) for part in parts]
        if len(parts) > 1:
            bands.append(score.band(metric) if len(score.parts) == len(parts) else None)
        value, low, high = percent(bands)
        error = np.maximum([value - low, high - value], 0.0)
        offset = (index + 0.5) * 0.8 / len(scores) - 0.4
        fmt, style = MARKERS[index % len(MARKERS)], _style(scores, index)
        panel.errorbar(places + offset, value, error, fmt=fmt, capsize=3, **style)
    panel.set_xticks(places, ticks)
    panel.set_xlim(-0.5, len(ticks) - 0.5)


def _profiles(scores: Sequence[Score]) -> Figure:
    """Draws the share of the seeds above each value, mean of the parts, arXiv:2108.13264."""
    figure, panels = plt.subplots(1, 2, figsize=(11.0, 4.2), sharey=True, layout="constrained")
    for panel, (metric, title) in zip(panels, SUITE_METRICS.items(), strict=True):
        shares = [statistics.profile(score.strata(metric), PROFILED) for score in scores]
        for index, share in enumerate(shares):
            _shaded(panel, 100 * PROFILED, share, **_style(scores, index))
        least = min(np.argmax([band.value < 1.0 for band in share]) for share in shares)
        panel.set(xlabel=f"{title}, %", xlim=(100 * PROFILED[least] - 2, 100), ylim=(0, 101))
    panels[0].set_ylabel("seeds above, %")
    _legend_below(figure, panels[0])
    return figure


def _legend_below(figure: Figure, panel: Axes) -> None:
    handles = panel.get_legend_handles_labels()
    figure.legend(*handles, fontsize="small", loc="outside lower center", ncols=3)


def _style(scores: Sequence[Score], index: int) -> dict[str, Any]:
    """Returns name and colour of a variant's marks."""
    score = scores[index]
    words = [_short(score.variant) if score.policy == "learned" else score.policy]
    for field in ("physics", "robot"):
        if len({getattr(other, field) for other in scores}) > 1:
            words.append(getattr(score, field))
    colour = _colours([other.variant.algo for other in scores])[index]
    name = f"{', '.join(words)} ({score.most_runs})"
    return {"label": textwrap.fill(name, LEGEND_WIDTH), "color": colour}


def percent(bands: Sequence[Band | None]) -> np.ndarray:
    """Returns value, low and high [3, bands], %; NaN where there is none."""
    rows = [(None, None, None) if band is None else band[:3] for band in bands]
    return 100 * np.array(rows, float).reshape(-1, 3).T


def save(figure: Figure, path: Path) -> None:
    """Writes a PNG that is the same bytes for the same figure."""
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def svg(figure: Figure) -> bytes:
    """Returns the figure as an SVG whose text is text, on a transparent ground."""
    stream = BytesIO()
    with plt.rc_context({"svg.fonttype": "none", "svg.hashsalt": "csac_jax"}):
        figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    plt.close(figure)
    return stream.getvalue()
