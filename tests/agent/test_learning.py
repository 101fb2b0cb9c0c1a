"""Every algorithm learns what it can on problems of known best policy, through the real training
step."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from csac_jax.agent import actor_critic, maps, policy, values
from csac_jax.agent.actor_critic import ActorCritic, Params
from csac_jax.constants import Primitive
from csac_jax.env import State
from csac_jax.training import programs
from tests.agent import toys
from tests.agent.toys import Toy

pytestmark = pytest.mark.optax

EPISODES = 128
CAP = 4  # actions of an episode of the two-step problem


class Learned(NamedTuple):
    """Results of a learned policy in fresh episodes, without exploration."""

    success: float  # share of episodes that end with the good block lifted
    actions: float  # mean per episode
    pushes: list[float]  # share of pushes among the first, second, ... actions
    value: float  # mean over first states of the best Q over the primitives that the policy takes


def learn(
    problem: Callable[..., Toy], algo: str, actions: int, cap: int, push: float | None = None
) -> Learned:
    """Trains an algorithm on a problem and plays EPISODES fresh episodes."""
    cfg = toys.config(algo, actions, cap, push)
    toy = problem(cfg)
    program = programs.make(cfg, env=toy)
    state, metrics = programs.compile_chunk(program, cfg.train.steps)(programs.init(program))
    assert np.all(np.isfinite(metrics.critic_loss))
    begun, ended, primitives = jax.jit(functools.partial(_play, toy, actor_critic.make(cfg)))(
        jax.random.key(99), state.learner.online
    )
    # An output of a primitive never taken is never trained.
    chosen = np.array(maps.allowed_primitives(cfg.policy))
    value = jnp.max(jnp.where(begun.valid, begun.q, -jnp.inf)[:, chosen], axis=(1, 2, 3, 4))
    return Learned(
        success=float(np.mean(ended.terminated)),
        actions=float(np.mean(ended.actions)),
        pushes=np.mean(np.asarray(primitives) == Primitive.PUSH, axis=1).tolist(),
        value=float(np.mean(value)),
    )


def _play(toy: Toy, learner: ActorCritic, key: jax.Array, params: Params):
    """Dense maps of the first states, last states and primitives [T, E]."""

    def act(state: State, i: jax.Array) -> tuple[State, jax.Array]:
        keys = jax.vmap(jax.random.fold_in, (None, 0))(
            jax.random.fold_in(key, i), jnp.arange(EPISODES)
        )
        dense_maps = values.dense_maps(learner, params, state.obs)
        best = jax.vmap(policy.best_action, (0, None, 0, 0))
        action = best(keys, learner, dense_maps, state.steps_without_change)
        after = jax.vmap(toy.step)(state, action)
        return jax.tree.map(
            lambda old, new: jax.vmap(jnp.where)(state.done, old, new), state, after
        ), action.primitive

    first = jax.vmap(lambda i: toy.reset(jax.random.fold_in(key, i)))(1000 + jnp.arange(EPISODES))
    last, primitives = jax.lax.scan(act, first, jnp.arange(toy.cfg.task.max_actions))
    return values.dense_maps(learner, params, first.obs), last, primitives


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "value"),
    [("csac", 2.0), ("csac_per", 2.0), ("csac_beta", 2.0), ("vpg", 2.0), ("reactive", 1.0),
     ("grasp_only", 1.0)],
)  # fmt: skip
def test_bandit_is_solved(algo, value):
    """Claim: every algorithm finds the one good block among duds, and what lifting it earns: 2 by
    CSAC, 1 / (1 - 0.5) by VPG, whose next episode follows, 1 by the other baselines."""
    learned = learn(toys.bandit, algo, actions=640, cap=1)
    assert learned.success >= 0.98
    assert learned.pushes[0] <= 0.02
    assert_allclose(learned.value, value, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "low", "high"),
    [("csac", 1.2, 1.6), ("csac_per", 1.2, 1.6), ("csac_beta", 1.2, 1.6), ("vpg", 1.25, 1.4)],
)  # fmt: skip
def test_two_steps_are_learned(algo, low, high):
    """Claim: a push that makes the only grasp possible is learned, then that grasp, in two actions.

    The push is worth r + gamma V': CSAC 0.5 + 0.5 softmax, at most 1.5, as the softmax is at most
    2; VPG 0.5 + 0.5 (1 + 0.5 V), which is V = 4 / 3.
    """
    learned = learn(toys.two_step, algo, actions=1600, cap=CAP)
    assert learned.success >= 0.98
    assert learned.actions <= 2.1
    assert learned.pushes[0] >= 0.98
    assert low <= learned.value <= high


@pytest.mark.slow
def test_grasping_alone_fails():
    """Claim: where only a push makes a grasp possible, grasp_only lifts and expects nothing."""
    learned = learn(toys.two_step, "grasp_only", actions=800, cap=CAP)
    assert learned.success == 0.0
    assert learned.pushes == [0.0] * CAP
    assert_allclose(learned.value, 0.0, atol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "push", "value", "solves"),
    [("reactive", None, 0.5, True), ("reactive", -0.2, 0.0, False), ("vpg", -0.2, 0.533, True)],
)  # fmt: skip
def test_without_a_future_a_push_must_pay_by_itself(algo, push, value, solves):
    """Claim: with gamma = 0 the push is made if it earns 0.5 at once, and not if it costs 0.1; a
    gamma of 0.5 pays for it: V = -0.1 + 0.5 (1 + 0.5 V)."""
    learned = learn(toys.two_step, algo, actions=1200, cap=CAP, push=push)
    assert learned.success >= 0.98 if solves else learned.success == 0.0
    assert_allclose(learned.value, value, atol=0.1)
