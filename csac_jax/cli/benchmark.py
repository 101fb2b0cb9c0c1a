"""`csac-jax benchmark`: what ships and its baselines, in every suite."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from csac_jax.cli import output, parsing
from csac_jax.cli.failures import BadArgumentsError
from csac_jax.runtime import processes

if TYPE_CHECKING:
    from csac_jax.report.benchmark import Cell

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
    jobs: int = 0
    """Cells of the table at a time, each on a core of its own; 0 for one per core. One at a time
    has all cores, or the GPU."""


def run(arguments: list[str]) -> int:
    """Measures, writes and prints; returns the exit code."""
    options = parsing.parse(BenchmarkOptions, arguments, "benchmark")
    if not 0.0 < options.share <= 1.0:
        raise BadArgumentsError("--share: above 0, at most 1")
    if not 0 <= options.jobs <= 1024:
        raise BadArgumentsError("--jobs: must lie in 0 .. 1024")
    from csac_jax.report import benchmark

    cells = list(benchmark.cells(options.share, options.suites, options.policies))
    if not cells:
        raise BadArgumentsError("--policies: none of them can act in these suites")
    if options.out.exists() and not options.out.is_dir():
        raise BadArgumentsError(f"--out: {options.out} is a file; give a folder")
    options.out.mkdir(parents=True, exist_ok=True)  # before hours of work, if it cannot be
    begun, waiting = time.time(), []
    for number, cell in enumerate(cells, 1):
        title = f"{number} of {len(cells)}: {cell.policy} in {cell.suite}"
        if benchmark.kept(cell, options.out) is None:
            waiting.append((title, cell))
        else:
            print(f"{title}, kept from before", flush=True)

    def finish(number: int, seconds: float) -> None:
        title, cell = waiting[number]
        benchmark.write_table(options.out, options.share)
        print(f"{title}, {cell.episodes} episodes of each part, {seconds} s", flush=True)

    tasks = [(cell, options.out) for _, cell in waiting]
    with _bars() as show:
        processes.each(_measure, tasks, options.jobs or processes.cores(), show, finish)
    minutes = round((time.time() - begun) / 60, 1)
    print(f"wrote {benchmark.write_table(options.out, options.share)}, {minutes} minutes")
    return 0


def _measure(say: Callable[..., None], cell: "Cell", out: Path) -> float:
    """Measures a cell and keeps it; returns the seconds."""
    from csac_jax.report import benchmark
    from csac_jax.runtime import cache

    cache.enable()
    begun, title = time.time(), f"{cell.policy} in {cell.suite}"
    result = benchmark.measure(cell, lambda *progress: say(title, *progress))
    seconds = round(time.time() - begun, 1)
    cell.path(out).parent.mkdir(parents=True, exist_ok=True)
    output.write_result(cell.path(out), {**result, "seconds": seconds})
    return seconds


@contextlib.contextmanager
def _bars() -> Iterator[Callable[[str, str, int, int], None]]:
    """A line on the terminal for each cell in work; nothing elsewhere."""
    from rich.progress import TaskID

    with output.progress() as progress:
        lines: dict[str, TaskID] = {}

        def show(title: str, part: str, finished: int, episodes: int) -> None:
            if title not in lines:
                lines[title] = progress.add_task("")
            progress.update(
                lines[title],
                description=f"{title}, {part}",
                completed=finished,
                total=episodes,
                visible=finished < episodes,
            )

        yield show
