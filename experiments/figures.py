"""Draws the figures that a document links to, from experiments/results into docs/figures."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # no display
import matplotlib.pyplot as plt
from matplotlib import cycler, ticker
from matplotlib.figure import Figure

from csac_jax.report import charts, comparison, curves, results
from csac_jax.report.results import METRICS
from experiments import study

plt.rcParams["axes.prop_cycle"] = cycler(color=curves.PALETTE)

ROOT = Path(__file__).resolve().parents[1]
RESULTS, FIGURES = ROOT / "experiments" / "results", ROOT / "docs" / "figures"
SAMPLERS = {
    "uniform": "uniform",
    "prioritised": "prioritised",
    "beta": "beta",
    "flashbax": "prioritised, flashbax",
}
CURVES = {
    "scenes": "scenes side by side",
    "blocks": "blocks on the table",
    "map": "cells along a side of the map",
    "capacity": "capacity of the replay, transitions",
}


def linked() -> set[str]:
    """Names of the figures that README and docs show."""
    documents = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    return {
        name
        for path in documents
        for name in re.findall(r"figures/([\w-]+)\.png", path.read_text())
    }


def figures() -> Iterator[tuple[str, Figure]]:
    """Name and figure of all that can be drawn."""
    yield "replay", replay()
    yield from steps()
    yield from sweeps()
    yield "warp-action", warp_action()
    report = comparison.build(results.read([RESULTS]))
    yield from ((chart.name, chart.figure) for chart in charts.draw(report))
    yield "study", differences()
    for name, path in study.archives().items():
        part = comparison.build(study.read(path))
        yield from ((f"study-{name}-{chart.name}", chart.figure) for chart in charts.draw(part))


def differences() -> Figure:
    """What tests the study's hypotheses: a panel for each archive, differences with their intervals
    and, of shares, the band in which methods are equivalent."""
    tested = study.tested()
    rows = [len(gaps) for gaps in tested.values()]
    figure, panels = plt.subplots(
        len(rows),
        figsize=(9, 0.26 * sum(rows) + 0.75 * len(rows)),
        height_ratios=[1 + count for count in rows],
        layout="constrained",
    )
    for panel, (name, gaps) in zip(panels, tested.items(), strict=True):
        part = study.PARTS[name]
        counted = part.by in (study.PUSHES, study.ACTIONS)
        scale, unit = (1, "") if counted else (100, ", points")
        places = range(len(gaps), 0, -1)
        for place, gap in zip(places, gaps, strict=True):
            value, low, high = (scale * x for x in gap.band[:3] if x is not None)
            panel.errorbar(value, place, xerr=[[value - low], [high - value]], fmt="o", color="C0")
        if unit:
            panel.axvspan(-scale * study.POINT, scale * study.POINT, color="0.9", zorder=0)
        panel.axvline(0, color="0.5", linewidth=1)
        panel.set_yticks(list(places), [f"{gap.method} less {gap.less}" for gap in gaps])
        panel.set(ylim=(0.3, len(gaps) + 0.7), xlabel=f"{METRICS.get(part.by, part.by)}{unit}")
        panel.set_title(
            f"{part.title} (hypothesis {part.hypothesis})", fontsize="medium", loc="right"
        )
    return figure


def _read(pattern: str) -> list[dict[str, Any]]:
    """The records of benchmarks whose path has this pattern."""
    return [json.loads(path.read_text()) for path in sorted(RESULTS.glob(f"bench/{pattern}.json"))]


def replay() -> Figure:
    """Time to draw 64 transitions and replace their priorities, against the ring's capacity."""
    records = {"2-core CPU, busy": _read("replay/cpu"), "H200": _read("replay/h200-*")}
    figure, panels = plt.subplots(
        1, len(records), figsize=(9, 3.4), sharey=True, layout="constrained"
    )
    for panel, (device, parts) in zip(panels, records.items(), strict=True):
        rows = [row for part in parts for row in part["capacities"]]
        for name, label in SAMPLERS.items():
            microseconds = [1e6 * row["median_seconds"][name] for row in rows]
            panel.plot([row["capacity"] for row in rows], microseconds, "o-", label=label)
        panel.set(title=device, xlabel="capacity, transitions", yscale="log")
        panel.set_xscale("log", base=2)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("median per step, \N{MICRO SIGN}s")
    panels[1].legend()
    return figure


