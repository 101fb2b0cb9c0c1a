"""From the state of one scene to the observation of it.

Two views (`HeightmapConfig.view`). `ortho` is complete: one ray straight down per cell. `oblique`
is the depth image of a camera at the side, as points projected along gravity, as in VPG
(arXiv:1803.09956); what the camera does not see is empty. With a key, either has sensor noise.

A surface is a face of a geom or the table, numbered as in `raycast.SurfaceHit`. S = surfaces, G =
geoms, [h, w] = camera pixels.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.config import Config, HeightmapConfig, SensorConfig
from csac_jax.scene import blocks, layout
from csac_jax.scene.layout import Scene
from csac_jax.vision import camera, heightmap, raycast, sensor, shade
from csac_jax.vision.camera import Camera
from csac_jax.vision.heightmap import VIEW_HEIGHT, Observation
from csac_jax.vision.raycast import Polytopes, SurfaceHit


class SurfaceTables(NamedTuple):
    """What is seen of each surface; row 0 is the table."""

    colour: jax.Array  # [S, 3] as lit, 0 .. 1
    is_target: jax.Array  # [S] bool


def observe(cfg: Config, scene: Scene, key: jax.Array | None = None) -> Observation:
    """The observation of one scene, leaves [H, W, ...]; exact, or with noise drawn from `key`.

    The noise is that of `cfg.sensor`.
    """
    slot = blocks.parts(cfg.scene.slots).slot
    shapes = _polytopes(cfg, scene, slot)
    is_target = (slot == scene.target) | (scene.target == layout.ANY)
    if cfg.heightmap.view == "oblique":
        believed = camera.make(cfg.camera)
        if key is None:
            return oblique(cfg.heightmap, shapes, is_target, believed)
        return oblique_noisy(key, cfg.heightmap, cfg.sensor, shapes, is_target, believed)
    exact = ortho(cfg.heightmap, shapes, is_target)
    return exact if key is None else ortho_noisy(key, cfg.sensor, exact, is_target)


def _polytopes(cfg: Config, scene: Scene, slot: np.ndarray) -> Polytopes:
    """The convex parts of all blocks of one scene; slot [G] is the block of each."""
    normal, offset = blocks.half_spaces(cfg.scene.slots, scene.half_size)
    return Polytopes(
        normal=normal,
        offset=offset,
        position=scene.position[slot],
        rotation=jax.vmap(geometry.quat_to_matrix)(scene.quaternion)[slot],
        colour=jnp.asarray(blocks.COLOURS)[scene.colour[slot]],
    )


def ortho(cfg: HeightmapConfig, shapes: Polytopes, is_target: jax.Array) -> Observation:
    """The view from above: one ray from VIEW_HEIGHT through every cell centre.

    The direction has no ray axis under vmap, so a plane costs one scalar product per ray.

    Args: is_target [G] bool, geoms of the block to get; all True if any block will do.
    """
    centre = geometry.cell_centres(cfg)
    height = jnp.full((cfg.size, cfg.size, 1), VIEW_HEIGHT, jnp.float32)
    origin = jnp.concatenate([centre, height], axis=-1).reshape(-1, 3)
    down = jnp.array([0.0, 0.0, -1.0], jnp.float32)
    cast = jax.vmap(raycast.cast_polytopes, in_axes=(None, 0, None))
    distance, surface, _ = cast(shapes, origin, down)
    colour, target = surface_tables(shapes, is_target)
    return Observation(
        colour=colour.at[surface].get(mode="promise_in_bounds").reshape(cfg.size, cfg.size, 3),
        height=jnp.maximum(VIEW_HEIGHT - distance, 0.0).reshape(cfg.size, cfg.size),
        target=target.at[surface].get(mode="promise_in_bounds").reshape(cfg.size, cfg.size),
    )


def ortho_noisy(
    key: jax.Array, noise: SensorConfig, exact: Observation, is_target: jax.Array
) -> Observation:
    """The view `exact` from above as a depth sensor at VIEW_HEIGHT measures it.

    Cells without a depth are empty. Args: is_target as of `ortho`.
    """
    key_depth, key_colour = jax.random.split(key)
    depth, valid = sensor.depth(key_depth, noise, VIEW_HEIGHT - exact.height)
    colour = jnp.where(valid[..., None], exact.colour, 0.0)
    return Observation(
        colour=sensor.colour(key_colour, noise, colour),
        height=jnp.where(valid, jnp.maximum(VIEW_HEIGHT - depth, 0.0), 0.0),
        target=jnp.where(valid, exact.target, jnp.all(is_target)),
    )


def oblique(
    cfg: HeightmapConfig, shapes: Polytopes, is_target: jax.Array, eye: Camera
) -> Observation:
    """The view from above by a camera; cells that it does not see have height 0 and colour 0.

    Args: is_target as of `ortho`.
    """
    hits = pixel_hits(shapes, eye)
    tables = surface_tables(shapes, is_target)
    return from_depth(cfg, eye, hits.distance, hits.valid, hits.surface, tables)


def oblique_noisy(
    key: jax.Array,
    cfg: HeightmapConfig,
    noise: SensorConfig,
    shapes: Polytopes,
    is_target: jax.Array,
    believed: Camera,
) -> Observation:
    """`oblique` with sensor noise; the real camera stands a little off the `believed` one."""
    key_pose, key_depth, key_colour = jax.random.split(key, 3)
    hits = pixel_hits(shapes, sensor.pose(key_pose, noise, believed))
    exact = jnp.where(hits.valid, hits.distance, 0.0)
    depth, valid = sensor.depth(key_depth, noise, exact)
    tables = surface_tables(shapes, is_target)
    obs = from_depth(cfg, believed, depth, hits.valid & valid, hits.surface, tables)
    return obs.replace(colour=sensor.colour(key_colour, noise, obs.colour))


def pixel_hits(shapes: Polytopes, eye: Camera) -> SurfaceHit:
    """What each camera pixel sees, [h, w]; the distance is the depth along the optical axis, m."""
    return camera.cast_rays(eye, lambda *ray: raycast.cast_polytopes(shapes, *ray))


def from_depth(
    cfg: HeightmapConfig,
    eye: Camera,
    depth: jax.Array,
    valid: jax.Array,
    surface: jax.Array,
    tables: SurfaceTables,
) -> Observation:
    """The view from above of a depth image.

    Args: depth [h, w] m; valid [h, w] bool; surface [h, w] int32, row of the tables.
    """
    cells = heightmap.from_points(cfg, camera.points(eye, depth).reshape(-1, 3), valid.reshape(-1))
    row = surface.reshape(-1).at[cells.source].get(mode="promise_in_bounds")
    colour, target = (table.at[row].get(mode="promise_in_bounds") for table in tables)
    return Observation(
        colour=jnp.where(cells.filled[..., None], colour, 0.0),
        height=cells.height,
        target=jnp.where(cells.filled, target, tables.is_target[0]),
    )


def surface_tables(shapes: Polytopes, is_target: jax.Array) -> SurfaceTables:
    """Lit colour and target flag of every surface; the table counts as target if all geoms do."""
    normal = raycast.surface_normals(shapes)
    geoms, faces = shapes.offset.shape

    def per_surface(table: jax.Array, geom: jax.Array) -> jax.Array:
        """[S, ...] from the table's value and the geoms' [G, ...]; XLA would gather per ray."""
        each = jnp.broadcast_to(geom[:, None], (geoms, faces, *geom.shape[1:]))
        return jnp.concatenate([table[None], each.reshape(-1, *geom.shape[1:])])

    colour = per_surface(jnp.asarray(blocks.TABLE_COLOUR), shapes.colour)
    return SurfaceTables(shade.flat(colour, normal), per_surface(jnp.all(is_target), is_target))
