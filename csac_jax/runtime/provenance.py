"""Provenance of a result: versions, device, commit."""

import contextlib
import importlib.metadata
import os
import platform
import subprocess
import warnings
from pathlib import Path
from typing import Any

import jax

from csac_jax._version import __version__
from csac_jax.errors import DataWarning
from csac_jax.runtime import modules

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "orbax-checkpoint", "numpy")


def versions() -> dict[str, str]:
    """Returns the versions of Python and of the packages that can change a result."""
    installed = {"python": platform.python_version(), "csac-jax": __version__}
    for name in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            installed[name] = importlib.metadata.version(name)  # policies act without MuJoCo
    return installed


def warn_if_other(stored: Any, what: str) -> None:
    """Warns if `what` was made by versions, see `versions`, that may compute other numbers."""
    now = versions()
    for name in ("csac-jax", "jax", "mujoco"):
        was = stored.get(name) if isinstance(stored, dict) else None
        if was is not None and was != now.get(name, was):
            text = f"{what} was made with {name} {was}, this is {now[name]}: results may differ"
            warnings.warn(text, DataWarning, stacklevel=3)


def device() -> str:
    """Describes JAX's devices."""
    devices = jax.devices()
    return f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform})"


def commit() -> str | None:
    """Returns the commit of the package's checkout, with "-dirty" if files differ; else None.
    CSAC_JAX_COMMIT replaces it, for containers that have no history."""
    if named := os.environ.get("CSAC_JAX_COMMIT"):
        return named
    folder = Path(__file__).resolve().parent
    if _git(folder, "ls-files", Path(__file__).name) is None:
        return None  # installed into some other project's checkout
    return _git(folder, "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*")


def _git(folder: Path, *arguments: str) -> str | None:
    command = ["git", "-C", str(folder), *arguments]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=10)
        return done.stdout.strip() or None
    return None


def record() -> dict[str, object]:
    """Returns device, versions and commit, for a result's JSON, and modules of one's own."""
    known: dict[str, object] = {"device": device(), "versions": versions(), "commit": commit()}
    own = modules.digests()
    return {**known, "modules": own} if own else known
