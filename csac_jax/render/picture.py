"""Pictures of a MuJoCo model: by MuJoCo's renderer with OpenGL, by its rays without.

Call `gl.choose` before MuJoCo is imported.
"""

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from csac_jax.config import CameraConfig
from csac_jax.vision import camera
from csac_jax.world import blocks
from csac_jax.world.model import BlockFields, World, with_blocks
from csac_jax.world.scene_state import SceneState

FLOOR = (0.85, 0.86, 0.88, 1.0)
SKY = np.ones(4, np.float32)
FOVY = 45.0  # vertical field of view, degrees
LAMP = np.array([-0.7, -0.5, 2.2])  # place of the light, m: shadows fall away from the viewer

Draw = Callable[[mujoco.MjData], np.ndarray]  # a state -> its picture [H, W, 3] uint8


class Viewpoint(NamedTuple):
    """Place, direction and size of a picture."""

    position: tuple[float, float, float]  # m
    look_at: tuple[float, float, float]  # m
    size: tuple[int, int] = (640, 480)  # width and height, px


def coloured(world: World, fields: BlockFields, scene: SceneState) -> mujoco.MjModel:
    """Returns the world's model with the blocks of a scene, of these fields, in their colours."""
    model = with_blocks(world, fields)
    for mesh, scale in enumerate(fields.mesh_scale):  # rays search the boxes of its triangles
        first, boxes = model.mesh_bvhadr[mesh], model.mesh_bvhnum[mesh]
        model.bvh_aabb[first : first + boxes] *= scale
    model.geom_rgba[world.block_geoms, :3] = blocks.COLOURS[scene.colour[world.parts.slot]]
    if world.objects is not None:
        objects, number = world.objects, scene.numbers[world.objects.slots]
        model.geom_rgba[objects.geoms, :3] = blocks.COLOURS[scene.colour[objects.slots]][:, None]
        model.geom_rgba[objects.geoms, 3] = objects.tables.present[number]  # others are not drawn
    return model


def renderer(model: mujoco.MjModel, view: Viewpoint, opengl: str | None) -> Draw:
    """Draws by OpenGL, or by rays if that is None or fails. Recolours the model's planes."""
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
    model.vis.quality.shadowsize, model.vis.quality.offsamples = 2048, 8


def _ray_renderer(model: mujoco.MjModel, view: Viewpoint) -> Draw:
    """Draws by MuJoCo's rays, shaded as `vision.camera` shades, without shadows."""
    width, height = view.size
    focal = 0.5 * height / np.tan(np.radians(0.5 * FOVY))
    centre = 0.5 * (width - 1), 0.5 * (height - 1)
    eye = camera.make(CameraConfig(view.size, (focal, focal), centre, view.position, view.look_at))
    rays, place = np.asarray(camera.directions(eye), np.float64).ravel(), np.array(view.position)
    materials = np.concatenate([model.mat_rgba, np.zeros((1, 4), np.float32)])
    no_material = model.geom_matid[:, None] < 0  # -1: the last row
    rgba: Any = np.where(no_material, model.geom_rgba, materials[model.geom_matid])
    count = width * height
    geom, distance = np.zeros(count, np.int32), np.zeros(count)
    normal: Any = np.zeros((count, 3))

    def draw(data: mujoco.MjData) -> np.ndarray:
        lengths = distance, normal.reshape(-1), count, mujoco.mjMAXVAL
        mujoco.mj_multiRay(model, data, place, rays, None, True, -1, geom, *lengths)
        lit = camera.shade(rgba[geom, :3], normal.astype(np.float32))
        image = np.where(geom[:, None] >= 0, lit, SKY[:3])
        return np.round(255 * image).astype(np.uint8).reshape(height, width, 3)

    return draw
