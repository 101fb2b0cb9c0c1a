"""Poses, angles, and the cells of heightmaps in metres.

Quaternions are (w, x, y, z), of unit length. Heightmap rows run along y and columns along x. Row 0
and column 0 lie at the lowest y and x.
"""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import HeightmapConfig

FULL_TURN = 2.0 * np.pi  # rad


def quat_to_matrix(quat: jax.Array) -> jax.Array:
    """Converts the unit quaternion `quat` [4] to a rotation matrix [3, 3], body to world."""
    w, x, y, z = quat
    return jnp.stack([
        jnp.stack([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)]),
        jnp.stack([2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)]),
        jnp.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)]),
    ])  # fmt: skip


def quat_multiply(left: jax.Array, right: jax.Array) -> jax.Array:
    """Multiplies two quaternions [4] (Hamilton): the rotation `right` first, then `left`."""
    w0, x0, y0, z0 = left
    w1, x1, y1, z1 = right
    return jnp.stack([
        w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
        w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
        w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
        w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
    ])  # fmt: skip


def quat_from_yaw(yaw: jax.Array) -> jax.Array:
    """Returns the quaternion [4] of a rotation by `yaw` [] rad about z, counter-clockwise."""
    zero = jnp.zeros_like(yaw)
    return jnp.stack([jnp.cos(0.5 * yaw), zero, zero, jnp.sin(0.5 * yaw)])


def rotate2d(yaw: jax.Array, xy: jax.Array) -> jax.Array:
    """Rotates points `xy` [..., 2] m by `yaw` [] rad about the origin, counter-clockwise."""
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    x, y = xy[..., 0], xy[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def wrap_angle(angle: jax.Array) -> jax.Array:
    """Wraps angles of any shape to [0, 2 pi) rad."""
    wrapped = jnp.mod(angle, FULL_TURN)  # 2 pi itself for a tiny negative angle, < 0 for a denormal
    return jnp.where((wrapped >= FULL_TURN) | (wrapped <= 0.0), 0.0, wrapped)


def cell_centres(cfg: HeightmapConfig) -> jax.Array:
    """Returns the centre xy of every cell, [H, W, 2] m: x = (col + 0.5) cell - extent / 2."""
    places = (jnp.arange(cfg.size, dtype=jnp.float32) - 0.5 * (cfg.size - 1)) * cfg.cell
    return jnp.stack(jnp.meshgrid(places, places), axis=-1)
