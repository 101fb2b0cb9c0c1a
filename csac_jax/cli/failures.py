"""Errors of a command: one line on stderr and an exit code; checks that several commands share."""

import importlib.util
import sys
from pathlib import Path

from csac_jax import grippers
from csac_jax.cli.parsing import PROGRAM
from csac_jax.config import Config
from csac_jax.errors import SettingsError
from csac_jax.section import require


def complain(code: int, error: object) -> int:
    """Prints an error in one line; returns the exit code."""
    print(f"{PROGRAM}: {' '.join(str(error).split())}", file=sys.stderr)
    return code


def check_seed(seed: int) -> None:
    """Raises SettingsError for a seed that is no key of JAX, of 32 bits."""
    require(0 <= seed < 2**31 - 1, "--seed: must lie in 0 .. 2147483646")


def check_extra(option: str, module: str, extra: str) -> None:
    """Raises SettingsError if the module that an option needs is not installed."""
    remedy = f"run: pip install 'csac-jax[{extra}]'"
    require(importlib.util.find_spec(module) is not None, f"{option} needs an extra; {remedy}")


def exists(folder: Path) -> SettingsError:
    """Returns the error about the folder of a run that exists already."""
    return SettingsError(f"{folder} exists; give another --run-dir, or continue it by --resume")


def check_physics(cfg: Config, devices: int = 1) -> None:
    """Raises SettingsError for an unknown gripper, or physics that these devices cannot run."""
    grippers.load(cfg.sim.gripper)
    text = "c computes on the host's cores, for one device; leave out --devices or take mjx"
    require(cfg.sim.physics != "c" or devices == 1, f"--sim.physics: {text}")
    if cfg.sim.physics == "warp":
        import jax

        text = "warp computes on CUDA, and JAX sees none here; leave it at mjx"
        require(jax.default_backend() == "gpu", f"--sim.physics: {text}")
