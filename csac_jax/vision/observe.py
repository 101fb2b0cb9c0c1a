"""From the state of one scene to its observation, with a key and sensor noise if wished.

`HeightmapConfig.view` `ortho` is complete: one ray straight down per cell. `oblique` is the depth
image of a camera at the side, its points projected along gravity as in VPG (arXiv:1803.09956);
hidden cells are empty. S = surfaces, see `raycast.SurfaceHit`, G = geoms, [h, w] = camera pixels.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.config import Config, HeightmapConfig, SceneConfig, SlotKind
from csac_jax.vision import camera, depth_camera, heightmap, raycast, sensor
from csac_jax.vision.camera import Camera
from csac_jax.vision.heightmap import VIEW_HEIGHT, Observation
from csac_jax.vision.raycast import ObjectShapes, Polytopes, SurfaceHit
from csac_jax.world import blocks, object_slots, scene_state, tray
from csac_jax.world.scene_state import SceneState

HIGHEST = 0.25  # m, of the middle of an object that the camera at the side sees whole
_LIGHT = np.uint32(2**31)  # distinct from a view key's children by `split`


class SurfaceTables(NamedTuple):
    """Appearance of each surface; row 0 is the table."""

    colour: jax.Array  # [S, 3] as lit, 0 .. 1
    is_target: jax.Array  # [S] bool


class Shapes(NamedTuple):
    """Shapes in a scene for rays; surfaces of blocks are numbered before those of objects."""

    blocks: Polytopes
    objects: ObjectShapes | None = None

    @property
    def first(self) -> int:
        """Returns the number of the first surface of an object."""
        return 1 + self.blocks.offset.size


def observe(cfg: Config, scene: SceneState, key: jax.Array | None = None) -> Observation:
    """Observes one scene, leaves [H, W, ...]; exact, or with the noise of `cfg.sensor` by `key`."""
    shapes = scene_shapes(cfg.scene, scene)
    light: Any = camera.LIGHT
    if key is not None and cfg.sensor.light > 0.0:
        light = sensor.light(jax.random.fold_in(key, _LIGHT), cfg.sensor)
    tables = scene_tables(cfg.scene, scene, shapes, light)
    look = oblique if cfg.heightmap.view == "oblique" else above
    return look(cfg, shapes, tables, key)


def seen_share(cfg: SceneConfig, scene: SceneState) -> jax.Array:
    """Returns the share [] of the target that nothing covers from straight above, by 2 mm cells."""
    fine = HeightmapConfig(size=224)
    alone = scene_state.park(scene, scene_state.is_target(scene))

    def cells(scene: SceneState) -> jax.Array:
        shapes = scene_shapes(cfg, scene)
        obs = ortho(fine, shapes, scene_tables(cfg, scene, shapes))
        return jnp.sum(obs.target & (obs.height > 0.0), dtype=jnp.int32).astype(jnp.float32)

    return cells(scene) / jnp.maximum(cells(alone), 1.0)


def scene_shapes(cfg: SceneConfig, scene: SceneState) -> Shapes:
    """Returns the convex parts of a scene's blocks, of the tray's walls after them, and objects."""
    objects, parts = _objects(cfg, scene) if cfg.has_objects else None, polytopes(cfg.slots, scene)
    if cfg.tray:
        parts = jax.tree.map(lambda *two: jnp.concatenate(two), parts, _walls(cfg.tray))
    return Shapes(parts, objects)


def _walls(side: float) -> Polytopes:
    centre, half = tray.walls(side)
    boxes: tuple[SlotKind, ...] = ("box", "box", "box", "box")
    normal, offset = blocks.half_spaces(boxes, jnp.asarray(half))
    turn = jnp.broadcast_to(jnp.eye(3), (tray.NUMBER, 3, 3))
    colour = jnp.broadcast_to(jnp.asarray(tray.COLOUR), (tray.NUMBER, 3))
    return Polytopes(normal, offset, jnp.asarray(centre), turn, colour)


def polytopes(slots: tuple[SlotKind, ...], scene: SceneState) -> Polytopes:
    """Returns the convex parts of a scene's blocks."""
    slot = blocks.parts(slots).slot  # [G], of each convex part
    return Polytopes(
        *blocks.half_spaces(slots, scene.half_size),
        scene.position[slot],
        jax.vmap(geometry.quat_to_matrix)(scene.quaternion)[slot],
        jnp.asarray(blocks.COLOURS)[scene.colour[slot]],
    )


