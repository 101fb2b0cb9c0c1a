"""RGBD images by MuJoCo's renderer. Call `gl.choose` before MuJoCo is imported."""

import jax
import mujoco
import numpy as np

from csac_jax.config import CameraConfig
from csac_jax.render import picture
from csac_jax.vision.camera import Camera
from csac_jax.world.model import World, scene_fields
from csac_jax.world.scene_state import SceneState

SUN = np.array([-0.3, 0.5, -0.8])  # direction of the light, unlike `camera.LIGHT`
_NEAR, _FAR = 0.05, 20.0  # m
_SHOWN, _HIDDEN = 0, 5  # geom groups


class RgbdRenderer:
    """RGBD images of an episode's blocks by OpenGL, without the robot. Close it after use."""

    def __init__(self, world: World, scene: SceneState, size: tuple[int, int]) -> None:
        scene = jax.device_get(scene)
        self._world = world
        fields = jax.device_get(scene_fields(world, scene))
        model = self._model = picture.coloured(world, fields, scene)
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
    """Returns the intrinsics of a camera as `deploy.CameraPolicy.decide` takes them."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return dict(zip(names, (*cfg.size, *cfg.focal, *cfg.centre), strict=True))
