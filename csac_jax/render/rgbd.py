"""A depth camera in MuJoCo's renderer: images that no code of ours has drawn.

It needs OpenGL: call `gl.choose` before MuJoCo is imported.
"""

import jax
import mujoco
import numpy as np

from csac_jax.config import CameraConfig
from csac_jax.render import picture
from csac_jax.scene import model
from csac_jax.scene.layout import Scene
from csac_jax.scene.model import World
from csac_jax.vision.camera import Camera

LAMP = np.array([-0.3, 0.5, -0.8])  # direction of the light; another than that of `camera.LIGHT`
_NEAR, _FAR = 0.05, 20.0  # m
_SHOWN, _HIDDEN = 0, 5  # geom groups


class Studio:
    """Draws the blocks of one episode on the table, with shadows; the robot is out of view.

    Close it: it holds an OpenGL context.
    """

    def __init__(self, world: World, scene: Scene, size: tuple[int, int]) -> None:
        scene = jax.device_get(scene)
        self._world = world
        own = self._model = picture.coloured(
            world, jax.device_get(model.scene_fields(world, scene)), scene
        )
        table = own.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        own.geom_group[:] = np.where(table | (world.slot_of_geom >= 0), _SHOWN, _HIDDEN)
        own.light_type[:], own.light_dir[:] = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, LAMP
        own.vis.headlight.ambient[:], own.vis.headlight.diffuse[:] = 0.4, 0.1
        own.vis.global_.offwidth, own.vis.global_.offheight = size
        own.vis.map.znear, own.vis.map.zfar = _NEAR / own.stat.extent, _FAR / own.stat.extent
        self._data, self._options = mujoco.MjData(own), mujoco.MjvOption()
        self._options.geomgroup[:] = np.arange(6) == _SHOWN
        self._renderer = mujoco.Renderer(own, size[1], size[0])

    def image(self, scene: Scene, eye: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Colour [h, w, 3] uint8 and depth [h, w] m, 0 where nothing is hit, of the episode's
        blocks where `scene` has them."""
        pose = np.concatenate([scene.position, scene.quaternion], axis=1)
        self._data.qpos[self._world.block_qpos] = pose
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, scene_option=self._options)
        for camera in self._renderer.scene.camera:
            _aim(camera, eye)
        colour = self._renderer.render().copy()
        self._renderer.enable_depth_rendering()
        depth = self._renderer.render()
        self._renderer.disable_depth_rendering()
        return colour, np.where(depth < 0.99 * _FAR, depth, 0.0).astype(np.float32)

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._renderer.close()


def _aim(camera: mujoco.MjvGLCamera, eye: Camera) -> None:
    """Gives OpenGL's camera the pose and the intrinsics of `eye`, whose pixel centres are whole
    numbers."""
    eye = jax.device_get(eye)
    camera.pos[:], camera.forward[:] = eye.position, eye.rotation[:, 2]
    camera.up[:] = -eye.rotation[:, 1]
    first = (-0.5 - eye.centre) / eye.focal * camera.frustum_near  # left and top, down
    last = (np.array([eye.width, eye.height]) - 0.5 - eye.centre) / eye.focal * camera.frustum_near
    camera.frustum_center = 0.5 * (first[0] + last[0])
    camera.frustum_width = 0.5 * (last[0] - first[0])
    camera.frustum_top, camera.frustum_bottom = -first[1], -last[1]


def intrinsics(cfg: CameraConfig) -> dict[str, float]:
    """Of a camera as `deploy.CameraPolicy.decide` takes them."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return dict(zip(names, (*cfg.size, *cfg.focal, *cfg.centre), strict=True))
