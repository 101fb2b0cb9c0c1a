"""Pictures of a MuJoCo model: by MuJoCo's renderer with OpenGL, by our rays without."""

import dataclasses
from collections.abc import Callable

import jax
import mujoco
import numpy as np

from csac_jax.config import CameraConfig
from csac_jax.scene import solids
from csac_jax.vision import camera

FLOOR = (0.75, 0.76, 0.78, 1.0)
SKY = (1.0, 1.0, 1.0, 1.0)

Draw = Callable[[mujoco.MjData], np.ndarray]  # a state -> its picture [H, W, 3] uint8


@dataclasses.dataclass(frozen=True)
class View:
    """Where a picture is taken from."""

    position: tuple[float, float, float]  # m
    look_at: tuple[float, float, float]  # m
    size: tuple[int, int] = (640, 480)  # width and height, px
    fovy: float = 45.0  # vertical field of view, degrees


def renderer(model: mujoco.MjModel, view: View, opengl: str | None) -> Draw:
    """Draws this model with MuJoCo's OpenGL backend; with our rays if there is none or it fails.

    Recolours the model's planes.
    """
    model.geom_rgba[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE] = FLOOR
    if opengl is not None:
        try:
            return _opengl_renderer(model, view)
        except Exception:  # a broken driver raises nearly anything
            pass
    return _ray_renderer(model, view)


def _opengl_renderer(model: mujoco.MjModel, view: View) -> Draw:
    model.vis.global_.fovy = view.fovy
    model.vis.global_.offwidth, model.vis.global_.offheight = view.size
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.35, 0.3
    width, height = view.size
    opengl = mujoco.Renderer(model, height, width)
    opengl.scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 0  # the sky is seen from inside
    eye, offset = mujoco.MjvCamera(), np.array(view.look_at) - np.array(view.position)
    eye.lookat[:] = view.look_at
    eye.distance = np.linalg.norm(offset)
    eye.azimuth = np.degrees(np.arctan2(offset[1], offset[0]))
    eye.elevation = np.degrees(np.arcsin(offset[2] / eye.distance))
    options = mujoco.MjvOption()
    options.geomgroup[:] = 1

    def draw(data: mujoco.MjData) -> np.ndarray:
        opengl.update_scene(data, eye, options)
        _add_sky(opengl.scene)
        return opengl.render().copy()

    return draw


def _add_sky(scene: mujoco.MjvScene) -> None:
    """Puts a luminous sphere around the scene; MuJoCo's background is black."""
    sky = scene.geoms[scene.ngeom]
    sphere, radius = mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, 20.0)
    mujoco.mjv_initGeom(sky, sphere, radius, np.zeros(3), np.eye(3).ravel(), np.array(SKY))
    sky.emission, sky.specular = 1.0, 0.0
    scene.ngeom += 1


def _ray_renderer(model: mujoco.MjModel, view: View) -> Draw:
    width, height = view.size
    focal = 0.5 * height / np.tan(np.radians(0.5 * view.fovy))
    eye = camera.make(
        CameraConfig(
            size=view.size,
            focal=(focal, focal),
            centre=(0.5 * (width - 1), 0.5 * (height - 1)),
            position=view.position,
            look_at=view.look_at,
        )
    )
    geoms = solids.read(model)

    @jax.jit
    def render(xpos: jax.Array, xmat: jax.Array) -> camera.Picture:
        return camera.render(eye, solids.place(geoms, xpos, xmat))

    def draw(data: mujoco.MjData) -> np.ndarray:
        placed = data.geom_xpos.astype(np.float32), data.geom_xmat.astype(np.float32)
        picture = jax.device_get(render(*placed))
        colour = np.where(picture.valid[..., None], picture.colour, np.array(SKY[:3], np.float32))
        return np.round(255 * colour).astype(np.uint8)

    return draw
