"""Faults that are injected by the hundred, and what came of each try.

A fault is a function (rng, tries, folder) -> Tally, named by `@fault`. `make test-faults` injects
all; `make test` a tenth, in `test_faults.py`. The modules in MODULES register them.
"""

import dataclasses
import importlib
import importlib.util
import os
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

MODULES = ("runs", "inputs")  # of this folder
ROOT = Path(__file__).parents[2]  # of the repository
SHARE = 10  # `make test` injects one try in so many

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

    def count(self, kind: str, remark: str) -> None:
        """A try that went wrong; `kind` is one of the names above."""
        setattr(self, kind, getattr(self, kind) + 1)
        self.remarks.append(remark)

    @property
    def bad(self) -> int:
        return self.lost + self.silent + self.tracebacks + self.hangs


@dataclasses.dataclass(frozen=True)
class Fault:
    """A kind of fault."""

    name: str
    tries: int  # of the whole suite
    inject: Callable[[np.random.Generator, int, Path], Tally]
    slow: bool = False  # takes long: no part of it is in `make test`


FAULTS: dict[str, Fault] = {}


class MissingToolError(Exception):
    """What a fault needs, and this machine lacks; the message is the reason."""


def load() -> dict[str, Fault]:
    """All faults, by name."""
    for name in MODULES:
        if importlib.util.find_spec(f"tests.faults.{name}") is not None:
            importlib.import_module(f"tests.faults.{name}")
    return FAULTS


def run(one: Fault, tries: int, folder: Path) -> Tally:
    """Injects a fault; its tries are the same at every call."""
    return one.inject(np.random.default_rng(zlib.crc32(one.name.encode())), tries, folder)


def fault(name: str, tries: int, slow: bool = False) -> Callable[..., Callable[..., Tally]]:
    """Registers a function as the fault `name`, which the whole suite injects `tries` times."""

    def register(inject: Callable[..., Tally]) -> Callable[..., Tally]:
        FAULTS[name] = Fault(name, tries, inject, slow)
        return inject

    return register


@dataclasses.dataclass(frozen=True)
class Answer:
    """How a process ended."""

    code: int | None  # None where it hung
    output: str
    errors: str
    seconds: float


def command(
    arguments: Sequence[str],
    limit: float,
    env: dict[str, str] | None = None,
    folder: Path = ROOT,
    prefix: Sequence[str] = (),
) -> Answer:
    """Runs `python ARGUMENTS` in a folder; it hangs if it takes longer than `limit` s.

    Args: env, variables beyond this process's; prefix, a program that starts Python, as strace.
    """
    process = start(arguments, env, folder, prefix)
    return wait(process, limit)


def start(
    arguments: Sequence[str],
    env: dict[str, str] | None = None,
    folder: Path = ROOT,
    prefix: Sequence[str] = (),
) -> subprocess.Popen[str]:
    """Starts what `command` runs."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    quiet = {"JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "0", "PYTHONPATH": path}
    return subprocess.Popen(
        [*prefix, sys.executable, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        cwd=folder,
        env={**os.environ, **quiet, **(env or {})},
    )


def wait(process: subprocess.Popen[str], limit: float) -> Answer:
    """How a process ends; it is killed after `limit` s."""
    begun = time.monotonic()
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
        tally.count("hangs", f"{about}: hung")
    elif "Traceback (most recent call last)" in answer.errors:
        tally.count("tracebacks", f"{about}: {answer.errors.strip().splitlines()[-1]}")


def refused(
    tally: Tally, about: str, call: Callable[[], object], expected: type[Exception] | tuple
) -> None:
    """Counts a call that does not raise `expected` with one line: silent, traceback or hang."""
    begun = time.monotonic()
    try:
        call()
        tally.count("silent", f"{about}: taken")
    except expected as error:
        if "\n" in str(error):
            tally.count("tracebacks", f"{about}: more than one line: {str(error)!r}")
    except Exception as error:
        tally.count("tracebacks", f"{about}: {type(error).__name__}: {error}")
    if time.monotonic() - begun > HANG:
        tally.count("hangs", f"{about}: took more than {HANG:.0f} s")


DAMAGES = ("bit flips", "truncations", "zeroed blocks")


def damage(rng: np.random.Generator, kind: str, path: Path) -> str:
    """Damages a file of at least one byte in place, in words; its bytes are sure to differ."""
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
    """The results as a Markdown table."""
    lines = [
        "| fault | tries | lost | silent | tracebacks | hangs |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for name, tally in tallies:
        numbers = (tally.tries, tally.lost, tally.silent, tally.tracebacks, tally.hangs)
        lines.append(f"| {name} | {' | '.join(map(str, numbers))} |")
    return "\n".join(lines) + "\n"
