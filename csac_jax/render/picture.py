"""Pictures of a MuJoCo model: by MuJoCo's renderer with OpenGL, by our rays without.

Call `gl.choose` before MuJoCo is imported.
"""

import contextlib
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from csac_jax.config import CameraConfig
from csac_jax.vision import camera, raycast
from csac_jax.vision.raycast import Polytopes
from csac_jax.world import blocks
from csac_jax.world.model import BlockFields, World, with_blocks
from csac_jax.world.scene_state import SceneState

FLOOR = (0.85, 0.86, 0.88, 1.0)
SKY = np.ones(4, np.float32)
FOVY = 45.0  # vertical field of view, degrees
SIDES = 12  # of round geoms, as rays see them
LAMP = np.array([-0.7, -0.5, 2.2])  # place of the light, m: shadows fall away from the viewer

_Geom = mujoco.mjtGeom

Draw = Callable[[mujoco.MjData], np.ndarray]  # a state -> its picture [H, W, 3] uint8


class Viewpoint(NamedTuple):
    """Place, direction and size of a picture."""

    position: tuple[float, float, float]  # m
    look_at: tuple[float, float, float]  # m
    size: tuple[int, int] = (640, 480)  # width and height, px


def coloured(world: World, fields: BlockFields, scene: SceneState) -> mujoco.MjModel:
    """Returns the world's model with the blocks of a scene, of these fields, in their colours."""
    model = with_blocks(world, fields)
    model.geom_rgba[world.block_geoms, :3] = blocks.COLOURS[scene.colour[world.parts.slot]]
    if world.objects is not None:
        objects, number = world.objects, scene.numbers[world.objects.slots]
        model.geom_rgba[objects.geoms, :3] = blocks.COLOURS[scene.colour[objects.slots]][:, None]
        model.geom_rgba[objects.geoms, 3] = objects.tables.present[number]  # others are not drawn
    return model


def renderer(model: mujoco.MjModel, view: Viewpoint, opengl: str | None) -> Draw:
    """Draws by OpenGL, or by our rays if that is None or fails. Recolours the model's planes."""
    model.geom_rgba[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE] = FLOOR
    if opengl is not None:
        with contextlib.suppress(Exception):  # a broken driver raises nearly anything
            return _opengl_renderer(model, view)
    return _ray_renderer(model, view)


def _opengl_renderer(model: mujoco.MjModel, view: Viewpoint) -> Draw:
    model.vis.global_.fovy = FOVY
    model.vis.global_.offwidth, model.vis.global_.offheight = view.size
    _light(model)
    opengl = mujoco.Renderer(model, *reversed(view.size))
    opengl.scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 0  # the sky is seen from inside
    aim(eye := mujoco.MjvCamera(), view)
    options, sphere = mujoco.MjvOption(), mujoco.mjtGeom.mjGEOM_SPHERE
    options.geomgroup[:], options.sitegroup[:] = 1, 0

    def draw(data: mujoco.MjData) -> np.ndarray:
        opengl.update_scene(data, eye, options)
        sky = opengl.scene.geoms[opengl.scene.ngeom]  # a luminous sphere: the background is black
        mujoco.mjv_initGeom(sky, sphere, np.full(3, 20.0), np.zeros(3), np.eye(3).ravel(), SKY)
        sky.emission, sky.specular = 1.0, 0.0
        opengl.scene.ngeom += 1
        return opengl.render().copy()

    return draw


def aim(eye: Any, view: Viewpoint) -> None:
    """Places a camera of MuJoCo at a viewpoint."""
    offset = np.array(view.look_at) - np.array(view.position)
    eye.lookat[:], eye.distance = view.look_at, np.linalg.norm(offset)
    eye.azimuth = np.degrees(np.arctan2(offset[1], offset[0]))
    eye.elevation = np.degrees(np.arcsin(offset[2] / eye.distance))


def _light(model: mujoco.MjModel) -> None:
    model.light_pos[:], model.light_dir[:] = LAMP, -LAMP / np.linalg.norm(LAMP)
    model.light_cutoff[:], model.light_exponent[:] = 80.0, 0.0  # degrees; as bright at the edge
    model.light_diffuse[:], model.light_specular[:] = 0.45, 0.1
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.5, 0.2
    model.vis.map.shadowscale = 0.3  # of the lamp's cone; all of the arm lies in it
    model.vis.quality.shadowsize, model.vis.quality.offsamples = 4096, 8


