"""Transitions for the replay, and the metrics of a step. E = scenes."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from csac_jax import env as environment
from csac_jax.agent.learner import Learner, Transition
from csac_jax.agent.rewards import ActionResult
from csac_jax.config import Config, RewardConfig
from csac_jax.constants import CHANGE_AREA, Outcome, Primitive
from csac_jax.robot.primitives import Action
from csac_jax.sim import physics as simulation
from csac_jax.vision import heightmap


class StepMetrics(NamedTuple):
    """Metrics of one training step; a chunk stacks them along a leading axis T."""

    primitive: jax.Array  # [E] int32, 0 push, 1 grasp
    outcome: jax.Array  # [E] int32, Outcome; only of grasps
    push_better: jax.Array  # [E] bool, the push made the best grasp worth more; False for grasps
    cleared: jax.Array  # [E] int32, blocks taken from the table
    blocks_lost: jax.Array  # [E] int32, blocks that left the workspace
    terminated: jax.Array  # [E] bool
    truncated: jax.Array  # [E] bool
    reward: jax.Array  # [E] float32
    gap_disagrees: jax.Array  # [E] bool, finger gap and ground truth name different outcomes
    contact_overflow: jax.Array  # [E] int32, substeps with every contact slot in use
    physics_diverged: jax.Array  # [E] bool, physics failed: transition dropped, scene replaced
    unreachable: jax.Array  # [E] bool, the robot cannot follow the action, so that nothing moved
    learned: jax.Array  # [] bool, False during the warm-up
    critic_loss: jax.Array  # [] float32
    actor_loss: jax.Array  # [] float32
    td_error: jax.Array  # [] float32, mean of abs(y - Q)
    q_mean: jax.Array  # [] float32
    finite: jax.Array  # [] bool, every number of the learner's state is finite


LOSSES = ("critic_loss", "actor_loss", "td_error", "q_mean")  # of updates


def remember(
    cfg: Config,
    learner: Learner,
    state: Any,
    before: environment.State,
    action: Action,
    after: environment.State,
    scenes_next: environment.State,
) -> tuple[Transition, jax.Array]:
    """Builds the transitions of actions, leaves [E, ...]; returns also which pushes were good, [E].

    Args: state, the learner's; scenes_next, the scenes acted in next.
    """
    paid = with_reward_outcome(cfg.reward, after)
    result = to_action_result(action, paid.info)
    reward, push_better = learner.reward(cfg.reward, state, before.obs, after.obs, result)
    next_obs, terminated = BOOTSTRAPS[cfg.target.bootstrap](paid, scenes_next)
    obs, next_packed = heightmap.pack(before.obs), heightmap.pack(next_obs)
    label = push_better if cfg.reward.relabels else None
    return Transition(obs, action, reward, next_packed, terminated, label), push_better


def _continuing(
    after: environment.State, scenes_next: environment.State
) -> tuple[heightmap.Observation, jax.Array]:
    """Returns the next scene after the last action of an episode, nothing after one without effect,
    as Zeng et al., code: `get_label_value`. Deviation: an episode cut off continues in its own."""
    effect = (after.info.moved > CHANGE_AREA) | (after.info.outcome == Outcome.LIFTED)
    return where(after.terminated, scenes_next.obs, after.obs), ~effect


BOOTSTRAPS: dict[str, Callable] = {
    "episodic": lambda after, _: (after.obs, after.terminated),
    "continuing": _continuing,
}
"""States after actions and those acted in next, leaves [E, ...] -> what a transition is followed
by, leaves [E, ...], and if V of it is 0, [E] bool."""


def where(condition: jax.Array, yes: Any, no: Any) -> Any:
    """Returns `yes` in the scenes where the condition [E] holds, else `no`; leaves [E, ...]."""
    return jax.vmap(environment.select)(condition, yes, no)


def with_reward_outcome(cfg: RewardConfig, after: environment.State) -> environment.State:
    """Returns states with the outcome that is paid for; logs keep the true one."""
    if cfg.outcome_source == "simulator":
        return after
    return after.replace(info=after.info.replace(outcome=after.info.outcome_by_gap))


def to_action_result(action: Action, info: environment.Info) -> ActionResult:
    """Returns what rewards are computed from, leaves [...]; the learner fills in phi."""
    phi, changed = jnp.zeros_like(info.distance), info.moved > CHANGE_AREA
    return ActionResult(
        action.primitive, info.outcome, info.distance, phi, phi, changed, info.blocks_lost
    )


def action_metrics(
    cfg: Config,
    before: environment.State,
    transition: Transition,
    push_better: jax.Array,
    after: environment.State,
) -> StepMetrics:
    """Returns the metrics of a step that learns nothing."""
    action, info = transition.action, after.info
    reachable = jax.vmap(functools.partial(simulation.reachable, cfg))
    return StepMetrics(
        primitive=action.primitive,
        outcome=info.outcome,
        push_better=push_better,
        cleared=info.cleared,
        blocks_lost=info.blocks_lost,
        terminated=after.terminated,
        truncated=after.truncated,
        reward=transition.reward,
        gap_disagrees=(action.primitive == Primitive.GRASP) & (info.outcome != info.outcome_by_gap),
        contact_overflow=info.contact_overflow,
        physics_diverged=info.physics_diverged,
        unreachable=~reachable(before.obs.height, action),
        learned=jnp.bool_(False),
        finite=jnp.bool_(True),
        **dict.fromkeys(LOSSES, jnp.float32(0.0)),
    )
