"""Values that networks give to a batch of states: dense maps of Q, and phi, the best grasp's."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from csac_jax.agent import maps
from csac_jax.agent.actor_critic import ActorCritic, Params
from csac_jax.constants import Primitive
from csac_jax.nets import networks
from csac_jax.vision.heightmap import Observation

SHARPNESS = 10.0  # logit per unit of Q: how the critic's own map enters the actor's
MOST_CELLS = 2**27  # of the maps that the networks see at once (ours): 0.5 GiB a channel
_QUARTERS = 4  # parts of a batch that phi is computed for one after the other (ours)


def dense_maps(
    learner: ActorCritic, params: Params, obs: Observation, mirrored: bool = False
) -> maps.DenseMaps:
    """Computes dense maps [B, P, K, h, w] of states, leaves [B, ...]; see `critic_maps`."""
    q, features = critic_maps(learner, params.critic, obs, mirrored)
    correction: Any = jnp.zeros_like(q)
    if learner.cfg.learn.actor:
        correction = learner.frames.networks.head.apply(params.actor, features)
    return unfold_maps(learner, obs, q, correction)


def decision_maps(
    learner: ActorCritic, params: Params, obs: Observation, explores: bool = False
) -> maps.DenseMaps:
    """Computes `dense_maps` with `policy.height_bonus`, and `policy.augment` unless it explores."""
    cfg = learner.cfg.policy
    state = dense_maps(learner, params, obs, cfg.augment and not explores)
    if cfg.height_bonus == 0.0:
        return state
    heights = jax.vmap(maps.cell_heights, (None, 0))(learner.frames, obs.height)
    return state.replace(q=state.q + cfg.height_bonus * heights[:, None])


def critic_maps(
    learner: ActorCritic, critic: Any, obs: Observation, mirrored: bool = False
) -> tuple[jax.Array, Any]:
    """Computes the lower Q of both critics [B, K / 2, h, w, OUTPUTS] in the frames of the passes.

    With `mirrored` it is the mean over mirror images and critics. Also returns the first critic's
    features [B, K / 2, ., ., F]. Large batches are computed in parts of at most MOST_CELLS.
    """
    apply, join = (networks.apply_mirrored, jnp.mean) if mirrored else (networks.apply, jnp.min)
    frames = learner.frames

    def look(obs: Observation) -> tuple[jax.Array, Any]:
        rotated = jax.vmap(maps.rotated_inputs, (None, 0))(frames, obs)
        q, features = map_critics(lambda own: apply(frames.networks, own, rotated), critic)
        return join(q, axis=0), features[0]

    num, cells = len(obs.height), frames.yaws.size // 2 * frames.tables.canvas**2
    fits = (n for n in range(1, num) if num % n == 0 and num // n * cells <= MOST_CELLS)
    parts = next(fits, num)
    if parts == 1:
        return look(obs)
    # Each part has states of all devices, which divide the first axis.
    split = jax.tree.map(lambda leaf: leaf.reshape(-1, parts, *leaf.shape[1:]).swapaxes(0, 1), obs)
    found = jax.lax.map(look, split)
    return jax.tree.map(lambda leaf: leaf.swapaxes(0, 1).reshape(num, *leaf.shape[2:]), found)


def map_critics(call: Callable[[Any], Any], variables: Any) -> Any:
    """Calls `call` with the variables of each critic, leaves [M, ...] in and out."""
    num = jax.tree.leaves(variables)[0].shape[0]  # not by vmap: its grouped convolutions are slow
    results = [call(jax.tree.map(lambda leaf, m=m: leaf[m], variables)) for m in range(num)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *results)


def logits(q: jax.Array, correction: jax.Array) -> jax.Array:
    """Returns the critic's map, which says where modes are, without gradient, plus the head's."""
    return jax.lax.stop_gradient(q) * SHARPNESS + correction


def unfold_maps(
    learner: ActorCritic, obs: Observation, q: jax.Array, correction: jax.Array
) -> maps.DenseMaps:
    """Builds the maps of all yaws from Q and the actor's output in the frames of the passes."""
    unfold = jax.vmap(maps.unfold)
    valid = jax.vmap(maps.actionable_cells, (None, 0))(learner.frames, obs)
    return maps.DenseMaps(unfold(q), unfold(logits(q, correction)), valid)


def best_grasp(state: maps.DenseMaps) -> jax.Array:
    """Returns phi_g(s) of eq. 16, []: the largest valid grasp value; 0 without a valid cell."""
    valid = state.valid[Primitive.GRASP]
    best = jnp.max(jnp.where(valid, state.q[Primitive.GRASP], -jnp.inf))
    return jnp.where(jnp.any(valid), best, 0.0)


def best_grasps(
    learner: ActorCritic, params: Params, obs: Observation, wanted: jax.Array
) -> jax.Array:
    """Computes phi_g [B] of the `wanted` [B] bool observations, leaves [B, ...]; else 0.

    Wanted ones are moved to the front, and only quarters of the batch with one pass through the
    networks. Under vmap all do as many as the largest count asks.
    """
    num = wanted.shape[0]
    size = -(-num // _QUARTERS)
    # Not by a sort: one whose keys nobody reads ends the process on several devices without Shardy.
    places = jnp.nonzero(wanted, size=num + -num % size, fill_value=num)[0]
    rows = places.astype(jnp.int32).reshape(-1, size)

    def quarter(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        done, values = carry
        part = jax.tree.map(lambda leaf: leaf.at[rows[done]].get(mode="clip"), obs)
        phi = jax.vmap(best_grasp)(dense_maps(learner, params, part))
        return done + 1, values.at[rows[done]].set(phi, mode="drop")

    unfinished = lambda carry: carry[0] * size < jnp.sum(wanted)  # noqa: E731
    _, values = jax.lax.while_loop(unfinished, quarter, (jnp.int32(0), jnp.zeros(num)))
    return jnp.where(wanted, values, 0.0)
