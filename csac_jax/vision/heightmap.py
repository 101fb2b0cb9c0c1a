"""Height maps of one scene seen from above: the observation, its packed form, an area."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax.config import HeightmapConfig
from csac_jax.runtime import short

VIEW_HEIGHT = 0.5  # m: blocks in play lie below it, parked blocks wholly above
_HEIGHT_UNIT = 1e-4  # m per count of the packed height
_AS_HIGH = 1e-6  # m; points that are less below the highest count as it


@struct.dataclass
class Observation:
    """One scene seen from above. H = W rows and columns of the map, see `geometry`."""

    colour: jax.Array  # [H, W, 3] float32, 0 .. 1
    height: jax.Array  # [H, W] float32, m above the table
    # [H, W] bool, a wanted block is seen; all True if any is wanted, all False if it is hidden
    target: jax.Array
    fingers: jax.Array | None = None  # [3] float32 m, `grippers.Fingers`; None where unseen

    __repr__ = short.text


@struct.dataclass
class PackedObservation:
    """An observation in 6 bytes per cell."""

    colour: jax.Array  # [H, W, 3] uint8, 255 = 1
    height: jax.Array  # [H, W] uint16, tenths of a millimetre above the table
    target: jax.Array  # [H, W] bool
    fingers: jax.Array | None = None  # [3] float32 m


class Cells(NamedTuple):
    """The highest point in each cell."""

    height: jax.Array  # [H, W] m above the table; 0 where not filled
    source: jax.Array  # [H, W] int32, index of that point, the first if several are; see `filled`
    filled: jax.Array  # [H, W] bool, the cell has a point


def from_points(cfg: HeightmapConfig, points: jax.Array, valid: jax.Array) -> Cells:
    """Projects points to a height map: z(r, c) = max_i {p_i.z : p_i in cell (r, c)}.

    `max`, then the least index among those as high: JAX does not define the order of colliding
    scatters. As high, not equal: a compiler may compute z twice and round differently.

    Args: points [n, 3] m, world frame; valid [n] bool, False where the ray hit nothing.
    """
    xy = jnp.where(valid[:, None], points[:, :2], cfg.extent)  # outside
    col, row = jnp.floor((xy + 0.5 * cfg.extent) / cfg.cell).astype(jnp.int32).T
    inside = (row >= 0) & (row < cfg.size) & (col >= 0) & (col < cfg.size)
    cell = jnp.where(inside, row * cfg.size + col, cfg.size**2)  # outside: dropped
    top = jnp.full(cfg.size**2, -jnp.inf).at[cell].max(points[:, 2], mode="drop")
    is_top = points[:, 2] >= top.at[cell].get(mode="fill", fill_value=jnp.inf) - _AS_HIGH
    index = jnp.arange(len(points), dtype=jnp.int32)
    last = jnp.full(cfg.size**2, jnp.int32(len(points) - 1))
    source = last.at[jnp.where(is_top, cell, cfg.size**2)].min(index, mode="drop")
    cells = Cells(jnp.maximum(top, 0.0), source, top > -jnp.inf)
    return jax.tree.map(lambda leaf: leaf.reshape(cfg.size, cfg.size), cells)


def observation(
    cells: Cells, colour: jax.Array, target: jax.Array, elsewhere: jax.Array
) -> Observation:
    """Makes the observation of the points' `colour` [H, W, 3] and `target` [H, W] bool.

    Cells without a point have height and colour 0 and the target flag `elsewhere` [] bool.
    """
    shown = jnp.where(cells.filled[..., None], colour, 0.0)
    return Observation(shown, cells.height, jnp.where(cells.filled, target, elsewhere))


def wanted(target: jax.Array) -> jax.Array:
    """Returns where to grasp for a target's mask [H, W] bool: everywhere while none is seen."""
    return target | ~jnp.any(target)


def pack(obs: Observation) -> PackedObservation:
    """Rounds to a colour level and to 0.1 mm; clips heights to 0 .. 6.5535 m."""
    counts = jnp.clip(jnp.round(obs.height / _HEIGHT_UNIT), 0.0, 65535.0)
    levels = jnp.clip(jnp.round(obs.colour * 255.0), 0.0, 255.0)
    packed = levels.astype(jnp.uint8), counts.astype(jnp.uint16)
    return PackedObservation(*packed, obs.target, obs.fingers)


def unpack(packed: PackedObservation) -> Observation:
    """Restores a packed observation, to half a colour level and 0.05 mm."""
    colour, height = (leaf.astype(jnp.float32) for leaf in (packed.colour, packed.height))
    return Observation(colour / 255.0, height * _HEIGHT_UNIT, packed.target, packed.fingers)


def moved_area(cfg: HeightmapConfig, before: jax.Array, after: jax.Array) -> jax.Array:
    """Returns the area [] cm^2 whose height [H, W] m changed by 1 cm to 30 cm (VPG's bounds)."""
    change = jnp.abs(after - before)
    cells = jnp.sum((change >= 0.01) & (change <= 0.3), dtype=jnp.int32)
    return cells.astype(jnp.float32) * (cfg.cell**2 * 1e4)
