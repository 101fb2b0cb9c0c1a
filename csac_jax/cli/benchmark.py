"""`csac-jax benchmark`: what ships and its baselines, in every suite."""

import dataclasses
import time
from pathlib import Path
from typing import Literal

from csac_jax.cli import evaluation, output, parsing
from csac_jax.cli.failures import BadArgumentsError

SuiteName = Literal[
    "random10",
    "random30",
    "packed",
    "cases",
    "target",
    "pile",
    "objects_packed",
    "objects10",
    "target_objects",
]
PolicyName = Literal[
    "shipped",
    "shipped_grasp_only",
    "shipped_camera",
    "shipped_clutter",
    "shipped_objects",
    "shipped_target",
    "geometric",
    "random",
    "oracle",
]


@dataclasses.dataclass(frozen=True)
class BenchmarkOptions:
    """Measures the policies that ship and their baselines in every suite, in C MuJoCo. A table is
    written after each; a benchmark that was stopped goes on where it was."""

    out: Path = Path("benchmark")
    """Folder for a file of each policy in each suite, and for all in benchmark.md and .json."""
    share: float = 1.0
    """Share of the episodes, above 0, at most 1."""
    suites: tuple[SuiteName, ...] = ()
    """Only these suites."""
    policies: tuple[PolicyName, ...] = ()
    """Only these policies."""


def run(arguments: list[str]) -> int:
    """Measures, writes and prints; returns the exit code."""
    options = parsing.parse(BenchmarkOptions, arguments, "benchmark")
    if not 0.0 < options.share <= 1.0:
        raise BadArgumentsError("--share: above 0, at most 1")
    from csac_jax.report import benchmark
    from csac_jax.runtime import cache

    cells = list(benchmark.cells(options.share, options.suites, options.policies))
    if not cells:
        raise BadArgumentsError("--policies: none of them can act in these suites")
    if options.out.exists() and not options.out.is_dir():
        raise BadArgumentsError(f"--out: {options.out} is a file; give a folder")
    options.out.mkdir(parents=True, exist_ok=True)  # before hours of work, if it cannot be
    cache.enable()
    for number, cell in enumerate(cells, 1):
        title = f"{number} of {len(cells)}: {cell.policy} in {cell.suite}"
        if benchmark.kept(cell, options.out) is not None:
            print(f"{title}, kept from before", flush=True)
            continue
        begun = time.time()
        with evaluation.progress_bar() as show:
            result = benchmark.measure(cell, show)
        seconds = round(time.time() - begun, 1)
        cell.path(options.out).parent.mkdir(parents=True, exist_ok=True)
        output.write_result(cell.path(options.out), {**result, "seconds": seconds})
        benchmark.write_table(options.out, options.share)
        print(f"{title}, {cell.episodes} episodes of each part, {seconds} s", flush=True)
    print(f"wrote {benchmark.write_table(options.out, options.share)}")
    return 0
