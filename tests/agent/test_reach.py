"""Actions that an arm cannot follow are refused before they are made, and counted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from csac_jax import presets
from csac_jax.agent import maps, policy
from csac_jax.constants import Primitive
from csac_jax.nets import networks
from csac_jax.sim import physics
from csac_jax.vision.heightmap import Observation

FAR = presets.smoke().change(sim={"robot": "ur5", "base": (0.85, 0.0, 0.35, 0.0)})


@pytest.fixture(scope="module")
def frames() -> maps.Frames:
    return maps.frames(FAR, networks.make(FAR.net))


@pytest.mark.slow
def test_cells_out_of_reach_are_masked(frames: maps.Frames):
    """Claim: with an arm that stands too far away, cells are valid where the arm can follow a
    grasp or push over a bare table, and random grasps are among them."""
    size = FAR.heightmap.size
    bare = jnp.full((size, size), 0.02)
    obs = Observation(jnp.zeros((size, size, 3)), bare, jnp.ones((size, size), bool))
    valid = np.asarray(maps.actionable_cells(frames, obs))
    assert 0.1 < valid[Primitive.GRASP].mean() < 0.9
    key = jax.random.key(0)
    for number in range(8):
        action = policy.random_grasp(jax.random.fold_in(key, number), frames, valid)
        assert physics.reachable(FAR, bare, action)


def test_all_cells_leave_out_what_is_out_of_reach(frames: maps.Frames):
    """Claim: so it is where actions may begin anywhere; the floating hand reaches all."""
    anywhere = FAR.change(policy={"action_mask": "none"})
    free = maps.frames(anywhere, networks.make(anywhere.net))
    empty = jnp.zeros((FAR.heightmap.size,) * 2)
    obs = Observation(jnp.zeros((*empty.shape, 3)), empty, empty > 0)
    valid = np.asarray(maps.actionable_cells(free, obs))
    assert_array_equal(valid, free.inside[None] & frames.reachable)
    hand = maps.frames(presets.smoke(), networks.make(FAR.net))
    assert hand.reachable.all()
