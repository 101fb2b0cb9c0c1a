"""What more than one command refuses, before anything is started."""

import importlib.util
from pathlib import Path

from csac_jax.cli.failures import BadArgumentsError
from csac_jax.config import Config


def check_seed(seed: int) -> None:
    """Seeds of scenes that training never saw; JAX takes keys from 32 bits."""
    if not 0 <= seed < 2**31 - 1:
        raise BadArgumentsError("--seed: must lie in 0 .. 2147483646")


def check_extra(option: str, module: str, extra: str) -> None:
    """The option needs a module that comes with an extra of the package."""
    if importlib.util.find_spec(module) is None:
        raise BadArgumentsError(f"{option} needs an extra; run: pip install 'csac-jax[{extra}]'")


def check_new(folder: Path | None) -> None:
    """A new run needs a folder that does not exist."""
    if folder is not None and folder.exists():
        raise exists(folder)


def exists(folder: Path) -> BadArgumentsError:
    """The complaint about a run's folder that is there already."""
    return BadArgumentsError(
        f"{folder} exists; give another --run-dir, or go on with it by --resume"
    )


def check_physics(cfg: Config) -> None:
    """Physics that training cannot do here."""
    if cfg.sim.physics == "warp":
        import jax

        if jax.default_backend() != "gpu":
            raise BadArgumentsError(
                "--sim.physics: warp computes on CUDA, and JAX sees none here; leave it at mjx"
            )


def check_host_physics(cfg: Config, devices: int) -> None:
    """C physics serves one device."""
    if cfg.sim.physics == "c" and devices > 1:
        raise BadArgumentsError(
            "--sim.physics: c computes on the host's cores, for one device; "
            "leave out --devices or take mjx"
        )
