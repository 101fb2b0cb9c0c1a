"""The curves of a report's page, as data of plotly; no library is needed to make them."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from csac_jax.evaluation.statistics import Band
from csac_jax.report import charts, wording
from csac_jax.report.comparison import NAMES, Curve, Report, Score, grouped
from csac_jax.report.tables import PAPER_ACTIONS, PAPER_TRAINING

SPARE = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#999999")
"""Colours that colour-blind readers tell apart (Okabe and Ito 2008)."""
SHOWN = 6  # curves that are drawn at first; a click in the legend draws the others
MEASURED = {"completion": "completion", "grasp_success": "grasp success"}

Trace = dict[str, Any]


class Plot(NamedTuple):
    """A figure of the page."""

    title: str
    data: list[Trace]
    layout: dict[str, Any]


def draw(report: Report) -> Iterator[Plot]:
    """A figure of the training of each preset's methods, one of its variants, and one of each suite
    that several parts or policies were measured in."""
    for preset, curves in grouped(report.curves, lambda one: one.variant.preset).items():
        methods = [curve for curve in curves if curve.variant.unchanged]
        others = [curve for curve in curves if not curve.variant.unchanged]
        for what, chosen in (("methods", methods), ("variants", others)):
            if chosen:
                yield _training(f"Training of {preset}: {what}", chosen)
    for (preset, suite), scores in grouped(report.scores, _place).items():
        if len(scores) > 1 or len(scores[0].parts) > 1:
            yield _suite(f"Suite {suite}, {preset}", scores)


def _place(score: Score) -> tuple[str, str]:
    return score.variant.preset, score.suite


def _training(title: str, curves: Sequence[Curve]) -> Plot:
    data = []
    for number, curve in enumerate(curves):
        data += _band(curve, _colour(curve.variant.algo, curve.variant.unchanged, number), number)
    axes = {"xaxis": {"title": {"text": "actions"}, "rangemode": "tozero"}}
    y = {"title": {"text": "success over the last 200 grasps, %"}, "range": [0, 101]}
    height = {"height": _height(len(curves))}
    return Plot(title, data, {**axes, "yaxis": y, "hovermode": "x unified"} | height)


def _height(entries: int) -> int:
    """Height of a figure with a legend of so many entries below it, px; the page's script knows
    that 320 are for the rest."""
    return 390 + 24 * entries


def _colour(algo: str, plain: bool, number: int) -> str:
    return charts.COLOURS[algo] if plain and algo in NAMES else SPARE[number % len(SPARE)]


def _band(curve: Curve, colour: str, number: int) -> list[Trace]:
    """A line with its band, and the paper's mark."""
    actions, bands = curve.points()
    x, name = actions.tolist(), f"{wording.name_of(curve.variant)} ({len(curve.runs)})"
    visible = True if number < SHOWN else "legendonly"
    shared = {"x": x, "legendgroup": name, "visible": visible}
    line = shared | {
        "y": _percent(band.value for band in bands),
        "customdata": [_interval(band) for band in bands],
        "name": name,
        "mode": "lines",
        "line": {"color": colour, "width": 2},
        "hovertemplate": "%{y:.1f} %%{customdata}",
    }
    edge = shared | {"mode": "lines", "line": {"width": 0}, "hoverinfo": "skip"}
    edge |= {"showlegend": False}
    fill = {"fill": "tonexty", "fillcolor": f"{colour}33"}
    traces = [line]
    if len(curve.runs) > 1:
        low = edge | {"y": _percent(band.low for band in bands)}
        high = edge | fill | {"y": _percent(band.high for band in bands)}
        traces = [low, high, line]
    if curve.variant.unchanged and curve.variant.algo in PAPER_TRAINING:
        mark = {"symbol": "diamond", "size": 11, "color": colour}
        y = [100 * PAPER_TRAINING[curve.variant.algo]]
        said = {"name": "paper", "showlegend": False, "hovertemplate": "%{y:.0f} % in the paper"}
        place = {"x": [PAPER_ACTIONS], "y": y, "mode": "markers", "marker": mark}
        traces.append(shared | place | said)
    return traces


def _suite(title: str, scores: Sequence[Score]) -> Plot:
    """Completion, and by a button grasp success, of each policy in each part."""
    metrics, data = list(MEASURED), []
    for metric in metrics:
        for number, score in enumerate(scores):
            data.append(_marks(score, metric, number) | {"visible": metric == metrics[0]})
    size = len(scores)
    buttons = [
        {
            "label": text,
            "method": "restyle",
            "args": [{"visible": [i // size == k for i in range(len(data))]}],
        }
        for k, text in enumerate(MEASURED.values())
    ]
    menu = {"type": "buttons", "direction": "right", "buttons": buttons, "x": 0, "y": 1.14}
    menu |= {"xanchor": "left", "yanchor": "top", "showactive": False}
    layout = {"yaxis": {"title": {"text": "%"}}, "updatemenus": [menu], "scattermode": "group"}
    return Plot(title, data, layout | {"xaxis": {"type": "category"}, "height": _height(size)})


def _marks(score: Score, metric: str, number: int) -> Trace:
    bands = {part: score.only(part).band(metric) for part in score.parts}
    there = {part: band for part, band in bands.items() if band is not None}
    value = _percent(band.value for band in there.values())
    up = _percent((band.high or band.value) - band.value for band in there.values())
    down = _percent(band.value - (band.low or band.value) for band in there.values())
    learned = score.policy == "learned"
    colour = _colour(score.variant.algo, learned and score.variant.unchanged, number)
    name = wording.name_of(score.variant) if learned else score.policy
    return {
        "type": "scatter",
        "mode": "markers",
        "name": f"{name}, {score.physics}, {score.robot} ({score.most_runs})",
        "x": list(there),
        "y": value,
        "customdata": [_interval(band) for band in there.values()],
        "error_y": {"type": "data", "symmetric": False, "array": up, "arrayminus": down},
        "marker": {"color": colour, "size": 9},
        "hovertemplate": "%{x}: %{y:.1f} %%{customdata}",
    }


def _percent(values: Any) -> list[float | None]:
    return [None if value is None else round(100 * float(value), 3) for value in values]


def _interval(band: Band) -> str:
    if band.low is None or band.high is None:
        return ""
    return f" ({100 * band.low:.1f} to {100 * band.high:.1f})"