def _ray_renderer(model: mujoco.MjModel, view: Viewpoint) -> Draw:
    width, height = view.size
    focal = 0.5 * height / np.tan(np.radians(0.5 * FOVY))
    centre = 0.5 * (width - 1), 0.5 * (height - 1)
    eye = camera.make(CameraConfig(view.size, (focal, focal), centre, view.position, view.look_at))
    shown, rest = _polytopes(model)
    reach = model.geom_size[model.geom_type == _Geom.mjGEOM_PLANE, :2].max(initial=0.0)

    @jax.jit
    def render(position: jax.Array, rotation: jax.Array) -> jax.Array:
        shapes = rest.replace(position=position[shown], rotation=rotation[shown].reshape(-1, 3, 3))
        hits = camera.cast_rays(eye, raycast.cast_polytopes, shapes)
        each = jnp.repeat(shapes.colour, shapes.offset.shape[1], axis=0)
        colour = jnp.concatenate([jnp.array([FLOOR[:3]]), each])
        lit = camera.shade(colour, raycast.surface_normals(shapes))[hits.surface]
        place = jnp.abs(camera.points(eye, hits.distance)[..., :2])
        seen = hits.valid & ((hits.surface > 0) | jnp.all(place <= reach, axis=-1))
        return jnp.where(seen[..., None], lit, SKY[None, None, :3])

    def draw(data: mujoco.MjData) -> np.ndarray:
        placed = data.geom_xpos.astype(np.float32), data.geom_xmat.astype(np.float32)
        return np.round(255 * np.asarray(render(*placed))).astype(np.uint8)

    return draw


def _polytopes(model: mujoco.MjModel) -> tuple[np.ndarray, Polytopes]:
    """Returns the numbers of visible geoms [G] but planes, and their hulls without a pose."""
    materials = np.concatenate([model.mat_rgba, np.zeros((1, 4), np.float32)])
    no_material = model.geom_matid[:, None] < 0  # -1: the last row
    rgba: Any = np.where(no_material, model.geom_rgba, materials[model.geom_matid])
    shown = np.flatnonzero((rgba[:, 3] > 0.0) & (model.geom_type != _Geom.mjGEOM_PLANE))
    hulls = [ConvexHull(_corners(model, geom)).equations.round(6) for geom in map(int, shown)]
    hulls = [np.unique(hull, axis=0) for hull in hulls]  # triangles of one face
    faces: Any = np.zeros((len(hulls), max(map(len, hulls), default=1), 4), np.float32)
    faces[..., 3] = -blocks.PADDING_OFFSET
    for row, hull in zip(faces, hulls, strict=True):
        row[: len(hull)] = hull
    unplaced: Any = np.zeros(0, np.float32)
    colour: Any = rgba[shown, :3]
    return shown, Polytopes(faces[..., :3], -faces[..., 3], unplaced, unplaced, colour)


def _corners(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Returns points [n, 3] m of a geom whose hull is drawn; round ones have SIDES sides."""
    size, kind = model.geom_size[geom], _Geom(int(model.geom_type[geom]))
    if kind == _Geom.mjGEOM_MESH:
        return np.split(model.mesh_vert, model.mesh_vertadr[1:])[model.geom_dataid[geom]]
    if kind == _Geom.mjGEOM_BOX:
        return size * np.array([*itertools.product((-1.0, 1.0), repeat=3)])
    around = 2.0 * np.pi * np.arange(SIDES) / SIDES
    circle = np.stack([np.cos(around), np.sin(around), 0.0 * around], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    if kind == _Geom.mjGEOM_CYLINDER:
        return np.concatenate([size[0] * circle + z * size[1] * up for z in (-1.0, 1.0)])
    rows = np.radians([-75.0, -45.0, -15.0, 15.0, 45.0, 75.0])
    ball = np.concatenate([np.cos(row) * circle + np.sin(row) * up for row in rows])
    if kind == _Geom.mjGEOM_CAPSULE:
        return size[0] * ball + np.sign(ball[:, 2:]) * size[1] * up
    if kind not in (_Geom.mjGEOM_SPHERE, _Geom.mjGEOM_ELLIPSOID):
        raise ValueError(f"geom {geom}: rays do not draw its type; set MUJOCO_GL, or use a mesh")
    return ball * (size if kind == _Geom.mjGEOM_ELLIPSOID else size[0])
