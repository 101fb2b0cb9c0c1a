"""Where a result comes from: versions, device, commit."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

import jax

PACKAGES = (
    "csac-jax",
    "jax",
    "jaxlib",
    "mujoco",
    "mujoco-mjx",
    "flax",
    "optax",
    "orbax-checkpoint",
    "numpy",
)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that can change a result, or "missing"."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "missing"
    return found


def device() -> str:
    """JAX's devices as text."""
    devices = jax.devices()
    return f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform})"


def commit() -> str | None:
    """Commit of the package's checkout, with "-dirty" if files differ from it; None without one.

    CSAC_JAX_COMMIT replaces it: in a container the sources come without their history.
    """
    if named := os.environ.get("CSAC_JAX_COMMIT"):
        return named
    folder = Path(__file__).resolve().parent
    root = _git(folder, "rev-parse", "--show-toplevel")
    own = Path(root or "") / "csac_jax" / "runtime" / "provenance.py"
    if root is None or not (own.is_file() and own.samefile(__file__)):
        return None  # installed into some other project's checkout
    name = _git(folder, "rev-parse", "HEAD")
    return name and name + (
        "-dirty" if _git(folder, "status", "--porcelain", "--untracked-files=no") else ""
    )


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def record() -> dict[str, object]:
    """All of it, for a result's JSON."""
    return {"device": device(), "versions": versions(), "commit": commit()}
