"""Values that networks give to a batch of states: dense maps of Q, and phi, the best grasp's value.

Two critics count as one whose value in each cell is the lower of both.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from csac_jax.agent import maps
from csac_jax.agent.actor_critic import ActorCritic, Params
from csac_jax.agent.maps import DenseMaps
from csac_jax.constants import Primitive
from csac_jax.nets import networks
from csac_jax.vision.heightmap import Observation

SHARPNESS = 10.0  # logit per unit of Q: how the critic's own map enters the actor's
_QUARTERS = 4  # parts of a batch that phi is computed for one after the other (ours)


def dense_maps(learner: ActorCritic, params: Params, obs: Observation) -> DenseMaps:
    """Computes dense maps of states: `obs` leaves [B, ...], result leaves [B, P, K, h, w]."""
    return _with_actor(learner, params, obs, *critic_maps(learner, params.critic, obs))


def exploration_maps(learner: ActorCritic, params: Params, obs: Observation) -> DenseMaps:
    """Computes the maps that an exploring policy acts on: `dense_maps` + `policy.height_bonus`."""
    return _with_height_bonus(learner, obs, dense_maps(learner, params, obs))


def decision_maps(learner: ActorCritic, params: Params, obs: Observation) -> DenseMaps:
    """Computes the maps that a policy acts on when it does not explore.

    These are `exploration_maps`; with `policy.augment` Q is the mean over mirror images and
    critics.
    """
    if not learner.cfg.policy.augment:
        return exploration_maps(learner, params, obs)
    q, features = _apply_to_passes(learner, params.critic, obs, networks.apply_mirrored)
    state = _with_actor(learner, params, obs, jnp.mean(q, axis=0), features)
    return _with_height_bonus(learner, obs, state)


def _with_height_bonus(learner: ActorCritic, obs: Observation, state: DenseMaps) -> DenseMaps:
    if learner.cfg.policy.height_bonus == 0.0:
        return state
    heights = jax.vmap(maps.cell_heights, (None, 0))(learner.frames, obs.height)
    return state.replace(q=state.q + learner.cfg.policy.height_bonus * heights[:, None])


def _with_actor(
    learner: ActorCritic, params: Params, obs: Observation, q: jax.Array, features: jax.Array
) -> DenseMaps:
    correction: Any = jnp.zeros_like(q)
    if learner.cfg.learn.actor:
        correction = learner.frames.networks.head.apply(params.actor, features)
    return unfold_maps(learner, obs, q, correction)


def critic_maps(learner: ActorCritic, critic: Any, obs: Observation) -> tuple[jax.Array, Any]:
    """Computes the lower Q of both critics [B, K / 2, h, w, OUTPUTS] in the frames of the passes.

    Also returns the first critic's features [B, K / 2, ., ., F].
    """
    q, features = _apply_to_passes(learner, critic, obs, networks.apply)
    return jnp.min(q, axis=0), features


def _apply_to_passes(
    learner: ActorCritic, critic: Any, obs: Observation, apply: Callable[..., Any]
) -> tuple[jax.Array, Any]:
    """Applies each critic to the K / 2 passes: Q [M, B, K / 2, h, w, OUTPUTS], first features."""
    rotated = jax.vmap(maps.rotated_inputs, (None, 0))(learner.frames, obs)
    q, features = map_critics(
        lambda variables: apply(learner.frames.networks, variables, rotated), critic
    )
    return q, features[0]


def map_critics(call: Callable[[Any], Any], variables: Any) -> Any:
    """Calls `call` with the variables of each critic, leaves [M, ...] in and out.

    One after another: the grouped convolutions of a vmap take longer than both by themselves.
    """
    num = jax.tree.leaves(variables)[0].shape[0]
    results = [call(jax.tree.map(lambda leaf, m=m: leaf[m], variables)) for m in range(num)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *results)


def logits(q: jax.Array, correction: jax.Array) -> jax.Array:
    """Returns the actor's logits: the critic's map, without gradient, plus the head's output.

    The policy gradient only moves a mode; the critic's map says where modes are.
    """
    return jax.lax.stop_gradient(q) * SHARPNESS + correction


def unfold_maps(
    learner: ActorCritic, obs: Observation, q: jax.Array, correction: jax.Array
) -> DenseMaps:
    """Builds the maps of all yaws from Q and the actor's output in the frames of the passes."""
    unfold = jax.vmap(maps.unfold)
    valid = jax.vmap(maps.actionable_cells, (None, 0))(learner.frames, obs)
    return DenseMaps(unfold(q), unfold(logits(q, correction)), valid)


def best_grasp(state: DenseMaps) -> jax.Array:
    """Returns phi_g(s) of eq. 16, []: the largest valid grasp value; 0 without a valid cell."""
    valid = state.valid[Primitive.GRASP]
    best = jnp.max(jnp.where(valid, state.q[Primitive.GRASP], -jnp.inf))
    return jnp.where(jnp.any(valid), best, 0.0)


def best_grasps(
    learner: ActorCritic, params: Params, obs: Observation, wanted: jax.Array
) -> jax.Array:
    """Computes phi_g [B] of the `wanted` [B] bool observations, leaves [B, ...]; else 0.

    Wanted ones are moved to the front. Then quarters of the batch pass through the networks, and a
    quarter without a wanted one costs nothing. Under vmap all do as many as the largest count asks.
    """
    num = wanted.shape[0]
    size = -(-num // _QUARTERS)
    # Not by a sort: one whose keys nobody reads ends the process on several devices without Shardy.
    places = jnp.nonzero(wanted, size=num + -num % size, fill_value=num)[0]
    rows = places.astype(jnp.int32).reshape(-1, size)

    def unfinished(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        return carry[0] * size < jnp.sum(wanted)

    def quarter(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        done, values = carry
        part = jax.tree.map(lambda leaf: leaf.at[rows[done]].get(mode="clip"), obs)
        phi = jax.vmap(best_grasp)(dense_maps(learner, params, part))
        return done + 1, values.at[rows[done]].set(phi, mode="drop")

    _, values = jax.lax.while_loop(unfinished, quarter, (jnp.int32(0), jnp.zeros(num)))
    return jnp.where(wanted, values, 0.0)
