"""A pinhole camera: the depth and colour that it sees, and its pixels as points in space.

The camera looks along its z, x is right and y down in the image; row 0 is the top row. Depth is
along z. A pixel's ray has no unit length: it advances by 1 m in depth per unit of distance.

    eye = camera.make(CameraConfig().scaled(0.5))
    picture = camera.render(eye, solids.place(solids.read(model), data.geom_xpos, data.geom_xmat))
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax.config import CameraConfig
from csac_jax.scene.solids import Solids
from csac_jax.vision import raycast, shade


@struct.dataclass
class Camera:
    """Intrinsics and pose."""

    focal: jax.Array  # [2] px, along the image's width and height
    centre: jax.Array  # [2] px, column and row of the optical axis; pixel centres are whole numbers
    position: jax.Array  # [3] m, world frame
    rotation: jax.Array  # [3, 3] camera to world
    width: int = struct.field(pytree_node=False)  # W, px
    height: int = struct.field(pytree_node=False)  # H, px


@struct.dataclass
class Picture:
    """What a camera sees. H, W = rows and columns of the image."""

    colour: jax.Array  # [H, W, 3] float32, 0 .. 1
    depth: jax.Array  # [H, W] float32 m, along the optical axis; 0 where not valid
    geom: jax.Array  # [H, W] int32, `Hit.geom`; meaningless where not valid
    valid: jax.Array  # [H, W] bool, True if the pixel sees anything


def make(cfg: CameraConfig) -> Camera:
    """The camera of a config."""
    rotation = level_rotation(np.array(cfg.position), np.array(cfg.look_at))
    return Camera(
        focal=jnp.asarray(cfg.focal, jnp.float32),
        centre=jnp.asarray(cfg.centre, jnp.float32),
        position=jnp.asarray(cfg.position, jnp.float32),
        rotation=jnp.asarray(rotation, jnp.float32),
        width=cfg.size[0],
        height=cfg.size[1],
    )


def level_rotation(position: np.ndarray, look_at: np.ndarray) -> np.ndarray:
    """Rotation [3, 3], camera to world, of a camera that looks at a point, its x horizontal."""
    forward = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.array([forward[1], -forward[0], 0.0]) / np.hypot(forward[0], forward[1])
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def directions(camera: Camera) -> jax.Array:
    """Rays [H, W, 3] of all pixels in the world frame, each 1 m long in depth."""
    x = (jnp.arange(camera.width, dtype=jnp.float32) - camera.centre[0]) / camera.focal[0]
    y = (jnp.arange(camera.height, dtype=jnp.float32) - camera.centre[1]) / camera.focal[1]
    right, down, forward = (camera.rotation[:, axis] for axis in range(3))
    across = x[None, :, None] * right[None, None] + y[:, None, None] * down[None, None]
    return across + forward[None, None]


def points(camera: Camera, depth: jax.Array) -> jax.Array:
    """Points [H, W, 3] m in the world frame of the depths [H, W] m of all pixels."""
    return depth[..., None] * directions(camera) + camera.position[None, None]


def cast_rays(camera: Camera, cast: Callable[[jax.Array, jax.Array], Any]) -> Any:
    """`cast`, a function of one ray (origin [3] m, direction [3]), for every pixel: [H, W, ...]."""
    hits = jax.vmap(cast, in_axes=(None, 0))(camera.position, directions(camera).reshape(-1, 3))
    rows = (camera.height, camera.width)
    return jax.tree.map(lambda leaf: leaf.reshape(*rows, *leaf.shape[1:]), hits)


def render(camera: Camera, solids: Solids) -> Picture:
    """The picture of a scene of any geoms, flat shaded."""
    hit = cast_rays(camera, lambda *ray: raycast.cast_solids(solids, *ray))
    own = jnp.asarray(solids.colour).at[jnp.maximum(hit.geom, 0)].get(mode="promise_in_bounds")
    lit = shade.flat(own.reshape(-1, 3), hit.normal.reshape(-1, 3)).reshape(own.shape)
    return Picture(
        colour=jnp.where(hit.valid[..., None], lit, shade.SKY[None, None]),
        depth=jnp.where(hit.valid, hit.distance, 0.0),
        geom=hit.geom,
        valid=hit.valid,
    )
