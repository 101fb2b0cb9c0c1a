"""The devices that JAX computes on."""

import os
from typing import Literal

import jax

from csac_jax.errors import DeviceError

_PLATFORMS = {"cpu": "cpu", "gpu": "cuda,cpu"}  # C physics is called back on the CPU


def select(name: Literal["cpu", "gpu"]) -> None:
    """Chooses the CPU or GPUs, before JAX is used. Raises DeviceError if there is none."""
    jax.config.update("jax_platforms", _PLATFORMS[name])
    require(name)


def require(name: str | None = None) -> None:
    """Raises DeviceError unless JAX has a device, one of this kind if named."""
    try:
        used = jax.default_backend()
    except (RuntimeError, AssertionError):  # JAX asserts that one of JAX_PLATFORMS is there
        asked = os.environ.get("JAX_PLATFORMS") or jax.config.jax_platforms
        raise DeviceError(
            f"JAX finds no device of JAX_PLATFORMS={asked}; unset it, or set it to cpu"
        ) from None
    if name not in (None, used):
        raise DeviceError(f"device {name}: JAX finds none here; leave it out for the {used}")
