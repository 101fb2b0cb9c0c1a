"""Faults that are injected by the hundred, and the result of each try.

A fault is a function (tally, rng, tries, folder), named by `@fault`. `make test-faults` injects
all; `make test` a twentieth, in `test_faults.py`. The modules in MODULES register them.
"""

import dataclasses
import importlib
import os
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

MODULES = ("runs", "inputs")  # of this folder
ROOT = Path(__file__).parents[2]  # of the repository
SHARE = 20  # `make test` injects one try in so many
HANG = 10.0  # s: an answer that takes longer, beyond what the work itself needs, is a hang


@dataclasses.dataclass
class Tally:
    """Results of the tries of one fault. All but `tries` must be 0."""

    tries: int = 0
    lost: int = 0  # data that had been saved and could not be had back, or was deleted
    silent: int = 0  # damage that was taken for good data
    tracebacks: int = 0  # an answer of more than one line, or of Python's own
    hangs: int = 0
    remarks: list[str] = dataclasses.field(default_factory=list)  # of each try that went wrong

    def each(self, items: Iterable[Any]) -> Iterator[Any]:
        for item in items:
            self.tries += 1
            yield item

    def check(self, good: Any, kind: str, remark: str) -> None:
        """Counts a try that went wrong; `kind` is one of the names above."""
        if not good:
            setattr(self, kind, getattr(self, kind) + 1)
            self.remarks.append(remark)

    def sound(self, fault: str | None, kind: str, about: str) -> None:
        """Counts a fault that was found, if any."""
        self.check(fault is None, kind, f"{about}: {fault}")

    @property
    def bad(self) -> int:
        return self.lost + self.silent + self.tracebacks + self.hangs


Inject = Callable[[Tally, np.random.Generator, int, Path], None]


@dataclasses.dataclass(frozen=True)
class Fault:
    name: str
    tries: int  # of the whole suite
    inject: Inject
    slow: bool = False  # takes long: no part of it is in `make test`


FAULTS: dict[str, Fault] = {}


class MissingToolError(Exception):
    """A tool that a fault needs, and this machine lacks; the message is the reason."""


def load() -> dict[str, Fault]:
    for name in MODULES:
        importlib.import_module(f"tests.faults.{name}")
    return FAULTS


def run(one: Fault, tries: int, folder: Path, seed: int | None = None) -> Tally:
    """Injects a fault; its tries are the same at every call with the same seed."""
    tally, name = Tally(), zlib.crc32(one.name.encode())
    rng = np.random.default_rng([name] if seed is None else [name, seed])
    one.inject(tally, rng, tries, folder)
    return tally


def fault(name: str, tries: int, slow: bool = False) -> Callable[[Inject], Inject]:
    """Registers a function as the fault `name`, which the whole suite injects `tries` times."""

    def register(inject: Inject) -> Inject:
        FAULTS[name] = Fault(name, tries, inject, slow)
        return inject

    return register


@dataclasses.dataclass(frozen=True)
class Answer:
    code: int | None  # None where it hung
    output: str
    errors: str


def start(arguments: Sequence[str], prefix: Sequence[str] = ()) -> subprocess.Popen[str]:
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    quiet = {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "0", "PYTHONPATH": path}
    return subprocess.Popen(
        [*prefix, sys.executable, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        cwd=ROOT,
        env={**os.environ, **quiet},
    )


def wait(process: subprocess.Popen[str], limit: float) -> Answer:
    try:
        output, errors = process.communicate(timeout=limit)
        return Answer(process.returncode, output, errors)
    except subprocess.TimeoutExpired:
        process.kill()
        return Answer(None, *process.communicate())


def judge(tally: Tally, answer: Answer, about: str) -> None:
    tally.check(answer.code is not None, "hangs", f"{about}: hung")
    broken = "Traceback (most recent call last)" in answer.errors
    tally.check(not broken, "tracebacks", f"{about}: {answer.errors.strip().splitlines()[-1:]}")


def refused(
    tally: Tally, about: str, call: Callable[[], object], expected: type[Exception] | tuple
) -> None:
    """Counts a call that does not raise `expected` with one line: silent, traceback or hang."""
    begun = time.monotonic()
    try:
        call()
        tally.check(False, "silent", f"{about}: taken")
    except expected as error:
        lines = str(error).count("\n")
        tally.check(not lines, "tracebacks", f"{about}: more than one line: {str(error)!r}")
    except Exception as error:
        tally.check(False, "tracebacks", f"{about}: {type(error).__name__}: {error}")
    took = time.monotonic() - begun
    tally.check(took <= HANG, "hangs", f"{about}: took more than {HANG:.0f} s")


def works(tally: Tally, about: str, call: Callable[[], Any], kind: str = "lost") -> Any:
    """Returns the result of a call that must not raise; counts an error and returns None."""
    try:
        return call()
    except Exception as error:
        tally.check(False, kind, f"{about}: {type(error).__name__}: {error}")
        return None


DAMAGES = ("bit flips", "truncations", "zeroed blocks")


def damage(rng: np.random.Generator, kind: str, path: Path) -> str:
    """Damages a file of at least one byte in place; returns a description. Its bytes differ."""
    data = bytearray(path.read_bytes())
    before = bytes(data)
    where = int(rng.integers(len(data)))
    if kind == "bit flips":
        data[where] ^= 1 << int(rng.integers(8))
    elif kind == "truncations":
        del data[where:]
    else:
        size = int(rng.integers(1, 513))
        data[where : where + size] = bytes(len(data[where : where + size]))
        if bytes(data) == before:  # they were zeros
            data[where] = 1
    path.write_bytes(data)
    return f"{kind} of {path.name} at byte {where}"


def table(tallies: Iterable[tuple[str, Tally]]) -> str:
    lines = [
        "| fault | tries | lost | silent | tracebacks | hangs |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for name, tally in tallies:
        numbers = (tally.tries, tally.lost, tally.silent, tally.tracebacks, tally.hangs)
        lines.append(f"| {name} | {' | '.join(map(str, numbers))} |")
    return "\n".join(lines) + "\n"
