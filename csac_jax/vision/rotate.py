"""Maps in frames rotated by K yaws, and interpolation between cells.

Frame k is rotated by yaw_k = 2 pi k / K about the workspace centre: an action with yaw_k points
along +column in it. Its canvas is a margin larger than the map, so that rotated corners fit; cells
keep their size. NumPy tables say which cell goes where, so a rotation is one gather.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax import geometry


@struct.dataclass
class RotationTables:
    """Source cell of every canvas cell for the first `count` of K yaws. C = canvas side."""

    index: np.ndarray  # [count, C * C] int32, row * W + col of the nearest workspace cell
    valid: np.ndarray  # [count, C * C] bool, the canvas cell lies in the workspace
    canvas: int = struct.field(pytree_node=False)  # C, cells
    cell: float = struct.field(pytree_node=False)  # side of a cell, m


def tables(size: int, extent: float, rotations: int, count: int, margin: float) -> RotationTables:
    """Tables that rotate maps [size, size, ch] of `extent` m to the first `count` of `rotations`.

    The canvas is larger than the map by the fraction `margin`, and its side even; sqrt(2) - 1 keeps
    the corners. Raises ValueError for more frames than rotations or a negative margin.
    """
    canvas = round(size * (1.0 + margin) / 2.0) * 2
    if not 1 <= count <= rotations:
        raise ValueError(f"count: {count} frames were asked for, but there are 1 .. {rotations}")
    if canvas < size:
        raise ValueError(f"margin: {margin} makes the canvas {canvas} cells, the map has {size}")
    along = np.arange(canvas) + 0.5 - 0.5 * canvas  # cells from the centre
    y, x = np.meshgrid(along, along, indexing="ij")
    yaw = (2.0 * np.pi / rotations * np.arange(count))[:, None, None]  # [count, 1, 1]
    col = np.floor(np.cos(yaw) * x - np.sin(yaw) * y + 0.5 * size).astype(np.int32)
    row = np.floor(np.sin(yaw) * x + np.cos(yaw) * y + 0.5 * size).astype(np.int32)
    valid = (row >= 0) & (row < size) & (col >= 0) & (col < size)
    index = np.clip(row, 0, size - 1) * size + np.clip(col, 0, size - 1)
    return RotationTables(index.reshape(count, -1), valid.reshape(count, -1), canvas, extent / size)


def _gather(canvas: int, maps: jax.Array, index: jax.Array, valid: jax.Array) -> jax.Array:
    """Canvas [C, C, ch] of maps [H, W, ch], index [C * C] and valid [C * C]; 0 where not valid."""
    channels = maps.shape[-1]
    rotated = maps.reshape(-1, channels).at[index].get(mode="promise_in_bounds")
    rotated = jnp.where(valid[:, None], rotated, jnp.zeros((), maps.dtype))
    return rotated.reshape(canvas, canvas, channels)


def rotate(tables: RotationTables, maps: jax.Array) -> jax.Array:
    """Maps [H, W, ch] in every frame [count, C, C, ch], nearest cell; 0 outside the workspace."""
    gather = jax.vmap(_gather, in_axes=(None, None, 0, 0))
    return gather(tables.canvas, maps, jnp.asarray(tables.index), jnp.asarray(tables.valid))


def rotate_one(tables: RotationTables, maps: jax.Array, k: jax.Array) -> jax.Array:
    """As `rotate`, in frame `k` [] int32, 0 <= k < count, alone: [C, C, ch]."""
    return _gather(tables.canvas, maps, jnp.asarray(tables.index)[k], jnp.asarray(tables.valid)[k])


def frame_position(yaw: jax.Array, xy: jax.Array) -> jax.Array:
    """Workspace points `xy` [..., 2] m in the frame rotated by `yaw` [] rad, [..., 2] m."""
    return geometry.rotate2d(-yaw, xy)


def to_cell(canvas: int, cell_size: float, xy_frame: jax.Array) -> jax.Array:
    """Canvas position (row, col) [..., 2] in cells of `cell_size` m of points [..., 2] m."""
    return xy_frame[..., ::-1] / cell_size + 0.5 * (canvas - 1)


def bilinear(values: jax.Array, row_col: jax.Array) -> jax.Array:
    """Value [] of the map `values` [h, w], h and w >= 2, at `row_col` [2] in cells.

    Cell centres are whole numbers; outside, the nearest edge counts. Differentiable in both. vmap
    turns each of the four reads into one gather.
    """
    height, width = values.shape
    row = jnp.clip(row_col[0], 0.0, height - 1.0)
    col = jnp.clip(row_col[1], 0.0, width - 1.0)
    # Clipped after the cast, because NaN too must stay inside.
    top = jnp.clip(jnp.floor(row).astype(jnp.int32), 0, height - 2)
    left = jnp.clip(jnp.floor(col).astype(jnp.int32), 0, width - 2)
    down, right = row - top.astype(row.dtype), col - left.astype(col.dtype)

    def read(r: jax.Array, c: jax.Array) -> jax.Array:
        return values.at[r, c].get(mode="promise_in_bounds")

    upper = (1.0 - right) * read(top, left) + right * read(top, left + 1)
    lower = (1.0 - right) * read(top + 1, left) + right * read(top + 1, left + 1)
    return (1.0 - down) * upper + down * lower