def steps() -> Iterator[tuple[str, Figure]]:
    """Time of a training step against what grows, a figure per recorded curve."""
    for curve, label in CURVES.items():
        figure, panel = plt.subplots(figsize=(4.8, 3.4), layout="constrained")
        power = 2 if curve == "map" else 1
        for record in _read(f"step/*-{curve}"):
            points = record["points"]
            sizes, seconds = zip(*((p[curve], p["step_seconds"]) for p in points), strict=True)
            panel.plot(sizes, seconds, "o-", label=_name(record))
            grown = [seconds[0] * (size / sizes[0]) ** power for size in sizes]
            proportion = "in proportion" + " to cells" * (power == 2)
            panel.plot(sizes, grown, ":", color="grey", label=proportion)
        panel.set(xlabel=label, ylabel="time of a training step, s")
        _plain_logarithms(panel)
        _finish(panel)
        yield f"step-{curve}", figure


def sweeps() -> Iterator[tuple[str, Figure]]:
    """Time of a step against seeds side by side, and the speed-up by several devices."""
    seeds, at = plt.subplots(figsize=(4.8, 3.4), layout="constrained")
    devices, over = plt.subplots(figsize=(4.8, 3.4), layout="constrained")
    most = 1
    for record in _read("sweep/*"):
        rows = record["rows"]
        alone = [row for row in rows if row["devices"] == 1]
        if len(alone) > 1:
            seconds = [row["seconds"] / record["steps"] for row in alone]
            at.plot([row["seeds"] for row in alone], seconds, "o-", label=_name(record))
        if len(alone) < len(rows):
            scenes = f"{rows[0]['seeds']} x {record['scenes']} scenes, {record['preset']}"
            times = [rows[0]["seconds"] / row["seconds"] for row in rows]
            counts = [row["devices"] for row in rows]
            over.plot(counts, times, "o-", label=f"{record['shard']}: {scenes}")
            most = max(most, *counts)
    at.set(xlabel="seeds side by side", ylabel="time of a training step, s")
    _plain_logarithms(at)
    over.plot([1, most], [1, most], ":", color="grey", label="as many times as devices")
    over.set(xlabel="devices", ylabel="times as fast as one", xticks=range(1, most + 1))
    for panel in (at, over):
        _finish(panel)
    yield "step-seeds", seeds
    yield "step-devices", devices


def warp_action() -> Figure:
    """Actions a second on Warp, without learning: against scenes, blocks, and parts of objects."""
    (objects,) = _read("objects/h100")
    rows = [row for record in _read("warp_action/h100-[0-9bs]*") for row in record["runs"]]
    per_second = {(row["scenes"], row["blocks"]): row["actions_per_second"] for row in rows}
    milliseconds = {
        objects["mean_parts"][kind]: objects["milliseconds"][f"{kind} action"]
        for kind in objects["mean_parts"]
        if kind != "objects"
    }
    curves = {
        "scenes of ten blocks": {e: rate for (e, n), rate in per_second.items() if n == 10},
        "blocks in each of 2,048 scenes": {
            n: rate for (e, n), rate in per_second.items() if e == 2048
        },
        f"convex parts an object, {objects['scenes']:,} scenes": {
            parts: 1e3 / each for parts, each in milliseconds.items()
        },
    }
    figure, panels = plt.subplots(1, 3, figsize=(11, 3.2), sharey=True, layout="constrained")
    for panel, (label, points) in zip(panels, curves.items(), strict=True):
        panel.plot(*zip(*sorted(points.items()), strict=True), "o-")
        panel.set(xlabel=label, ylim=(0, None))
        panel.grid(alpha=0.3)
    panels[0].set_xscale("log", base=2)
    panels[0].xaxis.set_major_formatter("{x:,g}")
    panels[1].xaxis.set_major_locator(ticker.MaxNLocator(integer=True))
    panels[0].set_ylabel("actions a second")
    return figure


def _name(record: dict[str, Any]) -> str:
    return f"{record['preset']}, {record['physics']}, {record['device']}"


def _plain_logarithms(panel: Any) -> None:
    """Logarithmic axes whose ticks show no powers."""
    panel.set_xscale("log", base=2)
    panel.set_yscale("log")
    panel.xaxis.set_major_formatter("{x:g}")
    panel.yaxis.set_major_formatter("{x:g}")
    panel.yaxis.set_minor_locator(ticker.LogLocator(subs=(2.0, 5.0)))
    panel.yaxis.set_minor_formatter("{x:g}")


def _finish(panel: Any) -> None:
    panel.grid(alpha=0.3)
    panel.legend(fontsize="small")


if __name__ == "__main__":
    FIGURES.mkdir(exist_ok=True)
    shown = linked()
    for name, figure in figures():
        if name in shown:
            charts.save(figure, FIGURES / f"{name}.png")
        else:
            plt.close(figure)
