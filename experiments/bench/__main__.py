"""Runs the main benchmarks and writes build/bench.md: `python -m experiments.bench [NAME ...]`.

Each one is a process of its own. build/bench.json has everything that they printed.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from csac_jax.io import files
from csac_jax.report import result_tables
from csac_jax.runtime import provenance

BUILD = Path(__file__).resolve().parents[2] / "build"
MAIN = {
    "step": ["quick"],
    "start": ["quick", "--runs", "1"],
    "replay": ["--largest", "16"],
    "sweep": ["quick", "--seeds", "1", "4"],
    "parity": ["--primitives", "64", "--poses", "8"],
}
"""Benchmark -> its arguments."""
PARTS = ("first_action", "first_action_cached", "success", "end")  # of `start`
FIGURES = {
    "step": ("actions_per_second", "step_seconds"),
    "start": tuple(f"median.this.{part}" for part in PARTS),
    "replay": ("capacities.0.median_seconds.beta", "capacities.4.median_seconds.beta"),
    "sweep": ("rows.0.actions_per_second", "rows.1.actions_per_second"),
    "parity": ("piles_of_10.grasp_outcome_equal", "piles_of_10.push_effect_equal"),
}
"""Benchmark -> places of its main figures."""


def measure(name: str, arguments: list[str]) -> dict[str, Any]:
    """Runs a benchmark; returns what it printed, or its last complaint."""
    print(f"bench {name} {' '.join(arguments)}", file=sys.stderr, flush=True)
    begun = time.perf_counter()
    command = [sys.executable, "-m", "csac_jax", "bench", name, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wall = {"wall_seconds": round(time.perf_counter() - begun, 1)}
    if done.returncode:
        return {"failed": (done.stderr.strip().splitlines() or ["no message"])[-1], **wall}
    return {**json.loads(done.stdout), **wall}


def rows(name: str, result: dict[str, Any]) -> list[dict[str, str]]:
    """Returns a row per main figure of a result."""
    places = ("failed",) if "failed" in result else (*FIGURES[name], "wall_seconds")
    return [{"benchmark": name, "figure": one, "value": _text(result, one)} for one in places]


def _text(content: Any, place: str) -> str:
    for key in place.split("."):
        content = content[int(key) if isinstance(content, list) else key]
    return f"{content:.4g}" if isinstance(content, float) else str(content)


def main(names: list[str]) -> int:
    """Measures these benchmarks, by default all; returns the number that failed."""
    found = {name: measure(name, MAIN[name]) for name in names or MAIN}
    record = provenance.record()
    files.write_json(BUILD / "bench.json", {**record, "benchmarks": found})
    table = [row for name, result in found.items() for row in rows(name, result)]
    head = f"# Benchmarks\n\n{record['device']}, commit {record['commit']}\n\n"
    files.replace(BUILD / "bench.md", f"{head}{result_tables.table_text(table)}\n")
    print(BUILD / "bench.md")
    return sum("failed" in result for result in found.values())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
