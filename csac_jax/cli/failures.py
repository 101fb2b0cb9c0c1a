"""How a command ends badly, one line on stderr and an exit code; what several commands refuse."""

import contextlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path

from csac_jax import grippers
from csac_jax.config import Config
from csac_jax.errors import SettingsError

PROGRAM = "csac-jax"


class BadArgumentsError(Exception):
    """What was asked for cannot be done; exit code 2. The message is one line with the remedy."""


@contextlib.contextmanager
def as_bad_arguments(*kinds: type[Exception]) -> Iterator[None]:
    """Errors of these kinds in the block are BadArgumentsErrors of the same message."""
    try:
        yield
    except kinds as error:
        raise BadArgumentsError(str(error)) from None


def complain(code: int, error: object) -> int:
    """Prints the one line; returns the exit code."""
    print(f"{PROGRAM}: {' '.join(str(error).split())}", file=sys.stderr)
    return code


def check_seed(seed: int) -> None:
    """Seeds of scenes that training never saw; JAX takes keys from 32 bits."""
    if not 0 <= seed < 2**31 - 1:
        raise BadArgumentsError("--seed: must lie in 0 .. 2147483646")


def check_extra(option: str, module: str, extra: str) -> None:
    """The option needs a module that comes with an extra of the package."""
    if importlib.util.find_spec(module) is None:
        raise BadArgumentsError(f"{option} needs an extra; run: pip install 'csac-jax[{extra}]'")


def exists(folder: Path) -> BadArgumentsError:
    """The complaint about a run's folder that is there already."""
    return BadArgumentsError(
        f"{folder} exists; give another --run-dir, or go on with it by --resume"
    )


def check_physics(cfg: Config, devices: int = 1) -> None:
    """The gripper is known, C MuJoCo serves one device, Warp needs CUDA."""
    with as_bad_arguments(SettingsError):
        grippers.load(cfg.sim.gripper)
    if cfg.sim.physics == "c" and devices > 1:
        raise BadArgumentsError(
            "--sim.physics: c computes on the host's cores, for one device; "
            "leave out --devices or take mjx"
        )
    if cfg.sim.physics == "warp":
        import jax

        if jax.default_backend() != "gpu":
            raise BadArgumentsError(
                "--sim.physics: warp computes on CUDA, and JAX sees none here; leave it at mjx"
            )
