"""A policy as one file for other programs: StableHLO, which needs jax alone.

A file holds a function of plain arrays with the networks in it. From maps, as training sees them:

    colour [H, W, 3] float32 in 0 .. 1, height [H, W] float32 m, target [H, W] bool

`target` only in the task `target`. From an image of a lens without distortion:

    rgb [h, w, 3] uint8, depth [h, w] float32 m, 0 where it is missing,
    lens [4] float32 fx fy cx cy px, pose [4, 4] float32 camera to workspace, mask [h, w] bool

It returns primitive [] int32 (0 push, 1 grasp), pose [3] (x m, y m, yaw rad), score [], valid []
bool, stations [4, 5] (x, y, z m, yaw rad, half the opening m; see `decision.STATIONS`).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.agent.actor_critic import Params
from csac_jax.config import Config
from csac_jax.deploy import decision
from csac_jax.vision import depth_camera
from csac_jax.vision.heightmap import Observation

Outputs = tuple[jax.Array, ...]  # see above
_ARRAY = jax.ShapeDtypeStruct


def map_shapes(cfg: Config) -> tuple[Any, ...]:
    """Returns the shapes of the arguments of `from_maps`."""
    rows = (cfg.heightmap.size,) * 2
    shapes = _ARRAY((*rows, 3), np.float32), _ARRAY(rows, np.float32), _ARRAY(rows, np.bool_)
    return shapes if cfg.task.has_target else shapes[:2]


def from_maps(cfg: Config, params: Params) -> tuple[Callable[..., Outputs], tuple[Any, ...]]:
    """Returns the policy as a function of maps, and the shapes of its arguments."""

    def decide(colour: jax.Array, height: jax.Array, *target: jax.Array) -> Outputs:
        marked = target[0] if target else jnp.ones(height.shape, bool)
        obs = Observation(colour, height, marked, decision.fingers(cfg))
        return _outputs(cfg, params, obs)

    return decide, map_shapes(cfg)


def from_image(
    cfg: Config, params: Params, size: tuple[int, int]
) -> tuple[Callable[..., Outputs], tuple[Any, ...]]:
    """Returns the policy as a function of an image, and the shapes of its arguments.

    It does not check that the image fits the pose. Args: size, width and height of the image, px.
    """

    def decide(
        rgb: jax.Array, depth: jax.Array, lens: jax.Array, pose: jax.Array, *mask: jax.Array
    ) -> Outputs:
        points = _points(depth, lens, pose).reshape(-1, 3)
        marked = mask[0].reshape(-1) if mask else None
        colour, valid = rgb.reshape(-1, 3), depth_camera.supported(depth, lens[0]).reshape(-1)
        return _outputs(cfg, params, decision.observe(cfg, points, valid, colour, marked))

    rows = size[::-1]
    floats = [_ARRAY(shape, np.float32) for shape in (rows, (4,), (4, 4))]
    shapes = _ARRAY((*rows, 3), np.uint8), *floats, _ARRAY(rows, np.bool_)
    return decide, shapes if cfg.task.has_target else shapes[:4]


def _points(depth: jax.Array, lens: jax.Array, pose: jax.Array) -> jax.Array:
    """Returns the points [h, w, 3] m of all pixels in the workspace's frame."""
    rows, cols = depth.shape
    u, v = jnp.arange(cols, dtype=jnp.float32), jnp.arange(rows, dtype=jnp.float32)
    x, y = jnp.meshgrid((u - lens[2]) / lens[0], (v - lens[3]) / lens[1])
    right, down, forward, place = (axis[None, None] for axis in pose[:3].T)
    return depth[..., None] * (x[..., None] * right + y[..., None] * down + forward) + place


def _outputs(cfg: Config, params: Params, obs: Observation) -> Outputs:
    state = decision.dense_maps(cfg, params, obs, cfg.task.has_target)
    choice, _ = decision.choose(cfg, state, obs.height)
    action = choice.action
    return action.primitive, action.pose, choice.score, choice.valid, choice.stations


def serialize(decide: Callable[..., Outputs], shapes: tuple[Any, ...]) -> bytes:
    """Writes a function for the kind of device that JAX has here; `jax.export.deserialize` reads
    it."""
    return bytes(jax.export.export(jax.jit(decide))(*shapes).serialize())
