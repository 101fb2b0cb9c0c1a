"""Draws the figures that a document links to, from experiments/results into docs/figures."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # no display
import matplotlib.pyplot as plt
import numpy as np
from matplotlib import cycler, ticker
from matplotlib.figure import Figure

from csac_jax.evaluation import metrics
from csac_jax.report import comparison, figures, results
from csac_jax.report.comparison import ResultReport
from csac_jax.report.figures import Chart
from csac_jax.report.results import Results
from experiments import index, second_tables, summary

plt.rcParams["axes.prop_cycle"] = cycler(color=figures.PALETTE)

ROOT = Path(__file__).resolve().parents[1]
RESULTS, FIGURES = ROOT / "experiments" / "results", ROOT / "docs" / "figures"
PAPER = {"grasp_only": 0.50, "vpg": 0.75, "csac_per": 0.80, "csac_beta": 0.90}
"""Success over the last 200 grasps of 2,500 actions, text to figures 6 and 7 (CSAC sec. 4.3)."""
PAPER_ACTIONS = 2500
SAMPLERS = {
    "uniform": "uniform",
    "prioritised": "prioritised",
    "beta": "beta",
    "flashbax": "prioritised, flashbax",
}
OURS = "shipped"
RECORDED = "shipped_general"  # its rows here; the `shipped` of benchmarks is an earlier one
NEED_PUSHES = ("blocked", "enclosed", "tray", "hidden")
NEED_GRASPS = ("target", "cases", "packed", "random10", "random30", "pile", "objects_packed")
NEED_GRASPS += ("objects10", "target_objects")
BOUNDS = dict.fromkeys(NEED_PUSHES, ("random", "planner"))
BOUNDS |= dict.fromkeys(NEED_GRASPS, ("random", "oracle"))
"""Suite -> the policies that are floor and ceiling."""


def linked() -> set[str]:
    """Returns the names of the figures that README and docs show."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    text = "\n".join(page.read_text() for page in pages)
    return set(re.findall(r"figures/([\w-]+)\.png", text))


def draw() -> Iterator[tuple[str, Figure]]:
    """Draws all figures and yields them by name."""
    yield "suites", suites()
    yield "replay", replay()
    yield "study-pushes", pushes()
    yield from sweeps()
    for chart in figures.draw(comparison.build(results.read([RESULTS]))):
        yield chart.name, _with_paper(chart)
    for chart in figures.draw(_target()):
        yield f"study-1-target-{chart.name}", _with_paper(chart)


def _target() -> ResultReport:
    """Groups what part 1 of the study has of the target task."""
    runs, evaluations = (
        [one for one in every if one.path.parts[-4].startswith("1-target-")]
        for every in summary.methods()[:2]
    )
    return comparison.build(Results(runs, evaluations, []))


def _with_paper(chart: Chart) -> Figure:
    """Adds the paper's values to methods on its protocol."""
    panels = chart.figure.axes
    if chart.name in ("methods-paper", "methods-paper_small"):
        for algo, value in PAPER.items():
            style: dict[str, Any] = {"color": figures.COLOURS[algo], "markeredgecolor": "black"}
            panels[0].plot(PAPER_ACTIONS, 100 * value, "D", clip_on=False, **style)
        panels[0].plot([], [], "wD", markeredgecolor="black", label="paper, 2,500 actions")
        panels[0].legend(**figures.LEGEND)
        panels[0].set_ylim(bottom=min(panels[0].get_ylim()[0], 45))
    return chart.figure


def _read(bench: str, pattern: str = "") -> list[dict[str, Any]]:
    """Reads the records of a benchmark whose names match the pattern."""
    records = json.loads((RESULTS / "bench" / f"{bench}.json").read_text())
    return [one for name, one in sorted(records.items()) if re.search(pattern, name)]


def completions() -> dict[tuple[str, str], dict[str, Any]]:
    """Returns the completion of each suite and policy, pooled over records, seeds and parts, with
    its 95 % interval."""
    records = [*_read("benchmark", "half"), *_read("push_suites")]
    rows = [row for record in records for row in record["results"]]
    for name, text in index.contents(RESULTS / "general.tar.xz").items():
        if re.search(r"/eval-\w+\.json$", name):  # with the RG2, else a hand's name follows
            rows.append(json.loads(text) | {"policy": RECORDED})
    counts: dict[tuple[str, str], tuple[int, int]] = {}
    for row in rows:
        for part in row.get("parts", {"": row}).values():
            key, share = (row["suite"], row["policy"]), part["completion"]
            done, episodes = counts.get(key, (0, 0))
            done += round(share["value"] * share["n"])
            counts[key] = done, episodes + share["n"]
    return {key: metrics.wilson(*count) for key, count in counts.items()}


