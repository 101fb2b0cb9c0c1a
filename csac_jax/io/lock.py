"""A lock on the folder of a run: two processes never write it at once."""

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
    """A folder that another process writes; the message names the process."""


@contextlib.contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Holds the lock of an existing folder; the lock ends with this process.

    Raises LockedError if another process holds it. Warns if the last holder, on another host, did
    not release it: some shared folders have no locks between hosts.
    """
    lock, holder = filelock.FileLock(files.inside(folder, LOCK)), folder / HOLDER
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout:
        user = _name_of(holder) or "a process"
        raise LockedError(f"{folder} is in use by {user}; wait until it ends, or stop it") from None
    host = socket.gethostname()
    if (last := _name_of(holder)) and not last.endswith(f" on {host}"):
        text = f"{folder} was in use by {last} and not released; check that it does not run"
        warnings.warn(text, DataWarning, stacklevel=3)
    try:
        files.remove_drafts(folder)
        files.replace(holder, f"process {os.getpid()} on {host}")
        yield
    finally:
        holder.unlink(missing_ok=True)
        lock.release()


def _name_of(path: Path) -> str:
    with contextlib.suppress(OSError, UnicodeDecodeError):
        return path.read_text()
    return ""
