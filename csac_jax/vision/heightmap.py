"""What the robot sees of one scene: the top view, its packed form for replay, and areas measured on
it.

The view is orthographic, cast from above and complete; or oblique, the depth image of a camera
beside the workspace, turned into points and projected along gravity, as in VPG (arXiv:1803.09956):
what blocks hide from the camera is empty.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax import geometry
from csac_jax.config import HeightmapConfig, SensorConfig
from csac_jax.vision import camera, raycast, sensor, shade
from csac_jax.vision.camera import Camera

VIEW_HEIGHT = 0.5
"""Height from which the map looks down, m: all that is in play lies below, parked blocks must lie
wholly above."""

BEYOND = (
    -1.0
)  # m, the height of what lies beside the workspace, in maps that were shifted or turned
BEYOND_COUNT = 65535  # packed
_HEIGHT_UNIT = 1e-4  # m per count of the packed height
_CM2 = 1e4  # cm^2 in a m^2


@struct.dataclass
class Observation:
    """Top view of one scene. H = W rows and columns of the heightmap."""

    colour: jax.Array  # [H, W, 3] float32, 0 .. 1
    height: jax.Array  # [H, W] float32, m above the table
    target: (
        jax.Array
    )  # [H, W] bool, True where the block to get is seen; all True if any block will do


@struct.dataclass
class PackedObservation:
    """An observation in 6 bytes per cell."""

    colour: jax.Array  # [H, W, 3] uint8, 255 = 1
    height: jax.Array  # [H, W] uint16, tenths of a millimetre above the table
    target: jax.Array  # [H, W] bool, as in Observation


class Cells(NamedTuple):
    """The highest of the points that fall into each cell."""

    height: jax.Array  # [H, W] m above the table; 0 where not filled
    source: (
        jax.Array
    )  # [H, W] int32, which point: of several as high the first; meaningless where not filled
    filled: jax.Array  # [H, W] bool, any point fell into it


def orthographic(
    cfg: HeightmapConfig, polytopes: raycast.Polytopes, table_colour: jax.Array, wanted: jax.Array
) -> Observation:
    """Top view of one scene: one ray straight down from VIEW_HEIGHT through every cell centre.

    The direction has no ray axis under vmap, so what a plane costs per ray is one scalar product.

    Args: table_colour [3] in 0 .. 1; wanted [G] bool, geoms of the block to get; all of them if any
    block will do.
    """
    origin = jnp.concatenate(
        [geometry.cell_centres(cfg), jnp.full((cfg.size, cfg.size, 1), VIEW_HEIGHT, jnp.float32)],
        axis=-1,
    )
    down = jnp.array([0.0, 0.0, -1.0], jnp.float32)
    distance, surface, _ = jax.vmap(raycast.meet, in_axes=(None, 0, None))(
        polytopes, origin.reshape(-1, 3), down
    )
    colour, target = surface_tables(polytopes, table_colour, wanted)
    return Observation(
        colour=colour.at[surface].get(mode="promise_in_bounds").reshape(cfg.size, cfg.size, 3),
        height=jnp.maximum(VIEW_HEIGHT - distance, 0.0).reshape(cfg.size, cfg.size),
        target=target.at[surface].get(mode="promise_in_bounds").reshape(cfg.size, cfg.size),
    )


def oblique(
    cfg: HeightmapConfig,
    polytopes: raycast.Polytopes,
    table_colour: jax.Array,
    wanted: jax.Array,
    eye: Camera,
) -> Observation:
    """Top view of one scene as a camera gives it; cells that it does not see are empty: height 0,
    colour 0.

    Args: as of `orthographic`.
    """
    seen = sight(polytopes, eye)
    tables = surface_tables(polytopes, table_colour, wanted)
    return from_depth(cfg, eye, seen.distance, seen.valid, seen.surface, tables)


def oblique_measured(
    key: jax.Array,
    cfg: HeightmapConfig,
    errors: SensorConfig,
    polytopes: raycast.Polytopes,
    table_colour: jax.Array,
    wanted: jax.Array,
    eye: Camera,
) -> Observation:
    """`oblique` with the errors of a sensor: `eye` is where the camera is believed to be."""
    key_pose, key_depth, key_colour = jax.random.split(key, 3)
    seen = sight(polytopes, sensor.pose(key_pose, errors, eye))
    depth, kept = sensor.depth(key_depth, errors, jnp.where(seen.valid, seen.distance, 0.0))
    tables = surface_tables(polytopes, table_colour, wanted)
    obs = from_depth(cfg, eye, depth, seen.valid & kept, seen.surface, tables)
    return obs.replace(colour=sensor.colour(key_colour, errors, obs.colour))


def measured(
    key: jax.Array, errors: SensorConfig, true: Observation, wanted: jax.Array
) -> Observation:
    """An orthographic view with the errors of a sensor that looks down from VIEW_HEIGHT; what is
    dropped is empty.

    Args: wanted, as of `orthographic`.
    """
    key_depth, key_colour = jax.random.split(key)
    depth, kept = sensor.depth(key_depth, errors, VIEW_HEIGHT - true.height)
    return Observation(
        colour=sensor.colour(key_colour, errors, jnp.where(kept[..., None], true.colour, 0.0)),
        height=jnp.where(kept, jnp.maximum(VIEW_HEIGHT - depth, 0.0), 0.0),
        target=jnp.where(kept, true.target, jnp.all(wanted)),
    )


def sight(polytopes: raycast.Polytopes, eye: Camera) -> raycast.Meeting:
    """What each pixel of a camera meets, [h, w]; the distance is the depth along the optical axis,
    m."""
    return camera.look(eye, lambda origin, direction: raycast.meet(polytopes, origin, direction))


def from_points(cfg: HeightmapConfig, points: jax.Array, valid: jax.Array) -> Cells:
    """Orthographic height map of points: z(r, c) = max_i {p_i.z : p_i in cell (r, c)}, and which
    point that is.

    `max`, then the least index among those as high: the order of conflicting scatters is undefined
    in JAX.

    Args: points [n, 3] m, world frame; valid [n] bool, False where nothing was met.
    """
    xy = jnp.where(valid[:, None], points[:, :2], cfg.extent)  # outside
    col, row = jnp.floor((xy + 0.5 * cfg.extent) / cfg.cell).astype(jnp.int32).T
    inside = (row >= 0) & (row < cfg.size) & (col >= 0) & (col < cfg.size)
    cell = jnp.where(inside, row * cfg.size + col, cfg.size**2)  # outside: dropped
    top = jnp.full(cfg.size**2, -jnp.inf).at[cell].max(points[:, 2], mode="drop")
    is_top = points[:, 2] == top.at[cell].get(mode="fill", fill_value=jnp.inf)
    index = jnp.arange(points.shape[0], dtype=jnp.int32)
    last = jnp.int32(points.shape[0] - 1)
    source = (
        jnp.full(cfg.size**2, last).at[jnp.where(is_top, cell, cfg.size**2)].min(index, mode="drop")
    )
    filled = top > -jnp.inf
    height = jnp.where(filled, jnp.maximum(top, 0.0), 0.0)
    return Cells(*(leaf.reshape(cfg.size, cfg.size) for leaf in (height, source, filled)))


def from_depth(
    cfg: HeightmapConfig,
    eye: Camera,
    depth: jax.Array,
    valid: jax.Array,
    surface: jax.Array,
    tables: tuple[jax.Array, jax.Array],
) -> Observation:
    """Top view from a depth image of `eye`.

    Args: depth [h, w] m; valid [h, w] bool; surface [h, w] int32, row of the tables; tables, of
    every surface its colour [S, 3] and whether it is of the block to get [S] bool, first of the
    table.
    """
    cells = from_points(cfg, camera.points(eye, depth).reshape(-1, 3), valid.reshape(-1))
    row = surface.reshape(-1).at[cells.source].get(mode="promise_in_bounds")
    colour, target = (table.at[row].get(mode="promise_in_bounds") for table in tables)
    return Observation(
        colour=jnp.where(cells.filled[..., None], colour, 0.0),
        height=cells.height,
        target=jnp.where(cells.filled, target, tables[1][0]),
    )


def surface_tables(
    polytopes: raycast.Polytopes, table_colour: jax.Array, wanted: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Of every surface (see `raycast.Meeting`): its colour as lit, [S, 3], and whether it is
    wanted, [S] bool."""
    normal, _ = raycast.surfaces(polytopes)
    geoms, faces = polytopes.offset.shape

    def spread(
        of_table: jax.Array, of_geom: jax.Array
    ) -> jax.Array:  # not a gather, which XLA would do for every ray
        each = jnp.broadcast_to(of_geom[:, None], (geoms, faces, *of_geom.shape[1:]))
        return jnp.concatenate([of_table[None], each.reshape(-1, *of_geom.shape[1:])])

    return shade.flat(spread(table_colour, polytopes.colour), normal), spread(
        jnp.all(wanted), wanted
    )


