"""CSAC and its baselines as a learner: dense maps, search, rewards, updates of critic and actor."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from csac_jax.agent import actor, actor_critic, critic, policy, rewards, values
from csac_jax.agent.actor_critic import ActorCritic, LearnerState
from csac_jax.agent.learner import Learner, Transition, UpdateInfo
from csac_jax.agent.rewards import ActionResult
from csac_jax.config import Config, RewardConfig
from csac_jax.constants import Primitive
from csac_jax.nets import chunked_vmap
from csac_jax.sim.primitives import Action
from csac_jax.vision.heightmap import Observation


@dataclasses.dataclass(frozen=True, eq=False)
class CSAC(Learner):
    """The algorithms of `algorithms`, by the config of `parts`."""

    parts: ActorCritic
    networks_at_once: int | None = None  # of runs that are vmapped, see `chunked_vmap`; None: all

    def init(self, key: jax.Array) -> LearnerState:
        return actor_critic.init(key, self.parts)

    def act(
        self,
        key: jax.Array,
        state: LearnerState,
        obs: Observation,
        steps_without_change: jax.Array,
        actions_taken: jax.Array | None = None,
    ) -> Action:
        """By default CEM on the critic's maps from the actor's mean, plus noise (lines 8-13)."""
        keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(steps_without_change)))
        if actions_taken is None:
            maps = self._chunked(values.decision_maps)(state.online, obs)
            best = jax.vmap(policy.best_action, (0, None, 0, 0))
            return best(keys, self.parts, maps, steps_without_change)
        maps = self._chunked(values.exploration_maps)(state.online, obs)
        act = jax.vmap(policy.act, (0, None, 0, 0, None))
        return act(keys, self.parts, maps, steps_without_change, actions_taken)

    def reward(
        self,
        cfg: RewardConfig,
        state: LearnerState,
        obs: Observation,
        next_obs: Observation,
        result: ActionResult,
    ) -> tuple[jax.Array, jax.Array]:
        """Eqs. 10-16, phi by the target critic."""
        pushed = result.primitive == Primitive.PUSH
        views = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), obs, next_obs)  # [2 E, ...]
        # In chunks of one run, each part of the states is still skipped that has no push.
        best_grasps = self._chunked(values.best_grasps, at_once=1)
        before, after = jnp.split(best_grasps(state.target, views, jnp.tile(pushed, 2)), 2)
        return rewards.rewards_of(cfg, result._replace(phi_before=before, phi_after=after))

    def update(
        self, key: jax.Array, state: LearnerState, batch: Transition, weights: jax.Array
    ) -> tuple[LearnerState, UpdateInfo]:
        update = self._chunked(lambda parts, key, *args: critic.update(key, parts, *args))
        return update(key, state, batch, weights)

    def end_step(self, state: LearnerState, obs: Observation) -> tuple[LearnerState, jax.Array]:
        """The actor's update (lines 22-23)."""
        return self._chunked(actor.update)(state, obs)

    def replace_hyperparams(self, cfg: Config, return_bounds: tuple[Any, Any]) -> "CSAC":
        parts = actor_critic.with_optimisers(cfg, self.parts.frames, return_bounds)
        return dataclasses.replace(self, parts=parts)

    def in_chunks(self, networks_at_once: int | None) -> "CSAC":
        return dataclasses.replace(self, networks_at_once=networks_at_once)

    def side_by_side(self) -> "CSAC":
        frames = self.parts.frames
        frames = dataclasses.replace(frames, networks=frames.networks.side_by_side())
        return dataclasses.replace(self, parts=dataclasses.replace(self.parts, frames=frames))

    def _chunked(self, part: Callable[..., Any], at_once: int | None = None) -> Callable[..., Any]:
        """A function of `parts` and others as one of the others, vmapped in chunks."""
        bound = functools.partial(part, self.parts)
        if self.networks_at_once is None:
            return bound
        return chunked_vmap.vmap_in_chunks(bound, at_once or self.networks_at_once)
