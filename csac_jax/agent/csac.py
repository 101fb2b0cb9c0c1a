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
from csac_jax.config import Config, RewardConfig
from csac_jax.constants import Primitive
from csac_jax.nets import chunked_vmap
from csac_jax.robot.primitives import Action
from csac_jax.vision.heightmap import Observation


@dataclasses.dataclass(frozen=True, eq=False)
class CSAC(Learner):
    """The learner of the algorithms in `algorithms`, by the config of `parts`."""

    parts: ActorCritic
    batching: chunked_vmap.Batching = chunked_vmap.ALONE

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
        """Chooses by CEM on the critic's maps from the actor's mean, plus noise (lines 8-13)."""
        keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(steps_without_change)))
        look = functools.partial(values.decision_maps, explores=actions_taken is not None)
        inputs = keys, self.parts, self._chunked(look)(state.online, obs), steps_without_change
        if actions_taken is None:
            return jax.vmap(policy.best_action, (0, None, 0, 0))(*inputs)
        return jax.vmap(policy.act, (0, None, 0, 0, None))(*inputs, actions_taken)

    def reward(
        self,
        cfg: RewardConfig,
        state: LearnerState,
        obs: Observation,
        next_obs: Observation,
        result: rewards.ActionResult,
    ) -> tuple[jax.Array, jax.Array]:
        """Computes eqs. 10-16, phi by the target critic."""
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

    def update_actor(self, state: LearnerState, obs: Observation) -> tuple[LearnerState, jax.Array]:
        """Updates the actor on `obs` [B, ...] once a step (lines 22-23); also returns its loss."""
        return self._chunked(actor.update)(state, obs)

    def replace_hyperparams(self, cfg: Config, return_bounds: tuple[Any, Any]) -> "CSAC":
        """Returns the learner of a config whose hyper-parameters may be traced."""
        parts = actor_critic.with_optimisers(cfg, self.parts.frames, return_bounds)
        return dataclasses.replace(self, parts=parts)

    def batched(self, batching: chunked_vmap.Batching) -> "CSAC":
        """Returns the learner for runs that are vmapped."""
        parts, frames = self.parts, self.parts.frames
        if batching.side_by_side:
            frames = dataclasses.replace(frames, networks=frames.networks.side_by_side())
            parts = dataclasses.replace(parts, frames=frames)
        return dataclasses.replace(self, parts=parts, batching=batching)

    def _chunked(self, part: Callable[..., Any], at_once: int | None = None) -> Callable[..., Any]:
        """Binds `parts` to a function, which is vmapped in chunks if `batching` says so."""
        bound = functools.partial(part, self.parts)
        if self.batching.networks_at_once is None:
            return bound
        return chunked_vmap.vmap_in_chunks(bound, at_once or self.batching.networks_at_once)