def pack(obs: Observation) -> PackedObservation:
    """Rounds to a colour level and to a tenth of a millimetre; heights are cut off at 0 and 6.5534
    m."""
    counts = jnp.clip(jnp.round(obs.height / _HEIGHT_UNIT), 0.0, BEYOND_COUNT - 1.0)
    levels = jnp.clip(jnp.round(obs.colour * 255.0), 0.0, 255.0)
    return PackedObservation(levels.astype(jnp.uint8), counts.astype(jnp.uint16), obs.target)


def unpack(packed: PackedObservation) -> Observation:
    """The observation that was packed, up to half a colour level and half a tenth of a
    millimetre."""
    height = packed.height.astype(jnp.float32) * _HEIGHT_UNIT
    return Observation(
        colour=packed.colour.astype(jnp.float32) / 255.0,
        height=jnp.where(packed.height == BEYOND_COUNT, BEYOND, height),
        target=packed.target,
    )


def moved_area(cfg: HeightmapConfig, before: jax.Array, after: jax.Array) -> jax.Array:
    """Area [] cm^2 where the height changed by 1 cm to 30 cm (VPG's bounds), from two height maps
    [H, W] m."""
    change = jnp.abs(after - before)
    return _area(cfg, (change >= 0.01) & (change <= 0.3))


def occupied_area(cfg: HeightmapConfig, height: jax.Array) -> jax.Array:
    """Area [] cm^2 that lies more than 2 cm above the table (VPG's bound), from a height map [H, W]
    m."""
    return _area(cfg, height > 0.02)


def _area(cfg: HeightmapConfig, chosen: jax.Array) -> jax.Array:
    """Area [] cm^2 of the cells that are True in `chosen` [H, W]; an area, not a count, survives
    another resolution."""
    return chosen.sum(dtype=jnp.int32).astype(jnp.float32) * (cfg.cell**2 * _CM2)
