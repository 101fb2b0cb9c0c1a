"""DenseNet with batch norm in the learner: which statistics count when, and what gradients
touch."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax.agent import actor, actor_critic, critic, values
from csac_jax.agent.actor_critic import ActorCritic, LearnerState
from csac_jax.agent.learner import Transition
from csac_jax.config import DenseNet121
from csac_jax.sim.primitives import Action
from csac_jax.vision import heightmap
from tests.sections import with_constants

pytestmark = pytest.mark.optax
B = 4
NET = with_constants(
    DenseNet121(norm="batch", rotations=4, head=8, margin=0.0, zoom=2),
    block_layers=(1, 1, 1, 1),
    block_growth=4,
)


@pytest.fixture(scope="module")
def learner(cfg) -> ActorCritic:
    """Its steps are plain gradients; its target, the largest value, compiles fast."""
    quick = cfg.change(net=NET, target={"value": "max"})
    plain = dataclasses.replace(actor_critic.make(quick), critic_optimiser=optax.sgd(0.1))
    return dataclasses.replace(plain, actor_optimiser=optax.sgd(0.1))


@pytest.fixture(scope="module")
def state(learner) -> LearnerState:
    """Random networks and statistics, made without compiling anything."""
    rng = np.random.default_rng(0)

    def draw(path: Any, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        kind = getattr(path[-1], "key", "")
        if kind in ("scale", "var"):
            return jnp.asarray(rng.uniform(0.5, 1.5, leaf.shape), leaf.dtype)
        return jnp.asarray(rng.normal(scale=0.3, size=leaf.shape), leaf.dtype)

    with jax.numpy_dtype_promotion("standard"):
        abstract = jax.eval_shape(lambda: actor_critic.init(jax.random.key(0), learner))
    return jax.tree_util.tree_map_with_path(draw, abstract)


@pytest.fixture(scope="module")
def batch(observations) -> Transition:
    pose = np.random.default_rng(5).uniform(-0.2, 0.2, (B, 3))
    return Transition(
        obs=heightmap.pack(observations(B, 1)),
        action=Action(
            primitive=jnp.arange(B, dtype=jnp.int32) % 2, pose=jnp.asarray(pose, jnp.float32)
        ),
        reward=jnp.linspace(-1.0, 1.0, B),
        next_obs=heightmap.pack(observations(B, 2)),
        terminated=jnp.ones(B, bool),
    )


@pytest.fixture(scope="module")
def update(learner):
    """(state, batch) -> state, info of one update of the critic."""
    return jax.jit(
        lambda state, batch: critic.update(jax.random.key(3), learner, state, batch, jnp.ones(B))
    )


@pytest.fixture
def updated(state, batch, update):
    return update(state, batch)


def _differ(first: Any, other: Any) -> bool:
    return all(
        np.any(a != b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(other), strict=True)
    )


def _kernels(variables: Any) -> list[jax.Array]:
    return [
        leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(variables)
        if path[-1].key == "kernel"
    ]


def _same(first: Any, other: Any) -> None:
    jax.tree.map(assert_array_equal, first, other)


def test_acting_uses_running_statistics(learner, state, observations):
    """Claim: a state's maps do not depend on what else is looked at, but on the running statistics
    of both nets."""
    look = jax.jit(lambda params, obs: values.dense_maps(learner, params, obs))
    obs = observations(2, 4)
    others = jax.tree.map(lambda leaf: leaf.at[1].set(jnp.zeros((), leaf.dtype)), obs)
    both, one = look(state.online, obs), look(state.online, others)
    assert_allclose(both.q[0], one.q[0], atol=1e-5)
    assert_allclose(both.logits[0], one.logits[0], atol=1e-4)
    assert np.any(np.abs(both.q[1] - one.q[1]) > 1e-2)
    for net, maps in (("critic", "q"), ("actor", "logits")):
        variables = getattr(state.online, net)
        moved = {
            **variables,
            "batch_stats": jax.tree.map(lambda leaf: leaf + 0.3, variables["batch_stats"]),
        }
        after = look(state.online.replace(**{net: moved}), obs)
        assert np.abs(getattr(after, maps) - getattr(both, maps)).max() > 1e-2


@pytest.mark.slow
def test_learning_uses_the_batchs_statistics(state, batch, update, updated):
    """Claim: while learning, Q(s, a) of a transition depends on the batch, and not on the running
    statistics."""
    flat = jax.tree.map(lambda leaf: leaf.at[1:].set(jnp.zeros((), leaf.dtype)), batch.obs)
    assert (
        abs(float(update(state, batch.replace(obs=flat))[1].error[0] - updated[1].error[0])) > 1e-3
    )
    critic = state.online.critic
    moved = {**critic, "batch_stats": jax.tree.map(lambda leaf: leaf + 1.0, critic["batch_stats"])}
    other = update(state.replace(online=state.online.replace(critic=moved)), batch)
    assert_allclose(other[1].error, updated[1].error, atol=1e-6)


@pytest.mark.slow
def test_gradients_change_parameters_only(learner, state, batch, update, updated):
    """Claim: an update moves every kernel, and the running statistics to 0.9 of what they were and
    0.1 of the batch's, whatever the gradient; the optimisers know of no statistics."""
    before, after = state.online.critic, updated[0].online.critic
    assert _differ(_kernels(before), _kernels(after))
    shifted = jax.tree.map(lambda leaf: leaf + 1.0, before["batch_stats"])
    online = state.online.replace(critic={**before, "batch_stats": shifted})
    again = update(state.replace(online=online), batch.replace(reward=batch.reward + 1.0))[
        0
    ].online.critic
    jax.tree.map(
        lambda a, b: assert_allclose(a - b, 0.9, atol=1e-4),
        again["batch_stats"],
        after["batch_stats"],
    )
    assert _differ(before["batch_stats"], after["batch_stats"])
    assert _differ(again["params"]["head"]["conv1"], after["params"]["head"]["conv1"])
    adam = actor_critic.make(learner.cfg)
    with jax.numpy_dtype_promotion("standard"):
        fresh = jax.eval_shape(lambda: actor_critic.init(jax.random.key(0), adam))
    for variables, optimiser in (
        (fresh.online.critic, fresh.critic_optimiser),
        (fresh.online.actor, fresh.actor_optimiser),
    ):
        learned = sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))
        assert [leaf.size for leaf in jax.tree.leaves(optimiser) if leaf.ndim] == [
            learned,
            learned,
        ]  # Adam's moments


@pytest.mark.slow
def test_targets_follow_statistics_too(learner, state, updated):
    """Claim: target networks follow running statistics as they follow parameters."""
    tau = learner.cfg.learn.tau
    online, target = updated[0].online.critic, state.target.critic
    wanted = jax.tree.map(lambda new, old: tau * new + (1.0 - tau) * old, online, target)
    jax.tree.map(lambda a, b: assert_allclose(a, b, atol=1e-6), updated[0].target.critic, wanted)
    assert _differ(updated[0].target.critic["batch_stats"], target["batch_stats"])


@pytest.mark.slow
def test_the_actors_update_moves_its_own_statistics(learner, state, batch):
    """Claim: an update of the actor moves its parameters and statistics, and none of the
    critic's."""
    obs = heightmap.unpack(batch.obs)
    after, _ = jax.jit(lambda state: actor.update(learner, state, obs))(state)
    assert _differ(state.online.actor["batch_stats"], after.online.actor["batch_stats"])
    assert np.any(
        state.online.actor["params"]["conv1"]["kernel"]
        != after.online.actor["params"]["conv1"]["kernel"]
    )
    _same(state.online.critic, after.online.critic)
    _same(state.target, after.target)
