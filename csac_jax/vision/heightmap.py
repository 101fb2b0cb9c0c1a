"""What the robot sees of one scene: the orthographic top view, its packed form for replay, and areas measured on it."""

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax import geometry
from csac_jax.config import HeightmapConfig
from csac_jax.vision import raycast, shade

VIEW_HEIGHT = 0.5
"""Height from which the map looks down, m: all that is in play lies below, parked blocks must lie wholly above."""

_HEIGHT_UNIT = 1e-4  # m per count of the packed height
_CM2 = 1e4  # cm^2 in a m^2


@struct.dataclass
class Observation:
    """Top view of one scene. H = W rows and columns of the heightmap."""

    colour: jax.Array  # [H, W, 3] float32, 0 .. 1
    height: jax.Array  # [H, W] float32, m above the table
    target: jax.Array  # [H, W] bool, True where the block to get is seen; all True if any block will do


@struct.dataclass
class PackedObservation:
    """An observation in 6 bytes per cell."""

    colour: jax.Array  # [H, W, 3] uint8, 255 = 1
    height: jax.Array  # [H, W] uint16, tenths of a millimetre above the table
    target: jax.Array  # [H, W] bool, as in Observation


def orthographic(
    cfg: HeightmapConfig,
    polytopes: raycast.Polytopes,
    table_colour: jax.Array,
    wanted: jax.Array,
) -> Observation:
    """Top view of one scene: one ray straight down from VIEW_HEIGHT through every cell centre.

    The direction has no ray axis under vmap, so what a plane costs per ray is one scalar product.

    Args: table_colour [3] in 0 .. 1; wanted [G] bool, geoms of the block to get; all of them if any block will do.
    """
    origin = jnp.concatenate(
        [geometry.cell_centres(cfg), jnp.full((cfg.size, cfg.size, 1), VIEW_HEIGHT, jnp.float32)], axis=-1
    )
    down = jnp.array([0.0, 0.0, -1.0], jnp.float32)
    hit = jax.vmap(raycast.cast, in_axes=(None, 0, None))(polytopes, origin.reshape(-1, 3), down)
    wanted = jnp.concatenate([jnp.all(wanted, keepdims=True), wanted])  # row 0 is geom TABLE = -1
    target = wanted.at[hit.geom - raycast.TABLE].get(mode="promise_in_bounds")
    return Observation(
        colour=shade.flat(jnp.concatenate([table_colour[None], polytopes.colour]), hit).reshape(cfg.size, cfg.size, 3),
        height=jnp.maximum(VIEW_HEIGHT - hit.distance, 0.0).reshape(cfg.size, cfg.size),
        target=target.reshape(cfg.size, cfg.size),
    )


def pack(obs: Observation) -> PackedObservation:
    """Rounds to a colour level and to a tenth of a millimetre; heights are cut off at 0 and 6.5535 m."""
    counts = jnp.clip(jnp.round(obs.height / _HEIGHT_UNIT), 0.0, 65535.0)
    levels = jnp.clip(jnp.round(obs.colour * 255.0), 0.0, 255.0)
    return PackedObservation(levels.astype(jnp.uint8), counts.astype(jnp.uint16), obs.target)


def unpack(packed: PackedObservation) -> Observation:
    """The observation that was packed, up to half a colour level and half a tenth of a millimetre."""
    return Observation(
        colour=packed.colour.astype(jnp.float32) / 255.0,
        height=packed.height.astype(jnp.float32) * _HEIGHT_UNIT,
        target=packed.target,
    )


def moved_area(cfg: HeightmapConfig, before: jax.Array, after: jax.Array) -> jax.Array:
    """Area [] cm^2 where the height changed by 1 cm to 30 cm (VPG's bounds), from two height maps [H, W] m."""
    change = jnp.abs(after - before)
    return _area(cfg, (change >= 0.01) & (change <= 0.3))


def occupied_area(cfg: HeightmapConfig, height: jax.Array) -> jax.Array:
    """Area [] cm^2 that lies more than 2 cm above the table (VPG's bound), from a height map [H, W] m."""
    return _area(cfg, height > 0.02)


def _area(cfg: HeightmapConfig, chosen: jax.Array) -> jax.Array:
    """Area [] cm^2 of the cells that are True in `chosen` [H, W]; an area, not a count, survives another resolution."""
    return chosen.sum(dtype=jnp.int32).astype(jnp.float32) * (cfg.cell**2 * _CM2)
