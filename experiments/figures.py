"""Figures of recorded results, drawn anew by `make figures` into docs/figures: the samplers' speed,
and whatever `csac-jax report experiments/results` draws."""

import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # no display
import matplotlib.pyplot as plt
from matplotlib import ticker

from csac_jax.report import charts, report, results

ROOT = Path(__file__).resolve().parents[1]
RESULTS, FIGURES = ROOT / "experiments" / "results", ROOT / "docs" / "figures"
SAMPLERS = {
    "uniform": "uniform",
    "prioritised": "prioritised",
    "beta": "beta",
    "flashbax": "prioritised, flashbax",
}


def _read(*names: str) -> list[dict[str, Any]]:
    return [json.loads((RESULTS / name).read_text()) for name in names]


def replay() -> None:
    """Time to draw 64 transitions and replace their priorities against the ring's capacity, on a
    CPU and a GPU."""
    records = {
        "2-core CPU, busy": _read("bench-replay-cpu.json"),
        "H200": _read("bench-replay-h200-12.json", "bench-replay-h200-18.json"),
    }
    figure, panels = plt.subplots(
        1, len(records), figsize=(9, 3.4), sharey=True, layout="constrained"
    )
    for panel, (device, parts) in zip(panels, records.items(), strict=True):
        rows = [row for part in parts for row in part["capacities"]]
        for name, label in SAMPLERS.items():
            microseconds = [1e6 * row["median_seconds"][name] for row in rows]
            panel.plot([row["capacity"] for row in rows], microseconds, "o-", label=label)
        panel.set(title=device, xlabel="capacity, transitions", xscale="log", yscale="log")
        panel.set_xscale("log", base=2)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("median per step, \N{MICRO SIGN}s")
    panels[1].legend()
    figure.savefig(FIGURES / "replay.png", dpi=110, metadata={"Software": None})


CURVES = {
    "scenes": "scenes side by side",
    "blocks": "blocks on the table",
    "map": "cells along a side of the map",
    "capacity": "capacity of the replay, transitions",
}


def steps() -> None:
    """Time of a training step against what grows, one figure for each curve that `bench step
    --curve` recorded."""
    for curve, label in CURVES.items():
        records = [
            json.loads(path.read_text())
            for path in sorted(RESULTS.glob(f"bench-step-*-{curve}.json"))
        ]
        if not records:
            continue
        figure, panel = plt.subplots(figsize=(4.8, 3.4), layout="constrained")
        power = 2 if curve == "map" else 1
        for record in records:
            points = record["points"]
            what = f"{record['preset']}, {record['physics']}, {record['device']}"
            sizes, seconds = zip(*((p[curve], p["step_seconds"]) for p in points), strict=True)
            panel.plot(sizes, seconds, "o-", label=what)
            grown = [seconds[0] * (size / sizes[0]) ** power for size in sizes]
            panel.plot(
                sizes, grown, ":", color="grey", label="in proportion" + " to cells" * (power == 2)
            )
        panel.set(xlabel=label, ylabel="time of a training step, s", yscale="log")
        panel.set_xscale("log", base=2)
        _plain_numbers(panel)
        panel.grid(alpha=0.3)
        panel.legend(fontsize="small")
        figure.savefig(FIGURES / f"step-{curve}.png", dpi=110, metadata={"Software": None})
        plt.close(figure)


def _plain_numbers(panel: Any) -> None:
    """Ticks of logarithmic axes without powers."""
    panel.xaxis.set_major_formatter("{x:g}")
    panel.yaxis.set_major_formatter("{x:g}")
    panel.yaxis.set_minor_locator(ticker.LogLocator(subs=(2.0, 5.0)))
    panel.yaxis.set_minor_formatter("{x:g}")


def sweeps() -> None:
    """Time of a step against seeds side by side, and by how much several devices are faster than
    one."""
    records = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("bench-sweep-*.json"))]
    seeds, at = plt.subplots(figsize=(4.8, 3.4), layout="constrained")
    devices, over = plt.subplots(figsize=(4.8, 3.4), layout="constrained")
    for record in records:
        rows, name = record["rows"], f"{record['preset']}, {record['physics']}, {record['device']}"
        alone = [row for row in rows if row["devices"] == 1]
        if len(alone) > 1:
            at.plot(
                [row["seeds"] for row in alone],
                [row["seconds"] / record["steps"] for row in alone],
                "o-",
                label=name,
            )
        if len(alone) < len(rows):
            name = f"{record['shard']}: {rows[0]['seeds']} x {record['scenes']} scenes, {record['preset']}"
            times = [rows[0]["seconds"] / row["seconds"] for row in rows]
            over.plot([row["devices"] for row in rows], times, "o-", label=name)
    at.set(xlabel="seeds side by side", ylabel="time of a training step, s", yscale="log")
    at.set_xscale("log", base=2)
    _plain_numbers(at)
    most = max((row["devices"] for record in records for row in record["rows"]), default=1)
    over.plot([1, most], [1, most], ":", color="grey", label="as many times as devices")
    over.set(xlabel="devices", ylabel="times as fast as one", xticks=range(1, most + 1))
    for panel, figure, name in ((at, seeds, "step-seeds"), (over, devices, "step-devices")):
        panel.grid(alpha=0.3)
        panel.legend(fontsize="small")
        figure.savefig(FIGURES / f"{name}.png", dpi=110, metadata={"Software": None})
        plt.close(figure)


if __name__ == "__main__":
    FIGURES.mkdir(exist_ok=True)
    replay()
    steps()
    sweeps()
    charts.save(report.build(results.read([RESULTS])), FIGURES)
