"""Quaternions against SciPy, angles, and cells in metres."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from csac_jax import geometry
from csac_jax.config import HeightmapConfig


def _unit_quats(seed: int, count: int) -> np.ndarray:
    quats = np.random.default_rng(seed).normal(size=(count, 4))
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def test_quaternions_agree_with_scipy():
    """Claim: matrices and products of (w, x, y, z) quaternions are those of SciPy."""
    left, right = _unit_quats(0, 50), _unit_quats(1, 50)
    first, second = (Rotation.from_quat(q[:, [1, 2, 3, 0]]) for q in (left, right))
    matrix = jax.vmap(geometry.quat_to_matrix)(jnp.asarray(left))
    np.testing.assert_allclose(matrix, first.as_matrix(), atol=1e-6)
    product = jax.vmap(geometry.quat_multiply)(jnp.asarray(left), jnp.asarray(right))
    matrix = jax.vmap(geometry.quat_to_matrix)(product)
    np.testing.assert_allclose(matrix, (first * second).as_matrix(), atol=1e-6)


def test_yaw_turns_counter_clockwise():
    """Claim: a yaw turns counter-clockwise from above, quaternions and points alike."""
    for yaw in np.linspace(-7.0, 7.0, 15).astype(np.float32):
        reference = Rotation.from_euler("z", yaw).as_matrix()
        matrix = geometry.quat_to_matrix(geometry.quat_from_yaw(jnp.asarray(yaw)))
        np.testing.assert_allclose(matrix, reference, atol=1e-6)
        xy = np.array([[[0.2, -0.1], [0.0, 0.3]]], np.float32)
        turned = geometry.rotate2d(jnp.asarray(yaw), jnp.asarray(xy))
        np.testing.assert_allclose(turned, xy @ reference[:2, :2].T, atol=1e-6)


@settings(max_examples=200, deadline=None)
@given(st.one_of(st.floats(-100.0, 100.0, width=32), st.floats(-(2.0**-20), 2.0**-20, width=32)))
def test_wrapped_angle_is_in_range(angle):
    """Claim: `wrap_angle` gives the same direction in [0, 2 pi), for tiny negative angles too."""
    wrapped = np.asarray(geometry.wrap_angle(jnp.asarray(angle, jnp.float32)))
    assert 0.0 <= wrapped < np.float32(2.0 * np.pi)
    difference = (np.float64(wrapped) - angle + np.pi) % (2.0 * np.pi) - np.pi
    assert abs(difference) < 2e-5  # float32 holds an angle of 100 rad to 4e-6


def test_cells_lie_where_the_convention_says():
    """Claim: x = (col + 0.5) cell - extent / 2, y by rows, from the lowest."""
    cfg = HeightmapConfig(224)
    centres = np.asarray(geometry.cell_centres(cfg))
    assert centres.shape == (224, 224, 2)
    assert centres.dtype == np.float32
    expected = (np.arange(224) + 0.5) * 0.002 - 0.224
    np.testing.assert_allclose(centres[5, :, 0], expected, atol=1e-7)
    np.testing.assert_allclose(centres[:, 9, 1], expected, atol=1e-7)
