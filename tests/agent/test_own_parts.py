"""Parts of one's own, with no more than their interfaces ask for, in the compiled training step."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax.agent.learner import Learner, UpdateInfo
from csac_jax.constants import Primitive
from csac_jax.nets import dense
from csac_jax.replay.samplers import Sample, Sampler
from csac_jax.robot.primitives import Action
from csac_jax.training import programs, step, transitions
from tests.agent import toys

pytestmark = pytest.mark.optax

STEPS = 10  # of 8 scenes; the first update is in step 8
CFG = toys.config("csac", actions=8 * STEPS, max_actions=1)


class Newest(Sampler):
    """The newest transition, over and over."""

    def sample(self, key, state, progress, num):
        del key, progress
        newest = (state.head - 1) % state.priority.shape[0]
        return Sample(jnp.full(num, newest), jnp.full(num, 0.5))


class Mean(Learner):
    """Grasps in the middle; its only parameter goes half of the way to the mean reward."""

    def init(self, key):
        del key
        return jnp.zeros(())

    def act(self, key, state, obs, steps_without_change, actions_taken=None):
        del key, state, obs, actions_taken
        scenes = steps_without_change.shape[0]
        return Action(jnp.full(scenes, int(Primitive.GRASP)), jnp.zeros((scenes, 3)))

    def update(self, key, state, batch, weights):
        del key
        error = batch.reward - state
        loss = jnp.mean(weights * error**2)
        return state + jnp.mean(weights * error), UpdateInfo(loss, state, error)


class Tiny(nn.Module):
    """One convolution."""

    stride: int = 4

    @nn.compact
    def __call__(self, maps, train=False):
        del train
        features = nn.relu(nn.Conv(4, (4, 4), strides=self.stride)(maps))
        return nn.Dense(dense.OUTPUTS)(features), features


def _trained(**parts) -> tuple[Any, step.TrainState, transitions.StepMetrics]:
    """The learner's first state in a run with these parts, the run's last one, and its metrics."""
    program = programs.make(CFG, env=toys.Toy(CFG, (toys.GOOD, toys.DUD) * 5), **parts)
    first = programs.init(program)
    learner = jax.tree.map(jnp.copy, first.learner)
    return learner, *programs.compile_chunk(program, STEPS)(first)


def test_learner_and_sampler_of_ones_own():
    """Claim: a learner with `init`, `act` and `update` and a sampler with `sample` are what runs:
    what is drawn is learned from with the sampler's weights, by the number of updates asked for,
    after the warm-up alone, and errors come back as priorities."""
    _, last, metrics = _trained(learner=Mean(), sampler=Newest())
    assert np.all(metrics.primitive == Primitive.GRASP)
    assert_array_equal(metrics.learned, np.arange(1, STEPS + 1) * 8 >= 64)
    value, error = 0.0, 0.0
    newest = np.asarray(metrics.reward)[np.asarray(metrics.learned), -1]
    assert np.unique(newest).size > 1
    for reward in newest:
        for _ in range(CFG.learn.updates_per_step):
            error = reward - value
            value += 0.5 * error
    assert_allclose(last.learner, value, rtol=1e-5)
    slot = (last.replay.head - 1) % last.replay.priority.shape[0]
    assert_allclose(last.replay.priority[slot], abs(error), rtol=1e-5)
    assert_array_equal(metrics.actor_loss, 0.0)


def test_network_of_ones_own():
    """Claim: a Flax module with a `stride` is the critic: its maps are cells of that size, its
    parameters are learned after the warm-up, and so are those of the actor's head on its
    features."""
    first, last, metrics = _trained(network=Tiny())
    kernel = first.online.critic["params"]["Conv_0"]["kernel"]
    assert kernel.shape == (1, 4, 4, 4, 4)  # critics, rows, columns, maps in and out
    assert np.all(np.isfinite(metrics.critic_loss))
    moved = jax.tree.map(lambda a, b: bool(jnp.any(a != b)), first.online, last.learner.online)
    assert all(jax.tree.leaves(moved))
    assert int(last.learner.updates) == CFG.learn.updates_per_step * int(np.sum(metrics.learned))
