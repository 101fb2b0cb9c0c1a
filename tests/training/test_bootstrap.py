"""Bootstrapping of the TD target, in the Markov decision process of a few blocks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import algorithms, presets
from csac_jax.agent import losses, rewards
from csac_jax.constants import CHANGE_AREA, Outcome, Primitive
from csac_jax.env import Info, State
from csac_jax.robot.primitives import Action
from csac_jax.training import programs, transitions
from csac_jax.vision.heightmap import Observation
from tests.agent import toys

P = 0.94  # of a grasp that lifts
FULL = 3  # blocks of a fresh scene
BLOCKS = jnp.repeat(jnp.arange(1, FULL + 1, dtype=jnp.int32), 3)  # before each transition
EVENT = jnp.tile(jnp.arange(3, dtype=jnp.int32), FULL)  # push, grasp that fails, grasp that lifts
PRIMITIVE = jnp.where(EVENT == 0, jnp.int32(Primitive.PUSH), jnp.int32(Primitive.GRASP))


def state(blocks: jax.Array, event: jax.Array) -> State:
    """States [T] of so many blocks, which the observation shows, after these events [T]."""
    zero, none = jnp.zeros(blocks.shape), jnp.zeros(blocks.shape, jnp.int32)
    lifted = event == 2
    outcome = jnp.where(lifted, jnp.int32(Outcome.LIFTED), jnp.int32(Outcome.TOUCHED))
    outcome = jnp.where(event == 0, jnp.int32(Outcome.NOTHING), outcome)
    moved = jnp.where(event == 1, 0.0, 2.0 * CHANGE_AREA)
    no = jnp.zeros(blocks.shape, bool)
    info = Info(outcome, outcome, moved, zero, lifted.astype(jnp.int32), none, none, no, no)
    shown = Observation(colour=zero, height=blocks.astype(jnp.float32), target=no)
    over = (blocks == 0) & lifted
    return State(None, shown, zero, over, no, none, none, none, info)


def values(algo: str) -> np.ndarray:
    """Computes Q [FULL, 2] of push and grasp with 1 .. FULL blocks left, by value iteration.

    A push changes the scene and lifts nothing; a grasp lifts with P, else it changes nothing.
    """
    cfg = algorithms.configure(presets.get("paper_small"), algo)
    after = state(BLOCKS - (EVENT == 2).astype(jnp.int32), EVENT)
    fresh = state(jnp.where(after.terminated, FULL, BLOCKS), EVENT)
    seen, terminated = transitions.BOOTSTRAPS[cfg.target.bootstrap](after, fresh)
    action = Action(PRIMITIVE, jnp.zeros((len(EVENT), 3)))
    result = transitions.to_action_result(action, after.info)
    reward = jax.vmap(rewards.reward, (None, 0))(cfg.reward, result)
    following = np.asarray(seen.height, int)
    weight = np.array([1.0, 1.0 - P, P])
    q = np.zeros((FULL + 1, 2))  # none left: worth nothing
    for _ in range(200):
        value = jnp.asarray(q.max(axis=1)[following], jnp.float32)
        y = np.asarray(losses.td_target(reward, cfg.target.gamma, terminated, value))
        expected = (y.reshape(FULL, 3) * weight).astype(float)
        q[1:] = np.stack([expected[:, 0], expected[:, 1:].sum(axis=1)], axis=1)
    return q[1:]


def test_vpgs_rule_grasps_the_last_block():
    """Claim: where the last grasp bootstraps from the fresh scene and a failed one from nothing,
    the optimal action is a grasp with any number of blocks: V = 0.94 (1 + 0.5 V)."""
    q = values("vpg")
    value = P / (1.0 - 0.5 * P)
    np.testing.assert_allclose(q[:, 1], value, atol=1e-5)
    np.testing.assert_allclose(q[:, 0], 0.5 + 0.5 * value, atol=1e-5)
    assert np.all(q[:, 1] > q[:, 0])


@pytest.mark.parametrize("bootstrap", list(transitions.BOOTSTRAPS))
def test_episode_that_is_cut_off_continues(bootstrap):
    """Claim: an action that had an effect bootstraps from its own scene where the episode is cut
    off."""
    after = state(jnp.array([2]), jnp.array([0])).replace(truncated=jnp.array([True]))
    fresh = state(jnp.array([FULL]), jnp.array([0]))
    seen, terminated = transitions.BOOTSTRAPS[bootstrap](after, fresh)
    assert seen.height.tolist() == [2.0]
    assert not terminated.any()


@pytest.mark.slow
@pytest.mark.optax
@pytest.mark.parametrize(("algo", "follows"), [("vpg", True), ("csac", False)])
def test_step_stores_what_is_acted_in_next(algo, follows):
    """Claim: by VPG's rule a stored action of an episode that ends is followed by the observation
    that the next action was taken in, by CSAC's rule by the last of its own."""
    cfg = toys.config(algo, actions=96, max_actions=4)
    program = programs.make(cfg, env=toys.bandit(cfg))
    state, metrics = programs.compile_chunk(program, cfg.train.steps)(programs.init(program))
    num = cfg.train.scenes
    rows = lambda leaf: np.asarray(leaf)[: cfg.train.actions].reshape(-1, num, *leaf.shape[1:])  # noqa: E731
    items = jax.tree.map(rows, state.replay.items)
    same = np.all(items.next_obs.colour[:-1] == items.obs.colour[1:], axis=(2, 3, 4))
    ended = np.asarray(metrics.terminated)[:-1]
    assert ended.sum() > 5
    assert np.all(same[ended] == follows)
    assert np.all(items.terminated[:-1][ended] != follows)
    idle = (np.asarray(metrics.reward)[:-1] == 0.0) & ~ended
    assert np.all(items.terminated[:-1][idle] == follows)