def suites() -> Figure:
    """Draws the completion of `shipped` between floor and ceiling of each suite."""
    shares, places = completions(), range(len(BOUNDS), 0, -1)
    figure, panel = plt.subplots(figsize=(8, 4.6), layout="constrained")
    floor, ceiling = (
        [100 * shares[suite, bound[i]]["value"] for suite, bound in BOUNDS.items()] for i in (0, 1)
    )
    panel.hlines(places, floor, ceiling, color="lightgrey", linewidth=4, zorder=0)
    panel.plot(floor, places, "o", color="grey", label="floor: random grasps")
    panel.plot(
        ceiling, places, "k|", markersize=14, label="ceiling: a planner that knows the scene"
    )
    ours = [shares[suite, RECORDED] for suite in BOUNDS]
    value, low, high = (
        100 * np.array([one[key] for one in ours]) for key in ("value", "low", "high")
    )
    style: dict[str, Any] = {
        "color": figures.PALETTE[2],
        "label": f"{OURS}, with its 95 % interval",
    }
    panel.errorbar(value, places, xerr=(value - low, high - value), fmt="D", capsize=3, **style)
    panel.axhline(len(NEED_GRASPS) + 0.5, color="black", linewidth=0.6)
    panel.set_yticks(places, BOUNDS)
    panel.set(xlabel="completed episodes, %", xlim=(-2, 102))
    middles = len(NEED_GRASPS) + (len(NEED_PUSHES) + 1) / 2, (len(NEED_GRASPS) + 1) / 2
    for place, text in zip(middles, ("need pushes", "need grasps"), strict=True):
        panel.text(104, place, text, rotation=270, ha="center", va="center")
    figure.legend(loc="outside lower center", ncols=3, fontsize="small")
    return figure


def pushes() -> Figure:
    """Draws what pushes add to completion in each row of H1 and H2 of the second study."""
    named, bands = second_tables.hypotheses(), {}
    for rows in (named["H1"], named["H2"]):
        found = second_tables.judge(index.STUDY, rows)
        for row in rows:
            name = row.name if row.suite in row.name else f"{row.suite}, {row.name}"
            bands[name] = found[row.name].band
    value, low, high = (
        100 * np.array([getattr(band, end) for band in bands.values()])
        for end in ("value", "low", "high")
    )
    figure, panel = plt.subplots(figsize=(8, 2.8), layout="constrained")
    margin, places = 100 * second_tables.MARGIN, range(len(bands), 0, -1)
    panel.axvspan(-margin, margin, color="lightgrey", zorder=0, label="within the margin")
    panel.axvline(0, color="black", linewidth=0.6)
    ends, colour = (value - low, high - value), figures.PALETTE[2]
    panel.errorbar(value, places, xerr=ends, fmt="D", capsize=3, color=colour)
    panel.axhline(len(named["H2"]) + 0.5, color="black", linewidth=0.6)
    panel.set_yticks(places, bands)
    panel.set_xlabel("completion with pushes less that without, points")
    panel.legend(loc="lower right", fontsize="small")
    return figure


def replay() -> Figure:
    """Draws the time to draw 64 transitions and replace their priorities, against capacity."""
    records = {"2-core CPU, busy": _read("replay", "^cpu$"), "H200": _read("replay", "^h200-")}
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
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


def sweeps() -> Iterator[tuple[str, Figure]]:
    """Draws the time of a step against seeds side by side, and the speed-up by several devices."""
    seeds, at = plt.subplots(figsize=(4.8, 3.4), layout="constrained")
    devices, over = plt.subplots(figsize=(4.8, 3.4), layout="constrained")
    most = 1
    for record in _read("sweep"):
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


def _name(record: dict[str, Any]) -> str:
    return f"{record['preset']}, {record['physics']}, {record['device']}"


def _plain_logarithms(panel: Any) -> None:
    """Makes both axes logarithmic, with ticks that show no powers."""
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
    for path in FIGURES.glob("*.png"):
        if path.stem not in shown:
            path.unlink()
    for name, figure in draw():
        if name in shown:
            figures.save(figure, FIGURES / f"{name}.png")
        else:
            plt.close(figure)
