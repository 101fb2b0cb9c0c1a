"""Faults that are injected by the hundred, and what came of each try.

A fault is a function (rng, tries, folder) -> Tally, named by `@fault`. `make test-faults` injects
all; `make test` a tenth, in `test_faults.py`.
"""

import dataclasses
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

HANG = 10.0  # s: an answer that takes longer, beyond what the work itself needs, is a hang


@dataclasses.dataclass
class Tally:
    """What came of the tries of one fault. All but `tries` are to be 0."""

    tries: int = 0
    lost: int = 0  # data that had been saved and could not be had back, or was deleted
    silent: int = 0  # damage that was taken for good data
    tracebacks: int = 0  # an answer of more than one line, or of Python's own
    hangs: int = 0
    remarks: list[str] = dataclasses.field(default_factory=list)  # of each try that went wrong

    @property
    def bad(self) -> int:
        return self.lost + self.silent + self.tracebacks + self.hangs


@dataclasses.dataclass(frozen=True)
class Fault:
    """A kind of fault."""

    name: str
    tries: int  # of the whole suite
    inject: Callable[[np.random.Generator, int, Path], Tally]


FAULTS: dict[str, Fault] = {}


def fault(name: str, tries: int) -> Callable[..., Callable[..., Tally]]:
    """Registers a function as the fault `name`, which the whole suite injects `tries` times."""

    def register(inject: Callable[..., Tally]) -> Callable[..., Tally]:
        FAULTS[name] = Fault(name, tries, inject)
        return inject

    return register


@dataclasses.dataclass(frozen=True)
class Answer:
    """How a process ended."""

    code: int | None  # None where it hung
    output: str
    errors: str
    seconds: float


def command(arguments: Sequence[str], limit: float) -> Answer:
    """Runs `python ARGUMENTS`; it hangs if it takes longer than `limit` s."""
    begun = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        output, errors = process.communicate(timeout=limit)
        return Answer(process.returncode, output, errors, time.monotonic() - begun)
    except subprocess.TimeoutExpired:
        process.kill()
        output, errors = process.communicate()
        return Answer(None, output, errors, time.monotonic() - begun)


def judge(tally: Tally, answer: Answer, about: str) -> None:
    """Counts an answer that hung or has a traceback."""
    if answer.code is None:
        tally.hangs += 1
        tally.remarks.append(f"{about}: hung")
    elif "Traceback (most recent call last)" in answer.errors:
        tally.tracebacks += 1
        tally.remarks.append(f"{about}: {answer.errors.strip().splitlines()[-1]}")


def table(tallies: Iterable[tuple[str, Tally]]) -> str:
    """The results as a Markdown table."""
    lines = [
        "| fault | tries | lost | silent | tracebacks | hangs |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for name, tally in tallies:
        numbers = (tally.tries, tally.lost, tally.silent, tally.tracebacks, tally.hangs)
        lines.append(f"| {name} | {' | '.join(map(str, numbers))} |")
    return "\n".join(lines) + "\n"
