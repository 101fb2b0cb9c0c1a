"""The actor's pose from dense logits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax.agent import actor
from csac_jax.agent.maps import DenseMaps
from csac_jax.constants import Primitive

GRASP = int(Primitive.GRASP)


@pytest.fixture(scope="module")
def pose(frames):
    """(logits [K, h, w], valid [K, h, w]) -> pose [3] of the grasp; the push's logits would lead
    elsewhere."""

    def of(logits, valid):
        push = jnp.zeros_like(logits).at[0, 2, 2].set(99.0)
        both = DenseMaps(
            jnp.zeros((2, *logits.shape)), jnp.stack([push, logits]), jnp.stack([valid, valid])
        )
        return actor.pose(frames, both, GRASP)

    return jax.jit(of)


def _flat(frames) -> np.ndarray:
    return np.zeros((frames.yaws.size, frames.side, frames.side), np.float32)


def _everywhere(frames) -> jax.Array:
    return jnp.ones((frames.yaws.size, frames.side, frames.side), bool)


def test_two_peaks(frames, pose):
    """Claim: of two peaks the mean is at the higher one, not between them."""
    logits = _flat(frames)
    high, low = (2, 4, 4), (2, 13, 12)
    logits[high], logits[low] = 20.0, 19.9
    for peaks in ((high, low), (low, high)):
        logits[peaks[0]], logits[peaks[1]] = 20.0, 19.9
        got = pose(jnp.asarray(logits), _everywhere(frames))
        assert_allclose(got[:2], frames.xy[peaks[0]], atol=0.01 * frames.cell)
        assert_allclose(got[2], frames.yaws[peaks[0][0]], atol=0.01)


@pytest.mark.parametrize("step", [(0, 2), (2, 0), (2, 2), (1, 2), (0, -2)])
def test_two_peaks_side_by_side(frames, pose, step):
    """Claim: nor is it between two peaks with a dip of one cell between them, were they equally
    high."""
    logits = _flat(frames)
    logits[2, 8, 9] = 20.0
    logits[2, 8 + step[0], 9 + step[1]] = 20.0 - 1e-4
    got = pose(jnp.asarray(logits), _everywhere(frames))
    assert_allclose(got[:2], frames.xy[2, 8, 9], atol=0.01 * frames.cell)


def test_sharp_peaks_are_reproduced(frames, pose):
    """Claim: a sharp peak in any cell of any yaw, at the edges too, gives that cell's pose within a
    part of a cell."""
    rng = np.random.default_rng(0)
    cells = rng.integers([frames.yaws.size, frames.side, frames.side], size=(40, 3))
    cells[:4] = [
        [0, 0, 0],
        [3, 0, frames.side - 1],
        [7, frames.side - 1, 0],
        [1, frames.side - 1, frames.side - 1],
    ]
    for k, row, col in cells:
        logits = _flat(frames)
        logits[k, row, col] = 25.0
        got = np.asarray(pose(jnp.asarray(logits), _everywhere(frames)))
        assert_allclose(got[:2], frames.xy[k, row, col], atol=0.01 * frames.cell)
        assert_allclose((got[2] - frames.yaws[k] + np.pi) % (2 * np.pi) - np.pi, 0.0, atol=0.01)


def test_invalid_cells_do_not_attract(frames, pose):
    """Claim: the mean is at the highest valid cell, and no invalid cell next to it draws its
    place."""
    logits, valid = _flat(frames), np.ones((frames.yaws.size, frames.side, frames.side), bool)
    logits[1, 3, 3], valid[1, 3, 3] = 50.0, False
    logits[4, 10, 10] = 20.0
    logits[4, 10, 11], valid[4, 10, 11] = 40.0, False
    got = pose(jnp.asarray(logits), jnp.asarray(valid))
    assert_allclose(got[:2], frames.xy[4, 10, 10], atol=0.01 * frames.cell)


def test_pose_is_finite_where_nothing_is_valid(frames, pose):
    """Claim: without a valid cell the pose is that of the highest one."""
    logits = _flat(frames)
    logits[6, 8, 9] = 30.0
    got = pose(jnp.asarray(logits), ~_everywhere(frames))
    assert_allclose(got[:2], frames.xy[6, 8, 9], atol=0.01 * frames.cell)


@pytest.mark.parametrize(
    ("neighbour", "axis"), [((2, 8, 10), 0), ((2, 9, 9), 1), ((3, None, None), 2)]
)
def test_mean_moves_towards_a_growing_neighbour(frames, pose, neighbour, axis):
    """Claim: the pose is differentiable: as a neighbour's logit grows, it moves there by what the
    gradient says."""
    best = (2, 8, 9)
    rng = np.random.default_rng(3)
    logits = 0.1 * rng.normal(size=_flat(frames).shape).astype(np.float32)
    logits[best] = 2.0
    k, row, _ = neighbour
    if row is None:  # the cells of the next yaw that lie over the best
        near = np.linalg.norm(frames.xy[k] - frames.xy[best], axis=-1) < 1.5 * frames.cell
        grown = np.zeros_like(logits)
        grown[k][near] = 1.0
    else:
        grown = np.zeros_like(logits)
        grown[neighbour] = 1.0
    before, rate = jax.jvp(
        lambda grid: pose(grid, _everywhere(frames)), (jnp.asarray(logits),), (jnp.asarray(grown),)
    )
    after = pose(jnp.asarray(logits + 0.02 * grown), _everywhere(frames))
    assert np.all(np.isfinite(rate))
    if axis == 2:
        assert rate[2] > 0.01
    else:  # column runs along the yaw, row across
        yaw = frames.yaws[2]
        towards = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])[axis]
        assert rate[:2] @ towards > 0.01 * frames.cell
        assert_allclose((after - before)[:2] / 0.02, rate[:2], rtol=0.05, atol=1e-4)
    assert_allclose((after - before)[2] / 0.02, rate[2], rtol=0.1, atol=0.03)


def test_critic_gets_no_gradient_through_the_actor():
    """Claim: the critic's map enters the actor's logits, ten to one, without gradient."""
    q, correction = jnp.array([1.0, -2.0]), jnp.array([0.5, 0.0])
    assert_allclose(actor.logits(q, correction), [10.5, -20.0])
    assert_array_equal(jax.grad(lambda q: jnp.sum(actor.logits(q, correction)))(q), [0.0, 0.0])


@pytest.mark.parametrize("side", [1, -1])
def test_yaw_does_not_turn_to_what_is_not_valid(frames, pose, side):
    """Claim: the next yaw draws the mean's yaw by its valid cells only, however high the others
    are."""
    best = (2, 8, 9)
    logits, valid = _flat(frames), np.ones((frames.yaws.size, frames.side, frames.side), bool)
    logits[best] = 1.0
    plain = pose(jnp.asarray(logits), jnp.asarray(valid))
    near = np.linalg.norm(frames.xy[2 + side] - frames.xy[best], axis=-1) < 2.0 * frames.cell
    logits[2 + side][near] = 30.0
    assert (
        abs(pose(jnp.asarray(logits), jnp.asarray(valid))[2] - plain[2]) > 0.3
    )  # valid, it would draw
    valid[2 + side][near] = False
    got = pose(jnp.asarray(logits), jnp.asarray(valid))
    away = valid.copy()
    away[2 + side] = False
    assert_allclose(got, pose(jnp.asarray(logits), jnp.asarray(away)), atol=1e-5)
    assert (got[2] - frames.yaws[2]) * side < 0.0  # the only other yaw is on the other side


def test_neighbours_do_not_leak_into_the_yaw(frames, pose):
    """Claim: an invalid cell next to the one read in the neighbouring yaw does not count, however
    high it is."""
    best = (2, 8, 10)  # in the next frame its place is 0.2 of a cell from the nearest centre
    logits, valid = _flat(frames), np.ones((frames.yaws.size, frames.side, frames.side), bool)
    logits[best] = 1.0
    where = np.unravel_index(
        np.argsort(np.linalg.norm(frames.xy[3] - frames.xy[best], axis=-1), axis=None), (18, 18)
    )
    second = 3, where[0][1], where[1][1]  # the second nearest cell: it has a share in what is read
    before = pose(jnp.asarray(logits), jnp.asarray(valid))
    valid[second] = False
    logits[second] = 19.0
    assert_allclose(pose(jnp.asarray(logits), jnp.asarray(valid)), before, atol=1e-3)
