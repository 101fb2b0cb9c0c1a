"""The opening of a grasp: as wide as what the map shows between the fingers.

S = samples along the closing, half a cell apart; the middle of the hand lies between two of them.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from csac_jax import geometry
from csac_jax.config import HeightmapConfig
from csac_jax.grippers import Fingers, Gripper

ROOM = 0.01  # m (ours), between what is grasped and each open finger
LESS_ROOM = 0.006, 0.003  # m (ours), where a finger would come down on something else


class Fit(NamedTuple):
    """Opening of the hand over a place."""

    shift: Array  # [] m, of its middle along the closing
    half: Array  # [] m, half the opening


def fit(
    cfg: HeightmapConfig, height: Array, pose: Array, tip: Array, gripper: Gripper, fingers: Fingers
) -> Fit:
    """Fits a grasp at `pose` [3] m, m, rad to a map `height` [H, W] m, with tips at `tip` [] m.

    What is higher than the tips at the middle is grasped, over gaps of a cell; where the middle is
    bare, all that is between the open tips. The hand moves to its middle and opens ROOM wider on
    both sides, at most fully. Where a finger would then come down on something else, it opens the
    first of LESS_ROOM wider that is free. Where nothing or what is wider than the hand lies, or
    where only the fully open fingers come down on free ground, it opens fully in place.
    """
    most, step = 0.5 * jnp.asarray(fingers.opening, jnp.float32), 0.5 * cfg.cell
    count = int(np.ceil((gripper.opening[1] + gripper.finger[0]) / step))
    places = jnp.asarray((np.arange(-count, count) + 0.5) * step, jnp.float32)  # [S] m
    there = _highest(cfg, height, pose, places, gripper, fingers) > tip
    filled = there | jnp.roll(there, 1) | jnp.roll(there, -1)  # gaps of two samples are none
    between = there & (jnp.abs(places) < most)

    def end(way: float) -> Array:  # [] m, how far it reaches
        along = way * places
        first = jnp.min(jnp.where(filled | (along < 0.0), places[-1] + step, along))
        last = jnp.max(jnp.where(between, along, -most))
        return jnp.where(there[count - 1] | there[count], first - 1.5 * step, last + 0.5 * step)

    def blocked(middle: Array | float, half: Array) -> Array:  # a finger comes down on something
        beside = jnp.abs(places - middle)
        return jnp.any(there & (beside > half) & (beside < half + fingers.thickness))

    back, ahead = end(-1.0), end(1.0)
    shift, half = 0.5 * (ahead - back), 0.5 * (ahead + back)
    rooms = [jnp.clip(half + room, gripper.half[0], most) for room in (ROOM, *LESS_ROOM)]
    opened = rooms[0]
    for room in reversed(rooms):
        opened = jnp.where(blocked(shift, room), opened, room)
    fits = jnp.any(between) & (half < most) & (~blocked(shift, opened) | blocked(0.0, most))
    return Fit(jnp.where(fits, shift, 0.0), jnp.where(fits, opened, most))


def _highest(
    cfg: HeightmapConfig,
    height: Array,
    pose: Array,
    places: Array,
    gripper: Gripper,
    fingers: Fingers,
) -> Array:
    """Returns the highest surface [S] m under a finger's width at `places` [S] m."""
    rows = int(np.ceil(2.0 * gripper.finger[1] / cfg.cell)) + 1
    across = jnp.asarray(fingers.width, jnp.float32) * np.linspace(-0.5, 0.5, rows, dtype="f4")
    strip = jnp.stack(jnp.meshgrid(places, across, indexing="ij"), axis=-1)  # [S, rows, 2]
    xy = geometry.rotate2d(pose[2], strip) + pose[:2][None, None]
    cells = jnp.floor(xy / cfg.cell + 0.5 * cfg.size).astype(jnp.int32)
    inside = jnp.all((cells >= 0) & (cells < cfg.size), axis=-1)
    col, row = jnp.moveaxis(jnp.clip(cells, 0, cfg.size - 1), -1, 0)
    seen = jnp.asarray(height).at[row, col].get(mode="promise_in_bounds")
    return jnp.max(jnp.where(inside, seen, 0.0), axis=1)


def everywhere(
    cell: float, heights: Array, depth: float, lowest: float, gripper: Gripper, fingers: Fingers
) -> Array:
    """Sees how a hand that closes along the columns would fit at each cell of its maps.

    Args: cell, its side, m; heights [F, C, C] m; depth, m, of the tips below the surface; lowest,
    m, their least height. Returns [F, C, C, 4] m: half the width of what lies between the fingers,
    the way to its middle, the height of its lower side above the tips, and how far what a finger
    would come down on stands above them. All are 0 where nothing is, and the same for mirror
    images. A gap of a cell is none.
    """
    num, steps = heights.shape[1], int(np.ceil(0.5 * gripper.opening[1] / cell))
    beside = int(np.ceil((gripper.finger[0] + LESS_ROOM[-1]) / cell)) + 1
    lines, margin = int(np.ceil(0.5 * gripper.finger[1] / cell)), steps + beside
    thickness, most = fingers.thickness, 0.5 * jnp.asarray(fingers.opening, jnp.float32)

    def moved(maps: Array, way: int, axis: int) -> Array:  # what lies `way` cells on; 0 outside
        padded = jnp.pad(maps, [(0, 0), *((margin * (axis == one),) * 2 for one in (1, 2))])
        return jax.lax.slice_in_dim(padded, margin + way, margin + way + num, axis=axis)

    def highest(maps: Array, axis: int) -> Array:  # under the width of a finger
        ways = range(-lines, lines + 1)
        under = [jnp.asarray(2.0 * abs(way) * cell <= fingers.width) | (way == 0) for way in ways]
        rows = [moved(maps, way, axis) for way in ways]
        return functools.reduce(jnp.maximum, map(jnp.where, under, rows, [0.0] * len(rows)))

    apart = jax.lax.optimization_barrier  # else XLA computes each again for every step beside
    across = apart(highest(apart(heights), 1))
    tip = apart(jnp.maximum(highest(across, 2) - depth, lowest))
    there = across > tip

    def side(way: int) -> tuple[Array, Array, Array, Array]:
        on, reach, edge, landing, wide = there, 0.0 * tip, across - tip, 0.0 * tip, 0.0 * tip
        above = [moved(across, way * step, 2) - tip for step in range(margin + 1)]
        for step in range(1, margin + 1):
            solid = above[step] > 0.0
            if step <= steps:
                on &= solid | (above[step + 1] > 0.0)
                reach = jnp.where(on & solid, step * cell, reach)
                edge = jnp.where(on & solid, above[step], edge)
            lands = ~on & ((step - 1) * cell - reach < thickness + LESS_ROOM[-1])
            landing = jnp.where(lands, jnp.maximum(landing, above[step]), landing)
            lands = ((step + 0.5) * cell > most) & ((step - 0.5) * cell < most + thickness)
            wide = jnp.where(lands, jnp.maximum(wide, above[step]), wide)
        return apart((reach, edge, landing, wide))

    (back, *one), (ahead, *other) = side(-1), side(1)
    half, shift, edge = 0.5 * (ahead + back + cell), 0.5 * jnp.abs(ahead - back), one[0]
    landing, wide = map(jnp.maximum, one[1:], other[1:])  # of fitted fingers, and of open ones
    landing = jnp.where(half < most, jnp.where(wide > 0.0, landing, 0.0), wide)
    found = jnp.stack([half, shift, jnp.minimum(edge, other[0]), landing], axis=-1)
    return jnp.where(there[..., None], found, 0.0)
