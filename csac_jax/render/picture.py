"""Pictures of a MuJoCo model: by MuJoCo's renderer with OpenGL, by our rays without.

Call `gl.choose` before MuJoCo is imported.
"""

import contextlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from csac_jax.config import CameraConfig
from csac_jax.vision import camera
from csac_jax.vision.camera import Camera
from csac_jax.world import blocks, geoms, solids
from csac_jax.world.model import BlockFields, World, scene_fields, with_blocks
from csac_jax.world.scene_state import SceneState

FLOOR = (0.85, 0.86, 0.88, 1.0)
SKY = np.ones(4, np.float32)
FOVY = 45.0  # vertical field of view, degrees
LAMP = np.array([-0.7, -0.5, 2.2])  # place of the light, m: shadows fall away from the viewer

SUN = np.array([-0.3, 0.5, -0.8])  # direction of the light of RGBD images, unlike `camera.LIGHT`
_NEAR, _FAR = 0.05, 20.0  # m
_SHOWN, _HIDDEN = 0, 5  # geom groups

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
    eye, offset = mujoco.MjvCamera(), np.array(view.look_at) - np.array(view.position)
    eye.lookat[:] = view.look_at
    eye.distance = np.linalg.norm(offset)
    eye.azimuth = np.degrees(np.arctan2(offset[1], offset[0]))
    eye.elevation = np.degrees(np.arcsin(offset[2] / eye.distance))
    options, sphere = mujoco.MjvOption(), mujoco.mjtGeom.mjGEOM_SPHERE
    options.geomgroup[:] = 1

    def draw(data: mujoco.MjData) -> np.ndarray:
        opengl.update_scene(data, eye, options)
        sky = opengl.scene.geoms[opengl.scene.ngeom]  # a luminous sphere: the background is black
        mujoco.mjv_initGeom(sky, sphere, np.full(3, 20.0), np.zeros(3), np.eye(3).ravel(), SKY)
        sky.emission, sky.specular = 1.0, 0.0
        opengl.scene.ngeom += 1
        return opengl.render().copy()

    return draw


def _light(model: mujoco.MjModel) -> None:
    """Sets one bright lamp over the whole table, its shadows fine near the workspace."""
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
    scene = geoms.read(model)
    render = jax.jit(lambda *placed: camera.render(eye, solids.place(scene, *placed)))

    def draw(data: mujoco.MjData) -> np.ndarray:
        placed = data.geom_xpos.astype(np.float32), data.geom_xmat.astype(np.float32)
        picture = jax.device_get(render(*placed))
        colour = np.where(picture.valid[..., None], picture.colour, SKY[:3])
        return np.round(255 * colour).astype(np.uint8)

    return draw


class RgbdRenderer:
    """RGBD images of an episode's blocks by OpenGL, without the robot. Close it after use."""

    def __init__(self, world: World, scene: SceneState, size: tuple[int, int]) -> None:
        scene = jax.device_get(scene)
        self._world = world
        fields = jax.device_get(scene_fields(world, scene))
        model = self._model = coloured(world, fields, scene)
        table = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        model.geom_group[:] = np.where(table | (world.slot_of_geom >= 0), _SHOWN, _HIDDEN)
        model.light_type[:], model.light_dir[:] = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, SUN
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.1
        model.vis.global_.offwidth, model.vis.global_.offheight = size
        model.vis.map.znear = _NEAR / model.stat.extent
        model.vis.map.zfar = _FAR / model.stat.extent
        self._data, self._options = mujoco.MjData(model), mujoco.MjvOption()
        self._options.geomgroup[:] = np.arange(6) == _SHOWN
        self._renderer = mujoco.Renderer(model, size[1], size[0])

    def image(self, scene: SceneState, eye: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Draws blocks as in `scene`: colour [h, w, 3] uint8, depth [h, w] m, 0 without a hit."""
        pose = np.concatenate([scene.position, scene.quaternion], axis=1)
        self._data.qpos[self._world.block_qpos] = pose
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, scene_option=self._options)
        for gl_camera in self._renderer.scene.camera:
            _aim(gl_camera, eye)
        colour = self._renderer.render().copy()
        self._renderer.enable_depth_rendering()
        depth = self._renderer.render()
        self._renderer.disable_depth_rendering()
        return colour, np.where(depth < 0.99 * _FAR, depth, 0.0).astype(np.float32)

    def close(self) -> None:
        """Releases the OpenGL context."""
        self._renderer.close()


def _aim(gl_camera: mujoco.MjvGLCamera, eye: Camera) -> None:
    """Gives OpenGL's camera the pose and the intrinsics of `eye`."""
    eye = jax.device_get(eye)
    gl_camera.pos[:], gl_camera.forward[:] = eye.position, eye.rotation[:, 2]
    gl_camera.up[:] = -eye.rotation[:, 1]
    size, near = np.array([eye.width, eye.height]), gl_camera.frustum_near
    first = (-0.5 - eye.centre) / eye.focal * near  # left and top, down; pixel centres are whole
    last = (size - 0.5 - eye.centre) / eye.focal * near
    gl_camera.frustum_center = 0.5 * (first[0] + last[0])
    gl_camera.frustum_width = 0.5 * (last[0] - first[0])
    gl_camera.frustum_top, gl_camera.frustum_bottom = -first[1], -last[1]


def intrinsics(cfg: CameraConfig) -> dict[str, float]:
    """Returns the intrinsics of a camera as `deploy.Policy.decide` takes them."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return dict(zip(names, (*cfg.size, *cfg.focal, *cfg.centre), strict=True))
