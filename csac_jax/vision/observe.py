"""From the state of one scene to the observation of it.

Two views (`HeightmapConfig.view`). `ortho` is complete: one ray straight down per cell. `oblique`
is the depth image of a camera at the side, as points projected along gravity, as in VPG
(arXiv:1803.09956); what the camera does not see is empty. With a key, either has sensor noise.

A surface is a face of a geom or the table, numbered as in `raycast.SurfaceHit`. S = surfaces, G =
geoms, [h, w] = camera pixels.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.config import Config, HeightmapConfig, SensorConfig, SlotKind
from csac_jax.scene import blocks, layout
from csac_jax.scene.layout import Scene
from csac_jax.vision import camera, depth_camera, heightmap, raycast, sensor
from csac_jax.vision.camera import Camera
from csac_jax.vision.heightmap import VIEW_HEIGHT, Observation
from csac_jax.vision.raycast import Polytopes, SurfaceHit

_LIGHT = np.uint32(2**31)  # distinct from a view key's children by `split`


class SurfaceTables(NamedTuple):
    """What is seen of each surface; row 0 is the table."""

    colour: jax.Array  # [S, 3] as lit, 0 .. 1
    is_target: jax.Array  # [S] bool


def observe(cfg: Config, scene: Scene, key: jax.Array | None = None) -> Observation:
    """The observation of one scene, leaves [H, W, ...]; exact, or with the noise of `cfg.sensor`
    drawn from `key`."""
    shapes = polytopes(cfg.scene.slots, scene)
    is_target = layout.is_target(scene)[blocks.parts(cfg.scene.slots).slot]
    tables = surface_tables(shapes, is_target, _light(cfg.sensor, key))
    if cfg.heightmap.view == "ortho":
        exact = ortho(cfg.heightmap, shapes, tables)
        return exact if key is None else ortho_noisy(key, cfg.sensor, exact, tables)
    believed = camera.make(cfg.camera)
    if key is not None:
        return oblique_noisy(key, cfg, shapes, tables, believed)
    hits = camera.cast_rays(believed, raycast.cast_polytopes, shapes)
    return from_pixels(cfg.heightmap, believed, hits, tables)


def polytopes(slots: tuple[SlotKind, ...], scene: Scene) -> Polytopes:
    """The convex parts of a scene's blocks, for the raycaster."""
    slot = blocks.parts(slots).slot  # [G], of each convex part
    return Polytopes(
        *blocks.half_spaces(slots, scene.half_size),
        scene.position[slot],
        jax.vmap(geometry.quat_to_matrix)(scene.quaternion)[slot],
        jnp.asarray(blocks.COLOURS)[scene.colour[slot]],
    )


def _light(noise: SensorConfig, key: jax.Array | None) -> Any:
    """Unit vector [3] towards the light."""
    if key is None or noise.light == 0.0:
        return camera.LIGHT
    return sensor.light(jax.random.fold_in(key, _LIGHT), noise)


def surface_tables(
    shapes: Polytopes, is_target: jax.Array, light: Any = camera.LIGHT
) -> SurfaceTables:
    """Lit colour and target flag of every surface; the table counts as target if all geoms do.

    Args: is_target [G] bool, geoms of the block to get; all True if any block will do; light, see
    `camera.shade`.
    """

    def per_surface(table: jax.Array, geom: jax.Array) -> jax.Array:
        return jnp.concatenate([table[None], jnp.repeat(geom, shapes.offset.shape[1], axis=0)])

    colour = per_surface(jnp.asarray(blocks.TABLE_COLOUR), shapes.colour)
    lit = camera.shade(colour, raycast.surface_normals(shapes), light)
    return SurfaceTables(lit, per_surface(jnp.all(is_target), is_target))


def ortho(cfg: HeightmapConfig, shapes: Polytopes, tables: SurfaceTables) -> Observation:
    """The view from above: one ray from VIEW_HEIGHT through every cell centre.

    The direction has no ray axis under vmap, so a plane costs one scalar product per ray.
    """
    height = jnp.full((cfg.size, cfg.size, 1), VIEW_HEIGHT, jnp.float32)
    origin = jnp.concatenate([geometry.cell_centres(cfg), height], axis=-1).reshape(-1, 3)
    down = jnp.array([0.0, 0.0, -1.0], jnp.float32)
    cast = jax.vmap(raycast.cast_polytopes, in_axes=(None, 0, None))
    distance, surface, _ = (leaf.reshape(cfg.size, -1) for leaf in cast(shapes, origin, down))
    colour, target = (table.at[surface].get(mode="promise_in_bounds") for table in tables)
    return Observation(colour, jnp.maximum(VIEW_HEIGHT - distance, 0.0), target)


def ortho_noisy(
    key: jax.Array, noise: SensorConfig, exact: Observation, tables: SurfaceTables
) -> Observation:
    """`exact` as a depth sensor at VIEW_HEIGHT measures it; cells without a depth are empty."""
    key_depth, key_colour = jax.random.split(key)
    depth, valid = sensor.depth(key_depth, noise, VIEW_HEIGHT - exact.height)
    colour = jnp.where(valid[..., None], exact.colour, 0.0)
    return Observation(
        colour=sensor.colour(key_colour, noise, colour),
        height=jnp.where(valid, jnp.maximum(VIEW_HEIGHT - depth, 0.0), 0.0),
        target=jnp.where(valid, exact.target, tables.is_target[0]),
    )


def from_pixels(
    cfg: HeightmapConfig, eye: Camera, hits: SurfaceHit, tables: SurfaceTables
) -> Observation:
    """The view from above of what pixels [h, w] hit; cells that they miss have height, colour 0."""
    points = camera.points(eye, hits.distance).reshape(-1, 3)
    cells = heightmap.from_points(cfg, points, hits.valid.reshape(-1))
    row = hits.surface.reshape(-1).at[cells.source].get(mode="promise_in_bounds")
    colour, target = (table.at[row].get(mode="promise_in_bounds") for table in tables)
    return heightmap.observation(cells, colour, target, tables.is_target[0])


def oblique_noisy(
    key: jax.Array, cfg: Config, shapes: Polytopes, tables: SurfaceTables, believed: Camera
) -> Observation:
    """`from_pixels` with sensor noise; the real camera stands a little off the `believed` one.
    Flying pixels are left out, as `deploy` does."""
    key_pose, key_depth, key_colour = jax.random.split(key, 3)
    real = sensor.pose(key_pose, cfg.sensor, believed)
    hits = camera.cast_rays(real, raycast.cast_polytopes, shapes)
    exact = jnp.where(hits.valid, hits.distance, 0.0)
    lit = tables.colour.at[hits.surface].get(mode="promise_in_bounds")
    depth, valid = sensor.depths(key_depth, cfg.sensor, cfg.camera, exact, hits.valid, lit)
    if cfg.sensor.kind != "none":
        valid &= depth_camera.supported(jnp.where(valid, depth, 0.0), cfg.camera.focal[0])
    hits = hits._replace(distance=depth, valid=valid)
    obs = from_pixels(cfg.heightmap, believed, hits, tables)
    return obs.replace(colour=sensor.colour(key_colour, cfg.sensor, obs.colour))
