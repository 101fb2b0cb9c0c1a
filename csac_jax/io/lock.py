"""A lock on the folder of a run, so that two processes never write it at once."""

import contextlib
import os
import socket
import warnings
from collections.abc import Iterator
from pathlib import Path

import filelock

from csac_jax.errors import DataWarning, FailedError
from csac_jax.io import files

LOCK = ".lock"
HOLDER = ".lock-holder"


class LockedError(FailedError):
    """A folder that another process is writing; the message names it."""


@contextlib.contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Holds the lock of a folder that exists; it dies with this process.

    Raises LockedError where another process holds it. Warns where the last holder, on another
    host, did not let go: some shared folders know no locks between hosts.
    """
    lock, holder = filelock.FileLock(folder / LOCK), folder / HOLDER
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout:
        raise LockedError(
            f"{folder} is in use by {_said(holder) or 'a process'}; wait until it ends, or stop it"
        ) from None
    host = socket.gethostname()
    if (last := _said(holder)) and not last.endswith(f" on {host}"):
        text = f"{folder} was in use by {last} and not let go; see that it does not run any more"
        warnings.warn(text, DataWarning, stacklevel=3)
    try:
        files.replace(holder, f"process {os.getpid()} on {host}")
        yield
    finally:
        holder.unlink(missing_ok=True)
        lock.release()


def _said(holder: Path) -> str:
    with contextlib.suppress(OSError, UnicodeDecodeError):
        return holder.read_text()
    return ""
