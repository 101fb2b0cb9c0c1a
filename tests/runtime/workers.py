"""Work for processes of a pool."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import jax


def where(
    report: Callable[..., None], name: str, folder: Path, others: int
) -> tuple[str, set[int], int, str]:
    """Reports its name twice; returns it, the cores, the process and JAX's backend.

    It waits until so many processes have begun, which leave their numbers in the folder.
    """
    (folder / str(os.getpid())).touch()
    report(name, 1)
    report(name, 2)
    while len(list(folder.iterdir())) < others:
        time.sleep(0.02)
    return name, os.sched_getaffinity(0), os.getpid(), jax.default_backend()


def fails(report: Callable[..., None], name: str, *more: object) -> None:
    """Raises a ValueError."""
    raise ValueError(name)


def is_killed(report: Callable[..., None], name: str, *more: object) -> None:
    """Ends as a process does for which no memory is left."""
    os.kill(os.getpid(), signal.SIGKILL)


def waits(report: Callable[..., None], folder: Path) -> None:
    """Leaves its number in the folder, then works for longer than any test."""
    (folder / str(os.getpid())).touch()
    time.sleep(600)
