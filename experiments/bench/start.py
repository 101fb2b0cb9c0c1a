"""Times how soon a run learns, as JSON: `csac-jax bench start [PRESET] [--runs 5] [--other
CHECKOUT] [SETTINGS]`.

Each run is a process of `csac-jax train PRESET SETTINGS` with an empty cache, which goes to its
end, and another of the same config, stopped at its first action, which finds what the first has
cached. Runs of this checkout and of another one take turns, so that what else the machine does hits
both alike. Times are from the start of the process, s; seed i is run i. The first action begins as
the program is compiled.

Parts: `first_action` with an empty cache, `first_action_cached`, `success` when 90 % of the last
200 grasps lift a block, `end`. The last two leave out what the host does between chunks.
"""

import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import csac_jax
from csac_jax.errors import SettingsError
from experiments.bench._options import Parser, emit, split

HERE = Path(csac_jax.__file__).parents[1]
GRASPS, SHARE = 200, 0.9  # that the run is waited for


def main(arguments: Sequence[str] = ()) -> None:
    """Prints the result."""
    parser = Parser(prog="bench start", allow_abbrev=False)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--other", type=Path)
    preset, options, flags = split(parser, list(arguments))
    checkouts = {"this": HERE}
    if options.other is not None:
        if not (options.other / "csac_jax").is_dir():
            raise SettingsError(f"bench start: --other: {options.other} is no checkout")
        checkouts["other"] = options.other.resolve()
    emit(measure([preset, *flags], options.runs, checkouts))


def measure(train: list[str], runs: int, checkouts: dict[str, Path]) -> dict[str, Any]:
    """Times of every run by checkout, their medians, and how many times sooner this one is."""
    every: dict[str, list[dict[str, Any]]] = {name: [] for name in checkouts}
    for seed, (name, checkout) in itertools.product(range(runs), checkouts.items()):
        every[name].append(_run(train, seed, checkout))
        print(f"{name} {seed}: {every[name][-1]}", file=sys.stderr)
    median = {name: _median(times) for name, times in every.items()}
    result: dict[str, Any] = {"train": train, "runs": every, "median": median}
    if other := median.get("other"):
        pairs = {part: (other[part], after) for part, after in median["this"].items()}
        result["times_sooner"] = {
            part: a / b if a and b else None for part, (a, b) in pairs.items()
        }
    return result | {"load": os.getloadavg()}


def _median(times: list[dict[str, Any]]) -> dict[str, Any]:
    """Computes the median of each part; None if half of the runs never got there."""
    late = float("inf")
    found = {
        part: statistics.median(late if one[part] is None else one[part] for one in times)
        for part in times[0]
    }
    return {part: None if value == late else value for part, value in found.items()}


def _run(train: list[str], seed: int, checkout: Path) -> dict[str, float | None]:
    """Times one run with an empty cache and the start of a second one, s."""
    with tempfile.TemporaryDirectory() as folder:
        first, run_dir = _train(train, seed, checkout, Path(folder), "cold", to_end=True)
        again, _ = _train(train, seed, checkout, Path(folder), "cached", to_end=False)
        log = [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]
    learned = [
        one["seconds"]
        for one in log
        if one["grasps_counted"] >= GRASPS and one["grasp_success"] >= SHARE
    ]
    return {
        "first_action": first,
        "first_action_cached": again,
        "success": first + learned[0] if learned else None,
        "end": first + log[-1]["seconds"],
    }


def _train(
    train: list[str], seed: int, checkout: Path, folder: Path, name: str, to_end: bool
) -> tuple[float, Path]:
    """Trains; returns the seconds to the first action, and the run's folder."""
    run_dir = folder / name
    command = [sys.executable, "-u", "-m", "csac_jax", "train", *train, "--seed", str(seed)]
    without = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    modules = os.pathsep.join([str(checkout), *filter(None, [os.environ.get("PYTHONPATH")])])
    variables = {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": modules}
    begun = time.perf_counter()
    with subprocess.Popen(
        [*command, "--run-dir", str(run_dir)],
        cwd=folder,
        env={**without, **variables},
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("compiled in"):
                seconds = time.perf_counter() - begun
                break
        else:
            raise RuntimeError(f"{checkout}: the run ended before its first action")
        if not to_end:
            process.terminate()
        process.stdout.read()
    return seconds, run_dir
