"""Parked blocks and rotated scenes."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from csac_jax.vision.heightmap import VIEW_HEIGHT
from csac_jax.world import scene_state
from csac_jax.world.scene_state import SceneState

N = 5
PARKED = np.array([1, 3])


@pytest.fixture
def scene() -> SceneState:
    """Creates blocks 0, 2 and 4 in play at random poses, 1 and 3 parked."""
    rng = np.random.default_rng(0)
    turns = Rotation.random(N, rng=rng).as_quat(scalar_first=True)
    loose = scene_state.parked(("box",) * N).replace(
        position=jnp.asarray(rng.uniform(-0.2, 0.2, (N, 3)), jnp.float32),
        quaternion=jnp.asarray(turns, jnp.float32),
        velocity=jnp.asarray(rng.normal(size=(N, 6)), jnp.float32),
        in_play=jnp.ones(N, bool),
    )
    return scene_state.park(loose, jnp.ones(N, bool).at[PARKED].set(False))


def _rotations(scene: SceneState) -> Rotation:
    return Rotation.from_quat(np.asarray(scene.quaternion), scalar_first=True)


def test_park_touches_only_what_leaves(scene: SceneState):
    """Claim: park parks what is not kept, at rest, never brings a block back, and leaves the others
    as they are."""
    again = scene_state.park(scene, jnp.ones(N, bool).at[0].set(False))
    np.testing.assert_array_equal(again.in_play, [False, False, True, False, True])
    out = np.array([0, 1, 3])
    np.testing.assert_array_equal(again.position[out], scene_state.parking(N)[out])
    np.testing.assert_array_equal(again.quaternion[out], np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)))
    assert not np.any(again.velocity[out])
    _assert_same(again, scene, np.array([2, 4]))


def _assert_same(one: SceneState, two: SceneState, slots: np.ndarray) -> None:
    for leaf in ("position", "quaternion", "velocity", "in_play"):
        np.testing.assert_array_equal(getattr(one, leaf)[slots], getattr(two, leaf)[slots])


@pytest.mark.parametrize("yaw", [0.0, 0.7, 3.0, 6.0])
def test_rotate_is_a_rotation_about_z(scene: SceneState, yaw: float):
    """Claim: rotating keeps heights, rotates places and blocks alike, and leaves parked blocks."""
    rotated = scene_state.rotate(scene, jnp.float32(yaw))
    _assert_same(rotated, scene, PARKED)
    play = np.flatnonzero(scene.in_play)
    about_z = Rotation.from_rotvec([0.0, 0.0, yaw])
    before, after = np.asarray(scene.position)[play], np.asarray(rotated.position)[play]
    np.testing.assert_array_equal(after[:, 2], before[:, 2])
    np.testing.assert_allclose(after, about_z.apply(before), atol=1e-6)
    expected = (about_z * _rotations(scene)).as_matrix()
    np.testing.assert_allclose(_rotations(rotated).as_matrix()[play], expected[play], atol=1e-5)


def test_parking_is_out_of_reach_and_out_of_view():
    """Claim: parked blocks of any size are apart from one another, outside the square and wholly
    above the camera."""
    place, radius = scene_state.parking(10), np.linalg.norm([0.05, 0.025, 0.025])
    assert pdist(place).min() > 2 * radius
    assert place[:, 0].min() > 0.5
    assert place[:, 2].min() - radius > VIEW_HEIGHT