def _objects(cfg: SceneConfig, scene: SceneState) -> ObjectShapes:
    known, slot = object_slots.table(cfg), np.flatnonzero(blocks.is_object(cfg.slots))  # [M]
    number = scene.numbers[slot]
    leaves = known.normal, known.offset, known.first, known.centre
    normal, offset, first, centre = (jnp.asarray(leaf)[number] for leaf in leaves)
    position = scene.position[slot]
    rotation = jax.vmap(geometry.quat_to_matrix)(scene.quaternion[slot])  # [M, 3, 3]
    # Products and sums, as in `raycast.world_half_spaces`.
    normal = (rotation[:, None, None] * normal[:, :, :, None]).sum(-1)
    return ObjectShapes(
        normal,
        offset + (normal * position[:, None, None]).sum(-1),
        first,
        position + (rotation * centre[:, None]).sum(-1),
        jnp.asarray(blocks.COLOURS)[scene.colour[slot]],
        known.radius,
    )


def scene_tables(
    cfg: SceneConfig, scene: SceneState, shapes: Shapes, light: Any = camera.LIGHT
) -> SurfaceTables:
    """Returns lit colour and target flag of every surface of a scene, see `surface_tables`."""
    is_target = scene_state.is_target(scene)
    of_blocks = is_target[blocks.parts(cfg.slots).slot]
    if cfg.tray:  # a wall is wanted where the table is
        walls = jnp.broadcast_to(jnp.all(is_target), tray.NUMBER)
        of_blocks = jnp.concatenate([of_blocks, walls])
    tables = surface_tables(shapes.blocks, of_blocks, light)
    if shapes.objects is None:
        return tables
    of_objects = is_target[np.flatnonzero(blocks.is_object(cfg.slots))]
    faces = shapes.objects.normal[0].size // 3
    colour = jnp.repeat(shapes.objects.colour, faces, axis=0)
    lit = camera.shade(colour, shapes.objects.normal.reshape(-1, 3), light)
    table = jnp.all(is_target)[None]
    flags = [table, tables.is_target[1:], jnp.repeat(of_objects, faces)]
    return SurfaceTables(jnp.concatenate([tables.colour, lit]), jnp.concatenate(flags))


def surface_tables(
    shapes: Polytopes, is_target: jax.Array, light: Any = camera.LIGHT
) -> SurfaceTables:
    """Returns lit colour and target flag of every surface; the table is target if all geoms are.

    Args: is_target [G] bool, geoms of wanted blocks; light, see `camera.shade`.
    """

    def per_surface(table: jax.Array, geom: jax.Array) -> jax.Array:
        return jnp.concatenate([table[None], jnp.repeat(geom, shapes.offset.shape[1], axis=0)])

    colour = per_surface(jnp.asarray(blocks.TABLE_COLOUR), shapes.colour)
    lit = camera.shade(colour, raycast.surface_normals(shapes), light)
    return SurfaceTables(lit, per_surface(jnp.all(is_target), is_target))


