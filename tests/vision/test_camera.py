"""The pinhole camera against MuJoCo's renderer, and its geometry."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax.config import CameraConfig
from csac_jax.vision import camera
from tests.vision import mujoco_rays, render_depth

_render = jax.jit(camera.render)


def _opengl_depth(folder: Path, model: mujoco.MjModel, data: mujoco.MjData, eye: Any) -> np.ndarray:
    """Depth [H, W] m by MuJoCo's renderer; skips where there is no OpenGL without a display."""
    mujoco.mj_saveModel(model, str(folder / "model.mjb"))
    pose = np.stack([eye.position, eye.rotation[:, 2], -eye.rotation[:, 1]])
    size = (eye.width, eye.height)
    np.savez(folder / "pose.npz", qpos=data.qpos, pose=pose, focal=eye.focal[1], size=size)
    files = [str(folder / name) for name in ("model.mjb", "pose.npz", "depth.npy")]
    for backend in ("egl", "osmesa"):
        environment = os.environ | {"MUJOCO_GL": backend}
        command = [sys.executable, render_depth.__file__, *files]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        if done.returncode == 0:
            return np.load(files[2])
    pytest.skip("no OpenGL by EGL or OSMesa: " + done.stderr.strip().splitlines()[-1])


@pytest.mark.parametrize(
    "make",
    [mujoco_rays.every_type, pytest.param(mujoco_rays.blocks_and_arm, marks=pytest.mark.slow)],
)
def test_depth_agrees_with_opengl(tmp_path, make):
    """Claim: depths are those of MuJoCo's renderer to 2 mm, two pixels off edges or more."""
    model, data = make(np.random.default_rng(5))
    eye = camera.make(CameraConfig(position=(-0.7, -0.3, 0.6), look_at=(0.1, 0.0, 0.1)).scaled(0.5))
    expected = _opengl_depth(tmp_path, model, data, eye)
    picture = jax.device_get(_render(eye, mujoco_rays.read(model, data)))
    depth = np.where(picture.valid, picture.depth, expected.max())  # the renderer's far plane
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(1.0 / depth, 2, mode="edge"), (5, 5))
    bend = np.abs(windows + windows[..., ::-1, ::-1] - 2.0 / depth[..., None, None]).max((2, 3))
    clear = bend < 0.01  # the inverse depth of a plane is linear in the image
    assert clear.mean() > 0.9
    assert len(np.unique(picture.geom[clear])) >= 6
    off = np.abs(depth - expected)[clear & picture.valid]
    assert off.max() < 2e-3
    assert np.median(off) < 1e-5


def test_the_default_is_the_papers_camera():
    """Claim: the paper's camera: 640 x 480 px, f = 618.62 px, at (-0.5, 0, 0.5) m, 45 deg."""
    eye = camera.make(CameraConfig())
    assert (eye.width, eye.height) == (640, 480)
    np.testing.assert_allclose(eye.focal, 618.62)
    np.testing.assert_allclose(eye.position, [-0.5, 0.0, 0.5])
    half = np.sqrt(0.5)
    axes = np.array([[0, -1, 0], [-half, 0, -half], [half, 0, -half]])
    np.testing.assert_allclose(eye.rotation, axes.T, atol=1e-7)
    middle = camera.directions(eye)[239:241, 319:321].mean((0, 1))
    np.testing.assert_allclose(middle / jnp.linalg.norm(middle), [half, 0.0, -half], atol=1e-6)


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_points_project_to_their_pixels(scale):
    """Claim: pixel -> point -> pixel is the identity, by the pinhole equation."""
    cfg = CameraConfig(focal=(600.0, 620.0), centre=(330.0, 236.0), position=(0.3, 0.4, 0.5))
    eye = camera.make(cfg.scaled(scale))
    depth = np.random.default_rng(0).uniform(0.2, 2.0, (eye.height, eye.width)).astype(np.float32)
    points = np.asarray(camera.points(eye, jnp.asarray(depth)), np.float64)
    local = (points - np.asarray(eye.position)) @ np.asarray(eye.rotation, np.float64)
    x, y, z = np.moveaxis(local, -1, 0)
    np.testing.assert_allclose(z, depth, atol=1e-6)
    row, col = np.mgrid[: eye.height, : eye.width]
    # A pixel covers [i - 1/2, i + 1/2): scaling moves pixel centres accordingly.
    np.testing.assert_allclose((x / z * 600.0 + 330.5) * scale - 0.5, col, atol=2e-3)
    np.testing.assert_allclose((y / z * 620.0 + 236.5) * scale - 0.5, row, atol=2e-3)


def test_colours_are_flat_shaded():
    """Claim: a pixel is its geom's colour times a brightness by the normal, or SKY."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="box" size="0.1 0.1 0.1" rgba="0.2 0.4 0.8 1"/>'
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    picture = _render(camera.make(CameraConfig().scaled(0.1)), mujoco_rays.read(model, data))
    colour, valid = np.asarray(picture.colour), np.asarray(picture.valid)
    assert colour.shape == (48, 64, 3)
    np.testing.assert_allclose(colour[~valid], np.broadcast_to(camera.SKY, colour[~valid].shape))
    np.testing.assert_array_equal(np.asarray(picture.depth)[~valid], 0.0)
    levels = np.unique((colour[valid] / [0.2, 0.4, 0.8]).round(3))
    # the side towards the camera faces away from the light, the top does not
    expected = [0.4, 0.4 + 0.6 * 0.8]
    np.testing.assert_allclose(levels, expected, atol=2e-3)


@pytest.mark.parametrize(
    ("share", "change", "message"),
    [
        (1.0, {"size": (320, 240)}, "camera.centre: .* give the camera.size"),
        (1.0, {"size": (640, 480), "centre": (159.5, 119.5)}, "camera.centre"),
        (1.0, {"focal": (80.0, 80.0)}, "camera.focal"),
        (1.0, {"focal": (618.0, 300.0)}, "camera.focal"),
        (1.0, {"size": (4, 4), "centre": (1.5, 1.5)}, "camera.size: must lie in 8"),
        (1.0, {"position": (0.0, 0.0, 0.7)}, "camera.position"),
        (0.3331, {}, "camera: .*whole"),
        (0.0, {}, "camera.size"),
    ],
)
def test_wrong_intrinsics_are_refused(share, change, message):
    """Claim: intrinsics of another image size, nonsense, and parts of pixels are refused."""
    with pytest.raises(ValueError, match=message) as error:
        dataclasses.replace(CameraConfig(), **change).scaled(share)
    assert "\n" not in str(error.value)
