"""A pinhole camera: the depth and colour that it sees, and its pixels as points in space.

The camera looks along its z, x is right and y down in the image; row 0 is the top row. Depth is
along z. A pixel's ray has no unit length: it advances by 1 m in depth per unit of distance.

    eye = camera.make(CameraConfig().scaled(0.5))
    picture = camera.render(eye, solids.place(geoms.read(model), data.geom_xpos, data.geom_xmat))
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax.config import CameraConfig
from csac_jax.scene.solids import Solids
from csac_jax.vision import raycast

LIGHT = (0.36, 0.48, 0.8)  # unit vector towards the light; oblique, so that slopes differ
AMBIENT = 0.4  # share of the colour that a face turned away from the light keeps
SKY = np.array([0.75, 0.8, 0.85], np.float32)  # colour of pixels that hit nothing


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
    """The camera of a config, its x horizontal."""
    offset = np.array(cfg.look_at) - np.array(cfg.position)
    x, y, _ = forward = offset / np.linalg.norm(offset)
    right = np.array([y, -x, 0.0]) / np.hypot(x, y)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    focal, centre, position = map(jnp.float32, (cfg.focal, cfg.centre, cfg.position))
    return Camera(focal, centre, position, jnp.float32(rotation), *cfg.size)


def directions(camera: Camera) -> jax.Array:
    """Rays [H, W, 3] of all pixels in the world frame, each 1 m long in depth."""
    x = (jnp.arange(camera.width, dtype=jnp.float32) - camera.centre[0]) / camera.focal[0]
    y = (jnp.arange(camera.height, dtype=jnp.float32) - camera.centre[1]) / camera.focal[1]
    right, down, forward = (axis[None, None] for axis in camera.rotation.T)
    return x[None, :, None] * right + y[:, None, None] * down + forward


def points(camera: Camera, depth: jax.Array) -> jax.Array:
    """Points [H, W, 3] m in the world frame of the depths [H, W] m of all pixels."""
    return depth[..., None] * directions(camera) + camera.position[None, None]


def cast_rays(camera: Camera, cast: Callable[..., Any], shapes: Any) -> Any:
    """`cast` of shapes and one ray (origin [3] m, direction [3]), for every pixel: [H, W, ...]."""
    rays, shape = directions(camera).reshape(-1, 3), (camera.height, camera.width)
    hits = jax.vmap(cast, in_axes=(None, None, 0))(shapes, camera.position, rays)
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), hits)


def shade(colour: jax.Array, normal: jax.Array, light: Any = LIGHT) -> jax.Array:
    """Flat shading: colours [S, 3], 0 .. 1, of surfaces with unit normals [S, 3]; `light` [3] is
    the unit vector towards the light."""
    x, y, z = light
    cosine = normal[:, 0] * x + normal[:, 1] * y + normal[:, 2] * z  # [S]
    return (AMBIENT + (1.0 - AMBIENT) * jnp.maximum(cosine, 0.0))[:, None] * colour


def render(camera: Camera, solids: Solids) -> Picture:
    """The picture of a scene of any geoms, flat shaded."""
    hit = cast_rays(camera, raycast.cast_solids, solids)
    own = jnp.asarray(solids.colour).at[jnp.maximum(hit.geom, 0)].get(mode="promise_in_bounds")
    lit = shade(own.reshape(-1, 3), hit.normal.reshape(-1, 3)).reshape(own.shape)
    colour = jnp.where(hit.valid[..., None], lit, SKY[None, None])
    return Picture(colour, jnp.where(hit.valid, hit.distance, 0.0), hit.geom, hit.valid)
