"""Maps seen from frames turned by K yaws, and reading a map between its cells.

Frame k is turned by yaw_k = 2 pi k / K about the workspace centre: an action with yaw_k points
along +column in it. Its canvas has cells of the workspace's size and is a margin larger, so that
turned corners fit. Which cell goes where never changes: the tables are built once, with NumPy, and
turning a map is one gather of rows of channels.
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
    valid: (
        np.ndarray
    )  # [count, C * C] bool, False where the canvas cell lies outside of the workspace
    canvas: int = struct.field(pytree_node=False)  # C, cells
    cell: float = struct.field(pytree_node=False)  # side of a cell, m


def tables(size: int, extent: float, rotations: int, count: int, margin: float) -> RotationTables:
    """Tables that turn maps [size, size, ch] of `extent` m to the first `count` of `rotations`
    frames.

    margin: the canvas is this fraction larger than the map, with an even side; sqrt(2) - 1 keeps
    the corners.
    """
    canvas = round(size * (1.0 + margin) / 2.0) * 2
    if not 1 <= count <= rotations:
        raise ValueError(f"count: {count} frames were asked for, but there are 1 .. {rotations}")
    if canvas < size:
        raise ValueError(
            f"margin: {margin} makes the canvas ({canvas} cells) smaller than the map ({size} cells)"
        )
    along = np.arange(canvas) + 0.5 - 0.5 * canvas  # cells from the centre
    y, x = np.meshgrid(along, along, indexing="ij")
    yaw = (2.0 * np.pi / rotations * np.arange(count))[:, None, None]  # [count, 1, 1]
    col = np.floor(np.cos(yaw) * x - np.sin(yaw) * y + 0.5 * size).astype(
        np.int32
    )  # frame to workspace: turned by +yaw
    row = np.floor(np.sin(yaw) * x + np.cos(yaw) * y + 0.5 * size).astype(np.int32)
    valid = (row >= 0) & (row < size) & (col >= 0) & (col < size)
    index = np.clip(row, 0, size - 1) * size + np.clip(col, 0, size - 1)
    return RotationTables(index.reshape(count, -1), valid.reshape(count, -1), canvas, extent / size)


def _turn(canvas: int, maps: jax.Array, index: jax.Array, valid: jax.Array) -> jax.Array:
    """Canvas [C, C, ch] from maps [H, W, ch], index [C * C] and valid [C * C]; zero where not
    valid."""
    channels = maps.shape[-1]
    turned = maps.reshape(-1, channels).at[index].get(mode="promise_in_bounds")
    return jnp.where(valid[:, None], turned, jnp.zeros((), maps.dtype)).reshape(
        canvas, canvas, channels
    )


def rotate(tables: RotationTables, maps: jax.Array) -> jax.Array:
    """Maps [H, W, ch] seen from every frame: [count, C, C, ch], zero outside of the workspace.
    Nearest cell."""
    turn = jax.vmap(_turn, in_axes=(None, None, 0, 0))
    return turn(tables.canvas, maps, jnp.asarray(tables.index), jnp.asarray(tables.valid))


def rotate_one(tables: RotationTables, maps: jax.Array, k: jax.Array) -> jax.Array:
    """Maps [H, W, ch] seen from frame `k` [] int32, 0 <= k < count: [C, C, ch], zero outside of the
    workspace."""
    return _turn(tables.canvas, maps, jnp.asarray(tables.index)[k], jnp.asarray(tables.valid)[k])


def frame_position(yaw: jax.Array, xy: jax.Array) -> jax.Array:
    """Where the workspace points `xy` [..., 2] m lie in the frame turned by `yaw` [] rad, [..., 2]
    m."""
    return geometry.rotate2d(-yaw, xy)


def to_cell(canvas: int, cell_size: float, xy_frame: jax.Array) -> jax.Array:
    """Position (row, col) [..., 2] on a canvas `canvas` cells wide, `cell_size` m each, of points
    [..., 2] m."""
    return xy_frame[..., ::-1] / cell_size + 0.5 * (canvas - 1)


def bilinear(values: jax.Array, row_col: jax.Array) -> jax.Array:
    """Value [] of the map `values` [h, w], h and w >= 2, at `row_col` [2] in cells; outside, that
    of the nearest edge.

    Differentiable in both; cell centres are whole numbers. Four explicit reads, which vmap turns
    into one gather each.
    """
    height, width = values.shape
    row = jnp.clip(row_col[0], 0.0, height - 1.0)
    col = jnp.clip(row_col[1], 0.0, width - 1.0)
    top = jnp.clip(
        jnp.floor(row).astype(jnp.int32), 0, height - 2
    )  # after the cast: NaN too must stay inside
    left = jnp.clip(jnp.floor(col).astype(jnp.int32), 0, width - 2)
    down, right = row - top.astype(row.dtype), col - left.astype(col.dtype)

    def read(r: jax.Array, c: jax.Array) -> jax.Array:
        return values.at[r, c].get(mode="promise_in_bounds")

    upper = (1.0 - right) * read(top, left) + right * read(top, left + 1)
    lower = (1.0 - right) * read(top + 1, left) + right * read(top + 1, left + 1)
    return (1.0 - down) * upper + down * lower
