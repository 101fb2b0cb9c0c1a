"""DenseNet with batch norm in the learner: which statistics count when, and what gradients
touch."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose

from csac_jax.agent import actor_critic, critic, values
from csac_jax.agent.actor_critic import ActorCritic, LearnerState
from csac_jax.agent.learner import Transition
from csac_jax.config import DenseNet121
from csac_jax.robot.primitives import Action
from csac_jax.vision import heightmap
from tests.sections import with_constants

pytestmark = pytest.mark.optax
B = 4
NET = with_constants(
    DenseNet121(norm="batch", rotations=4, head=8),
    pad_fraction=0.0,
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


def _same(first: Any, other: Any) -> bool:
    return all(jax.tree.leaves(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), first, other)))


def _moved(variables: Any, by: float) -> Any:
    """Variables with other running statistics."""
    statistics = jax.tree.map(lambda leaf: leaf + by, variables["batch_stats"])
    return {**variables, "batch_stats": statistics}


def test_acting_uses_running_statistics(learner, state, observations):
    """Claim: a state's maps depend on the running statistics, not on the other states."""
    look = jax.jit(lambda params, obs: values.dense_maps(learner, params, obs))
    obs = observations(2, 4)
    others = jax.tree.map(lambda leaf: leaf.at[1].set(jnp.zeros((), leaf.dtype)), obs)
    both, one = look(state.online, obs), look(state.online, others)
    assert_allclose(both.q[0], one.q[0], atol=1e-5)
    assert_allclose(both.logits[0], one.logits[0], atol=1e-4)
    assert np.any(np.abs(both.q[1] - one.q[1]) > 1e-2)
    for net, maps in (("critic", "q"), ("actor", "logits")):
        moved = _moved(getattr(state.online, net), 0.3)
        after = look(state.online.replace(**{net: moved}), obs)
        assert np.abs(getattr(after, maps) - getattr(both, maps)).max() > 1e-2


@pytest.mark.slow
def test_learning_uses_the_batchs_statistics(state, batch, update, updated):
    """Claim: while learning, Q(s, a) depends on the batch, not on running statistics."""
    flat = jax.tree.map(lambda leaf: leaf.at[1:].set(jnp.zeros((), leaf.dtype)), batch.obs)
    alone = update(state, batch.replace(obs=flat))[1]
    assert abs(float(alone.error[0] - updated[1].error[0])) > 1e-3
    online = state.online.replace(critic=_moved(state.online.critic, 1.0))
    other = update(state.replace(online=online), batch)
    assert_allclose(other[1].error, updated[1].error, atol=1e-6)


@pytest.mark.slow
def test_gradients_change_parameters_only(learner, state, batch, update, updated):
    """Claim: an update moves every kernel, and the running statistics to 0.9 of what they were and
    0.1 of the batch's, whatever the gradient; the optimisers know of no statistics."""
    before, after = state.online.critic, updated[0].online.critic
    for path, leaf in jax.tree_util.tree_leaves_with_path(before["params"]):
        changed = after["params"]
        for key in path:
            changed = changed[key.key]
        assert path[-1].key != "kernel" or np.any(leaf != changed), path
    online, higher = state.online.replace(critic=_moved(before, 1.0)), batch.reward + 1.0
    again, _ = update(state.replace(online=online), batch.replace(reward=higher))
    again = again.online.critic
    close = lambda a, b: assert_allclose(a - b, 0.9, atol=1e-4)  # noqa: E731
    jax.tree.map(close, again["batch_stats"], after["batch_stats"])
    assert not _same(before["batch_stats"], after["batch_stats"])
    assert not _same(again["params"]["head"]["conv1"], after["params"]["head"]["conv1"])
    adam = actor_critic.make(learner.cfg)
    with jax.numpy_dtype_promotion("standard"):
        fresh = jax.eval_shape(lambda: actor_critic.init(jax.random.key(0), adam))
    for net in ("critic", "actor"):
        params = jax.tree.leaves(getattr(fresh.online, net)["params"])
        moments = jax.tree.leaves(getattr(fresh, f"{net}_optimiser"))  # Adam's, two vectors
        num = sum(leaf.size for leaf in params)
        assert [leaf.size for leaf in moments if leaf.ndim] == [num, num]
