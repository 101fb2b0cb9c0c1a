"""The pinhole camera's geometry."""

import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.config import CameraConfig
from csac_jax.vision import camera
from tests.sections import scaled


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
    eye = camera.make(scaled(cfg, scale))
    depth = np.random.default_rng(0).uniform(0.2, 2.0, (eye.height, eye.width)).astype(np.float32)
    points = np.asarray(camera.points(eye, jnp.asarray(depth)), np.float64)
    local = (points - np.asarray(eye.position)) @ np.asarray(eye.rotation, np.float64)
    x, y, z = np.moveaxis(local, -1, 0)
    np.testing.assert_allclose(z, depth, atol=1e-6)
    row, col = np.mgrid[: eye.height, : eye.width]
    # A pixel covers [i - 1/2, i + 1/2): scaling moves pixel centres accordingly.
    np.testing.assert_allclose((x / z * 600.0 + 330.5) * scale - 0.5, col, atol=2e-3)
    np.testing.assert_allclose((y / z * 620.0 + 236.5) * scale - 0.5, row, atol=2e-3)
