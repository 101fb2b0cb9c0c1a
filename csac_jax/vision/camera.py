"""A pinhole camera: its pixels as rays and as points in space, and shading.

The camera looks along its z, x is right and y down in the image; row 0 is the top row. A pixel's
ray is not of unit length: it advances by 1 m in depth, along z, per unit of distance.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax.config import CameraConfig

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


def make(cfg: CameraConfig) -> Camera:
    """Makes the camera of a config, its x horizontal."""
    offset = np.array(cfg.look_at) - np.array(cfg.position)
    x, y, _ = forward = offset / np.linalg.norm(offset)
    right = np.array([y, -x, 0.0]) / np.hypot(x, y)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    focal, centre, position = map(jnp.float32, (cfg.focal, cfg.centre, cfg.position))
    return Camera(focal, centre, position, jnp.float32(rotation), *cfg.size)


def directions(camera: Camera) -> jax.Array:
    """Returns rays [H, W, 3] of all pixels in the world frame, each 1 m long in depth."""
    rows, columns = jnp.arange(camera.height), jnp.arange(camera.width)
    return direction(camera, rows[:, None], columns[None])


def direction(camera: Camera, row: jax.Array, column: jax.Array) -> jax.Array:
    """Returns rays [..., 3] of the pixels at these rows and columns, as in `directions`."""
    x = (column.astype(jnp.float32) - camera.centre[0]) / camera.focal[0]
    y = (row.astype(jnp.float32) - camera.centre[1]) / camera.focal[1]
    right, down, forward = (jnp.expand_dims(axis, range(x.ndim)) for axis in camera.rotation.T)
    return x[..., None] * right + y[..., None] * down + forward


def points(camera: Camera, depth: jax.Array) -> jax.Array:
    """Converts depths [H, W] m of all pixels to points [H, W, 3] m, world frame."""
    return depth[..., None] * directions(camera) + camera.position[None, None]


def cast_rays(camera: Camera, cast: Callable[..., Any], shapes: Any) -> Any:
    """Calls `cast` on shapes and every pixel's ray (origin [3] m, direction [3]): [H, W, ...]."""
    rays, shape = directions(camera).reshape(-1, 3), (camera.height, camera.width)
    hits = jax.vmap(cast, in_axes=(None, None, 0))(shapes, camera.position, rays)
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), hits)


def project(camera: Camera, point: jax.Array) -> jax.Array:
    """Projects a point [3] m before the camera to column and row [2] px, not whole."""
    x, y, depth = (point - camera.position) @ camera.rotation
    return camera.focal * jnp.stack([x, y]) / depth + camera.centre


@functools.lru_cache(maxsize=64)
def window(cfg: CameraConfig, extent: float, highest: float, radius: float) -> tuple[int, int]:
    """Returns rows and columns of a window, at most the image, that holds any ball of `radius` m.

    The ball's centre lies over the square of side `extent` m, at most `highest` m high, and
    projects to the window's centre. In the plane of an image axis and the optical axis, a ball at
    angle a and distance d lies between a - s and a + s with sin s = radius / d.
    """
    with jax.ensure_compile_time_eval():
        eye = jax.device_get(make(cfg))
    steps = np.linspace(-0.5, 0.5, 9)
    places = np.stack(np.meshgrid(extent * steps, extent * steps, highest * (steps + 0.5)), axis=-1)
    local = (places.reshape(-1, 3) - eye.position) @ eye.rotation
    reach = []
    for axis in range(2):
        angle = np.arctan2(local[:, axis], local[:, 2])
        half = np.arcsin(np.minimum(radius / np.hypot(local[:, axis], local[:, 2]), 1.0))
        ends = np.tan(np.clip(np.stack([angle - half, angle + half]), -1.5, 1.5)) - np.tan(angle)
        reach.append(float(eye.focal[axis]) * float(np.abs(ends).max()))
    columns, rows = (2 * math.ceil(pixels) + 3 for pixels in reach)
    return min(rows, cfg.size[1]), min(columns, cfg.size[0])


def shade(colour: jax.Array, normal: jax.Array, light: Any = LIGHT) -> jax.Array:
    """Shades colours [S, 3], 0 .. 1, by unit normals [S, 3]; `light` [3] is towards the light."""
    x, y, z = light
    cosine = normal[:, 0] * x + normal[:, 1] * y + normal[:, 2] * z  # [S]
    return (AMBIENT + (1.0 - AMBIENT) * jnp.maximum(cosine, 0.0))[:, None] * colour
