"""Convex parts against trimesh, closed forms and brute force."""

import itertools

import numpy as np
import pytest
import scipy.linalg
import trimesh
from scipy.spatial.transform import Rotation

from csac_jax.objects import solid

CUBE = np.array([*itertools.product((0.0, 1.0), repeat=3)])


def _points(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(scale=[0.02, 0.03, 0.05], size=(20, 3)) + 0.1


@pytest.mark.parametrize("seed", range(5))
def test_volume_and_inertia_are_trimeshs(seed: int):
    """Claim: volume, centre of mass and inertia of a hull are those of trimesh."""
    part = solid.convex(_points(seed))
    whole, mesh = solid.moments(part), trimesh.Trimesh(part.vertices, part.triangles)
    assert mesh.is_watertight
    assert whole.volume == pytest.approx(mesh.volume, rel=1e-6)
    np.testing.assert_allclose(whole.first / whole.volume, mesh.center_mass, rtol=1e-6)
    np.testing.assert_allclose(solid.inertia(whole), mesh.moment_inertia, rtol=1e-5, atol=1e-14)


def test_principal_axes_are_scipys():
    """Claim: principal moments are those of SciPy; the axes are right-handed and turn the moments
    into the matrix, also of a ball, a cylinder and what is aligned with its axes but for rounding.
    """
    turns = Rotation.random(40, rng=0).as_matrix()
    sides = np.random.default_rng(0).uniform(0.1, 1.0, (40, 3))
    sides[:10, 1] = sides[:10, 0]
    sides[5:10] = 1.0
    turns[10:15] = np.eye(3)
    inertia = np.einsum("nij,nj,nkj->nik", turns, sides, turns)
    inertia[15:20] = np.diag([1.0, 2.0, 3.0]) + 1e-17
    moments, axes = solid.principal(inertia)
    wanted = [scipy.linalg.eigvalsh(matrix) for matrix in inertia]
    np.testing.assert_allclose(np.sort(moments), wanted, rtol=1e-12)
    again = np.einsum("nij,nj,nkj->nik", axes, moments, axes)
    np.testing.assert_allclose(again, inertia, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, rtol=1e-12)


def test_planes_hold_the_corners_and_no_more():
    """Claim: a point lies inside all planes of a hull just where trimesh has it inside."""
    part = solid.convex(_points(0))
    points = np.random.default_rng(1).uniform(0.0, 0.2, (4000, 3))
    inside = (points @ part.planes[:, :3].T <= part.planes[:, 3]).all(axis=1)
    mesh = trimesh.Trimesh(part.vertices, part.triangles)
    np.testing.assert_array_equal(inside, trimesh.proximity.signed_distance(mesh, points) > 0)
    assert 50 < inside.sum() < 3000
