"""The user's folder for cached files. Needs no JAX."""

import os
import stat
from pathlib import Path


def private(*parts: str) -> Path | None:
    """Makes the folder CACHE/csac_jax/PARTS of this user, with mode 0700. CACHE is XDG_CACHE_HOME
    or ~/.cache. Returns None if there is no home, the folder cannot be written, or another user
    owns it or can write into it."""
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        Path(home).mkdir(parents=True, exist_ok=True)
        for number in range(len(parts) + 1):
            folder = Path(home, "csac_jax", *parts[:number])
            folder.mkdir(mode=0o700, exist_ok=True)  # its parents would get the usual mode
            if not _is_private(folder):
                return None
        return folder if os.access(folder, os.W_OK | os.X_OK) else None
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return None


def _is_private(folder: Path) -> bool:
    status = folder.lstat()
    open_to_others = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not open_to_others
