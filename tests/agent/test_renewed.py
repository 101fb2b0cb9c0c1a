"""Eq. 16's label of a replayed push is that of the target critic of now."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax.agent import actor_critic, critic, values
from csac_jax.agent.actor_critic import ActorCritic
from csac_jax.agent.learner import Transition
from csac_jax.constants import Primitive
from csac_jax.nets import dense
from csac_jax.robot.primitives import Action
from csac_jax.training import programs
from csac_jax.vision import heightmap

pytestmark = pytest.mark.optax
B = 6


class Height(nn.Module):
    """Q = weight x the highest surface of a cell, in block heights."""

    stride: int = 2

    @nn.compact
    def __call__(self, maps, train=False):
        """Q of all outputs alike, and no features worth the name."""
        del train
        weight = self.param("weight", nn.initializers.zeros, ())
        height = nn.max_pool(maps[..., 3:4], (2, 2), (2, 2))
        return weight * jnp.repeat(height, dense.OUTPUTS, axis=-1), height


@pytest.fixture(scope="module")
def renewing(cfg) -> ActorCritic:
    """A learner whose critic is `Height`, and that renews labels."""
    return actor_critic.make(cfg.change(reward={"push_label": "current_critic"}), Height())


def _begun(learner: ActorCritic) -> actor_critic.LearnerState:
    return jax.jit(lambda key: actor_critic.init(key, learner))(jax.random.key(0))


def _weighted(learner: ActorCritic, weight: jax.Array | float) -> actor_critic.LearnerState:
    """Its state with a target network of this weight."""
    state = _begun(learner)
    critic = jax.tree.map(lambda leaf: jnp.full_like(leaf, weight), state.target.critic)
    return state.replace(target=state.target.replace(critic=critic))


def _batch(observations, better: bool, reward: float) -> Transition:
    """Pushes and grasps in turn; each finds what was twice as high after it."""
    before = observations(B, 1)
    after = dataclasses.replace(before, height=2.0 * before.height)
    return Transition(
        obs=heightmap.pack(before),
        action=Action(jnp.arange(B, dtype=jnp.int32) % 2, jnp.zeros((B, 3))),
        reward=jnp.full(B, reward),
        next_obs=heightmap.pack(after),
        terminated=jnp.zeros(B, bool),
        push_better=jnp.full(B, better),
    )


@functools.partial(jax.jit, static_argnums=0)
def _renewed(learner: ActorCritic, weight: jax.Array, batch: Transition) -> jax.Array:
    target = _weighted(learner, weight).target
    next_maps = values.dense_maps(learner, target, heightmap.unpack(batch.next_obs))
    return critic.renewed_reward(learner, target, batch, next_maps)


def test_early_label_is_renewed(renewing, observations):
    """Claim: a push that was labelled worse by a critic that knew nothing earns Gamma = 0.5 once
    the critic values what it did, and loses as much once it does not; grasps keep their reward."""
    pushed = np.arange(B) % 2 == Primitive.PUSH
    for stored, reward in ((False, -0.5), (True, 0.5)):
        batch = _batch(observations, stored, reward)
        for weight, label in ((0.0, -0.5), (1.0, 0.5), (-1.0, -0.5)):
            wanted = np.where(pushed, label, reward)
            assert_allclose(_renewed(renewing, jnp.float32(weight), batch), wanted, atol=1e-6)


def test_stored_label_stays_as_an_option(cfg, observations):
    """Claim: by `push_label` stored the reward is the stored one, and no label is."""
    learner = actor_critic.make(cfg, Height())
    batch = _batch(observations, False, -0.5).replace(push_better=None)
    assert_array_equal(_renewed(learner, jnp.float32(1.0), batch), batch.reward)
    assert programs.example(learner.cfg).push_better is None
    renewing = cfg.change(reward={"push_label": "current_critic"})
    assert programs.example(renewing).push_better.dtype == bool


@pytest.mark.parametrize("num", [1, 5])
def test_best_grasps_are_those_of_all(learner, randomised, observations, num):
    """Claim: in parts of the batch phi_g is what it is all at once, and 0 where nobody asks."""
    state = randomised(_begun(learner))
    obs = observations(num, 3)
    all_maps = jax.jit(lambda: values.dense_maps(learner, state.target, obs))()
    phi = jax.vmap(values.best_grasp)(all_maps)
    best_grasps = jax.jit(lambda asked: values.best_grasps(learner, state.target, obs, asked))
    for seed in range(3):
        wanted = np.random.default_rng(seed).random(num) < 0.5
        expected = np.where(wanted, phi, 0.0)
        assert_allclose(best_grasps(jnp.asarray(wanted)), expected, rtol=1e-4, atol=1e-5)
