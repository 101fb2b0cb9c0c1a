"""Maps in frames rotated by K yaws, and interpolation between cells.

Frame k is rotated by yaw_k = 2 pi k / K about the workspace centre: an action with yaw_k points
along +column in it. Its canvas is larger than the map by the fraction `margin`, so that rotated
corners fit; cells keep their size.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax import geometry

CLOSE = 3e-5  # cells or yaws, ours: rounding moves a position among 80 cells by half of it


@struct.dataclass
class RotationTables:
    """Source cell of every canvas cell for the first `count` of K yaws. C = canvas side."""

    index: np.ndarray  # [count, C * C] int32, row * W + col of the nearest workspace cell
    valid: np.ndarray  # [count, C * C] bool, the canvas cell lies in the workspace
    canvas: int = struct.field(pytree_node=False)  # C, cells
    cell: float = struct.field(pytree_node=False)  # side of a cell, m


def tables(size: int, extent: float, rotations: int, count: int, canvas: int) -> RotationTables:
    """Makes tables to rotate maps [size, size, ch] of `extent` m by the first `count` of K yaws."""
    along = np.arange(canvas) + 0.5 - 0.5 * canvas  # cells from the centre
    y, x = np.meshgrid(along, along, indexing="ij")
    yaw = (2.0 * np.pi / rotations * np.arange(count))[:, None, None]  # [count, 1, 1]
    col = np.floor(np.cos(yaw) * x - np.sin(yaw) * y + 0.5 * size).astype(np.int32)
    row = np.floor(np.sin(yaw) * x + np.cos(yaw) * y + 0.5 * size).astype(np.int32)
    valid = (row >= 0) & (row < size) & (col >= 0) & (col < size)
    index = np.clip(row, 0, size - 1) * size + np.clip(col, 0, size - 1)
    return RotationTables(index.reshape(count, -1), valid.reshape(count, -1), canvas, extent / size)


def rotate(tables: RotationTables, maps: jax.Array, k: Any = slice(None)) -> jax.Array:
    """Rotates maps [H, W, ch] to frames `k` [...] int32, 0 <= k < count, all by default: returns
    [..., C, C, ch], of each the nearest cell; 0 outside the workspace."""
    index, valid = (jnp.asarray(table)[k] for table in (tables.index, tables.valid))
    rotated = maps.reshape(-1, maps.shape[-1]).at[index].get(mode="promise_in_bounds")
    rotated = jnp.where(valid[..., None], rotated, jnp.zeros((), maps.dtype))
    return rotated.reshape(*index.shape[:-1], tables.canvas, tables.canvas, maps.shape[-1])


def to_cell(canvas: int, cell_size: float, yaw: jax.Array, xy: jax.Array) -> jax.Array:
    """Converts points `xy` [..., 2] m to (row, col) [..., 2] in the frame rotated by `yaw` []."""
    return geometry.rotate2d(-yaw, xy)[..., ::-1] / cell_size + 0.5 * (canvas - 1)


def floor(position: jax.Array) -> jax.Array:
    """Rounds positions [...] down to cells or frames; CLOSE below a whole number counts as it.

    XLA may compute a position twice, for the values that are read and for their weights, and round
    it differently. In a cell's centre both must find the same cell.
    """
    return jnp.floor(position + CLOSE)


def bilinear(values: jax.Array, row_col: jax.Array) -> jax.Array:
    """Interpolates the map `values` [h, w], h and w >= 2, at `row_col` [2] in cells, whose centres
    are whole numbers; outside, the nearest edge counts. Differentiable in both."""
    height, width = values.shape
    row = jnp.clip(row_col[0], 0.0, height - 1.0)
    col = jnp.clip(row_col[1], 0.0, width - 1.0)
    # Clipped after the cast, because NaN too must stay inside.
    top = jnp.clip(floor(row).astype(jnp.int32), 0, height - 2)
    left = jnp.clip(floor(col).astype(jnp.int32), 0, width - 2)
    down, right = row - top.astype(row.dtype), col - left.astype(col.dtype)

    rows, cols = top + np.arange(2, dtype=np.int32), left + np.arange(2, dtype=np.int32)
    corners = values.at[rows[:, None], cols[None]].get(mode="promise_in_bounds")  # [2, 2]
    above, below = (1.0 - right) * corners[:, 0] + right * corners[:, 1]
    return (1.0 - down) * above + down * below
