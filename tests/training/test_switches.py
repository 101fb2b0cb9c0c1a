"""The paper's switches: sensed rewards, actions anywhere, its camera and arm."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import algorithms, presets
from csac_jax.agent import rewards
from csac_jax.config import Config
from csac_jax.constants import Outcome, Primitive
from csac_jax.env import Env, Info, State
from csac_jax.robot.primitives import Action
from csac_jax.sim import physics as simulation
from csac_jax.training import programs, step, transitions
from csac_jax.vision.heightmap import Observation
from csac_jax.world import model, scene_state

LEVELS = jnp.arange(len(Outcome), dtype=jnp.int32)
TRUE, SENSED = (leaf.reshape(-1) for leaf in jnp.meshgrid(LEVELS, LEVELS))  # [25], every pair


def _after(outcome: jax.Array, by_gap: jax.Array) -> State:
    """States [T] after grasps that ended so, of a map that did not change."""
    zero, none = jnp.zeros(outcome.shape), jnp.zeros(outcome.shape, jnp.int32)
    no = jnp.zeros(outcome.shape, bool)
    info = Info(outcome, by_gap, zero, zero, none, none, none, no, no)
    return State(None, Observation(zero, zero, no), zero, no, no, none, none, none, info)


def _paid(cfg: Config, after: State) -> tuple[np.ndarray, np.ndarray]:
    """Returns rewards [T] of grasps, and True where nothing follows them, [T] bool."""
    paid = transitions.with_reward_outcome(cfg.reward, after)
    action = Action(jnp.full(TRUE.shape, Primitive.GRASP, jnp.int32), jnp.zeros((len(TRUE), 3)))
    reward, _ = rewards.rewards_of(cfg.reward, transitions.to_action_result(action, paid.info))
    _, terminated = transitions.BOOTSTRAPS[cfg.target.bootstrap](paid, paid)
    return np.asarray(reward), np.asarray(terminated)


@pytest.mark.parametrize("algo", ["csac", "vpg"])
def test_rewards_follow_their_source(algo: str):
    """Claim: with `reward.outcome_source sensors` a grasp is paid for, and bootstraps, as one whose
    true outcome is the sensed one; by default what is sensed counts for nothing."""
    truth = algorithms.configure(presets.smoke(), algo)
    sensed = truth.change(reward={"outcome_source": "sensors"})
    for cfg, outcome in ((truth, TRUE), (sensed, SENSED)):
        found, wanted = _paid(cfg, _after(TRUE, SENSED)), _paid(truth, _after(outcome, outcome))
        np.testing.assert_array_equal(found, wanted)
    assert np.any(_paid(sensed, _after(TRUE, SENSED))[0] != _paid(truth, _after(TRUE, SENSED))[0])


@pytest.mark.slow
@pytest.mark.mjx
def test_switches_combine():
    """Claim: sensed rewards and actions anywhere can be trained with the oblique camera, its noise
    and the arm: the whole step can be traced, and gives back a state of the same types."""
    cfg = presets.smoke().change(
        task={"kind": "target"},
        sim={"physics": "c", "robot": "ur5"},
        heightmap={"view": "oblique"},
        sensor={"depth_noise": (0.001, 0.0014), "dropped": 0.02, "pose_noise": (0.001, 0.002)},
        policy={"action_mask": "none"},
        reward={"outcome_source": "sensors"},
    )
    blank = jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene_state.parked(cfg.scene.slots))
    physics = simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    program = programs.make(cfg, Env(cfg, physics, blank))
    state = jax.eval_shape(lambda: programs.init_state(program, jax.random.key(0)))
    after, _ = jax.eval_shape(lambda state: step.train_step(program, state), state)
    kinds = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree) for tree in (state, after)]
    assert kinds[0] == kinds[1]