def ortho(cfg: HeightmapConfig, shapes: Shapes, tables: SurfaceTables) -> Observation:
    """Observes from above: one ray from VIEW_HEIGHT through every cell centre."""
    down = jnp.array([0.0, 0.0, -1.0], jnp.float32)

    def ray(rows: jax.Array, columns: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, y = ((i.astype(jnp.float32) - 0.5 * (cfg.size - 1)) * cfg.cell for i in (columns, rows))
        return jnp.stack([x, y, jnp.full_like(x, VIEW_HEIGHT)], axis=-1), down

    numbers = jnp.arange(cfg.size, dtype=jnp.int32)
    origin, _ = ray(*jnp.meshgrid(numbers, numbers, indexing="ij"))
    # The direction has no ray axis, so a plane costs one scalar product per ray.
    cast = jax.vmap(raycast.cast_polytopes, in_axes=(None, 0, None))
    hits = cast(shapes.blocks, origin.reshape(-1, 3), down)
    hits = SurfaceHit(*(leaf.reshape(cfg.size, -1) for leaf in hits))
    if (objects := shapes.objects) is not None:
        side = min(math.ceil(2.0 * objects.radius / cfg.cell) + 1, cfg.size)
        low = objects.centre[:, 1::-1] - objects.radius  # y, x
        corner = jnp.floor((low + 0.5 * cfg.extent) / cfg.cell)
        hits = raycast.cast_windows(objects, hits, corner, (side, side), ray, shapes.first)
    colour, target = (table.at[hits.surface].get(mode="promise_in_bounds") for table in tables)
    return Observation(colour, jnp.maximum(VIEW_HEIGHT - hits.distance, 0.0), target)


def cast_pixels(cfg: Config, eye: Camera, shapes: Shapes) -> SurfaceHit:
    """Casts the pixels [h, w] of a camera that stands at `cfg.camera`, or nearly."""
    hits, objects = camera.cast_rays(eye, raycast.cast_polytopes, shapes.blocks), shapes.objects
    if objects is None:
        return hits
    radius = 1.05 * objects.radius  # a camera with a noisy pose is a little nearer
    side = camera.window(cfg.camera, cfg.heightmap.extent, HIGHEST, radius)
    pixel = jax.vmap(camera.project, (None, 0))(eye, objects.centre)
    corner = jnp.floor(pixel[:, ::-1] - 0.5 * jnp.asarray(side, jnp.float32)[None])

    def ray(rows: jax.Array, columns: jax.Array) -> tuple[jax.Array, jax.Array]:
        return eye.position, camera.direction(eye, rows, columns)

    return raycast.cast_windows(objects, hits, corner, side, ray, shapes.first)


def above(cfg: Config, shapes: Shapes, tables: SurfaceTables, key: jax.Array | None) -> Observation:
    """Observes from above; with a key with the noise of a sensor at VIEW_HEIGHT, and cells without
    a depth are empty."""
    exact, noise = ortho(cfg.heightmap, shapes, tables), cfg.sensor
    if key is None:
        return exact
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
    """Projects the hits of pixels [h, w] to the view from above; missed cells have height 0."""
    points = camera.points(eye, hits.distance).reshape(-1, 3)
    cells = heightmap.from_points(cfg, points, hits.valid.reshape(-1))
    row = hits.surface.reshape(-1).at[cells.source].get(mode="promise_in_bounds")
    colour, target = (table.at[row].get(mode="promise_in_bounds") for table in tables)
    return heightmap.observation(cells, colour, target, tables.is_target[0])


def oblique(
    cfg: Config, shapes: Shapes, tables: SurfaceTables, key: jax.Array | None
) -> Observation:
    """Observes by a camera; with a key the real one is a little off and its image has noise."""
    believed = camera.make(cfg.camera)
    if key is None:
        return from_pixels(cfg.heightmap, believed, cast_pixels(cfg, believed, shapes), tables)
    key_pose, key_depth, key_colour = jax.random.split(key, 3)
    hits = cast_pixels(cfg, sensor.pose(key_pose, cfg.sensor, believed), shapes)
    exact = jnp.where(hits.valid, hits.distance, 0.0)
    lit = tables.colour.at[hits.surface].get(mode="promise_in_bounds")
    depth, valid = sensor.depths(key_depth, cfg.sensor, cfg.camera, exact, hits.valid, lit)
    if cfg.sensor.kind != "none":  # without flying pixels
        valid &= depth_camera.supported(jnp.where(valid, depth, 0.0), cfg.camera.focal[0])
    hits = hits._replace(distance=depth, valid=valid)
    obs = from_pixels(cfg.heightmap, believed, hits, tables)
    return obs.replace(colour=sensor.colour(key_colour, cfg.sensor, obs.colour))
