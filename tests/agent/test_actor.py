"""The actor's pose from dense logits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax.agent import actor, values
from csac_jax.agent.maps import DenseMaps
from csac_jax.constants import Primitive

GRASP = int(Primitive.GRASP)


@pytest.fixture(scope="module")
def pose(frames):
    """(logits, valid [K, h, w], all if not given) -> pose [3] of the grasp; pushes lead away."""

    @jax.jit
    def run(logits, valid):
        push = jnp.zeros_like(logits).at[0, 2, 2].set(99.0)
        q, both = jnp.zeros((2, *logits.shape)), jnp.stack([valid, valid])
        return actor.pose(frames, DenseMaps(q, jnp.stack([push, logits]), both), GRASP)

    return lambda logits, valid=None: run(
        jnp.asarray(logits), jnp.ones(logits.shape, bool) if valid is None else jnp.asarray(valid)
    )


@pytest.fixture
def logits(frames) -> np.ndarray:
    return np.zeros(frames.inside.shape, np.float32)


@pytest.fixture
def valid(frames) -> np.ndarray:
    return np.ones(frames.inside.shape, bool)


STEPS = [(0, 2), (2, 0), (2, 2), (1, 2), (0, -2)]


@pytest.mark.parametrize(
    ("peaks", "invalid", "best"),
    [
        ({(2, 4, 4): 20.0, (2, 13, 12): 19.9}, [], (2, 4, 4)),
        ({(2, 4, 4): 19.9, (2, 13, 12): 20.0}, [], (2, 13, 12)),
        # equally high, with a dip of one cell between them
        *(({(2, 8, 9): 20.0, (2, 8 + r, 9 + c): 19.9999}, [], (2, 8, 9)) for r, c in STEPS),
        # higher, but not valid
        ({(4, 10, 10): 20.0, (4, 10, 11): 40.0, (1, 3, 3): 50.0}, [(4, 10, 11), (1, 3, 3)],
         (4, 10, 10)),
        ({(6, 8, 9): 30.0}, [...], (6, 8, 9)),  # nothing is valid
    ],
)  # fmt: skip
def test_pose_is_at_the_highest_valid_peak(frames, pose, logits, valid, peaks, invalid, best):
    """Claim: the mean is at the highest valid cell, neither between two peaks nor drawn by a cell
    that is not valid; without a valid cell, at the highest."""
    for cell, value in peaks.items():
        logits[cell] = value
    for cell in invalid:
        valid[cell] = False
    got = pose(logits, valid)
    assert_allclose(got[:2], frames.xy[best], atol=0.01 * frames.cell)


def test_sharp_peaks_are_reproduced(frames, pose, logits):
    """Claim: a sharp peak in any cell of any yaw, at the edges too, gives that cell's pose."""
    end = frames.side - 1
    cells = np.random.default_rng(0).integers(logits.shape, size=(40, 3))
    cells[:4] = [[0, 0, 0], [3, 0, end], [7, end, 0], [1, end, end]]
    for cell in map(tuple, cells):
        logits[cell] = 25.0
        got = pose(logits)
        assert_allclose(got[:2], frames.xy[cell], atol=0.01 * frames.cell)
        assert_allclose(np.sin(0.5 * (got[2] - frames.yaws[cell[0]])), 0.0, atol=0.005)
        logits[cell] = 0.0


@pytest.mark.parametrize("axis", range(3))
def test_mean_moves_towards_a_growing_neighbour(frames, pose, axis):
    """Claim: as a neighbour's logit grows, the pose moves there as the gradient says."""
    best = (2, 8, 9)
    logits = 0.1 * np.random.default_rng(3).normal(size=frames.inside.shape).astype(np.float32)
    logits[best] = 2.0
    grown = np.zeros_like(logits)
    if axis == 2:  # the cells of the next yaw that lie over the best
        near = np.linalg.norm(frames.xy[3] - frames.xy[best], axis=-1) < 1.5 * frames.cell
        grown[3][near] = 1.0
    else:
        grown[(2, 8, 10) if axis == 0 else (2, 9, 9)] = 1.0
    before, rate = jax.jvp(pose, (jnp.asarray(logits),), (jnp.asarray(grown),))
    change = (pose(logits + 0.02 * grown) - before) / 0.02
    assert np.all(np.isfinite(rate))
    if axis == 2:
        assert rate[2] > 0.01
    else:  # column runs along the yaw, row across
        cos, sin = np.cos(frames.yaws[2]), np.sin(frames.yaws[2])
        assert rate[:2] @ np.array([[cos, sin], [-sin, cos]])[axis] > 0.01 * frames.cell
        assert_allclose(change[:2], rate[:2], rtol=0.05, atol=1e-4)
    assert_allclose(change[2], rate[2], rtol=0.1, atol=0.03)


def test_critic_gets_no_gradient_through_the_actor():
    """Claim: the critic's map enters the actor's logits, ten to one, without gradient."""
    q, correction = jnp.array([1.0, -2.0]), jnp.array([0.5, 0.0])
    assert_allclose(values.logits(q, correction), [10.5, -20.0])
    gradient = jax.grad(lambda q: jnp.sum(values.logits(q, correction)))(q)
    assert_array_equal(gradient, [0.0, 0.0])


@pytest.mark.parametrize("side", [1, -1])
def test_yaw_does_not_turn_to_what_is_not_valid(frames, pose, logits, valid, side):
    """Claim: the next yaw moves the mean's yaw by its valid cells only, however high others are."""
    best = (2, 8, 9)
    logits[best] = 1.0
    plain = pose(logits)
    near = np.linalg.norm(frames.xy[2 + side] - frames.xy[best], axis=-1) < 2.0 * frames.cell
    logits[2 + side][near] = 30.0
    assert abs(pose(logits)[2] - plain[2]) > 0.3  # valid, they would
    valid[2 + side][near] = False
    away = valid.copy()
    away[2 + side] = False
    got = pose(logits, valid)
    assert_allclose(got, pose(logits, away), atol=1e-5)
    assert (got[2] - frames.yaws[2]) * side < 0.0  # the only other yaw is on the other side
