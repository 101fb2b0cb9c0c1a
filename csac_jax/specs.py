"""Shapes, dtypes and bounds of what an environment shows and takes."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import HeightmapConfig
from csac_jax.constants import Primitive
from csac_jax.sim.primitives import Action
from csac_jax.vision.heightmap import VIEW_HEIGHT, Observation


@dataclasses.dataclass(frozen=True, eq=False)
class ArraySpec:
    """Shape, dtype and inclusive bounds of an array."""

    shape: tuple[int, ...]
    dtype: Any  # NumPy's
    minimum: float | np.ndarray  # of all entries, or [*shape] of each
    maximum: float | np.ndarray

    def contains(self, values: jax.Array) -> jax.Array:
        """[] bool, all values [*shape] lie within the bounds; NaN does not."""
        return jnp.all((values >= self.minimum) & (values <= self.maximum))


_Spec: Any = ArraySpec  # stands where a pytree has an array


def observation_spec(cfg: HeightmapConfig) -> Observation:
    """The ArraySpec of each leaf of an observation."""
    rows = (cfg.size, cfg.size)
    return Observation(
        colour=_Spec((*rows, 3), np.float32, 0.0, 1.0),
        height=_Spec(rows, np.float32, 0.0, VIEW_HEIGHT),
        target=_Spec(rows, np.bool_, False, True),
    )


def is_valid(cfg: HeightmapConfig, obs: Observation) -> jax.Array:
    """[] bool, height and colour lie within their bounds."""
    spec: Any = observation_spec(cfg)
    return spec.height.contains(obs.height) & spec.colour.contains(obs.colour)


def action_spec(cfg: HeightmapConfig) -> Action:
    """The ArraySpec of each leaf of an action: x and y in the workspace, m, and yaw, rad."""
    low = np.array([-0.5 * cfg.extent, -0.5 * cfg.extent, 0.0], np.float32)
    high = np.array([0.5 * cfg.extent, 0.5 * cfg.extent, 2.0 * np.pi], np.float32)
    return Action(
        primitive=_Spec((), np.int32, int(min(Primitive)), int(max(Primitive))),
        pose=_Spec((3,), np.float32, low, high),
    )
