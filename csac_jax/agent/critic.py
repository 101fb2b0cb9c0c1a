"""The critic's update: V(s') of the next state, the TD target, one gradient step; lines 17-26."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from csac_jax.agent import actor, losses, maps, rewards, values
from csac_jax.agent.actor_critic import ActorCritic, LearnerState, Params
from csac_jax.agent.learner import Transition, UpdateInfo
from csac_jax.constants import Primitive
from csac_jax.nets import dense, networks
from csac_jax.robot.primitives import Action
from csac_jax.vision import heightmap, rotate


def next_value(learner: ActorCritic, key: jax.Array, state: maps.DenseMaps) -> jax.Array:
    """Computes V(s') [] over the primitives that the policy takes, by `target.value`.

    The maximum (eq. 9, VPG) is over valid cells; over all if none is valid.
    """
    if learner.cfg.target.value == "softmax":
        return _softmax_value(learner, key, state)
    chosen = np.array(maps.allowed_primitives(learner.cfg.policy))
    valid = state.valid[chosen]
    return jnp.max(jnp.where(valid | ~jnp.any(valid), state.q[chosen], -jnp.inf))


def _softmax_value(learner: ActorCritic, key: jax.Array, state: maps.DenseMaps) -> jax.Array:
    """Estimates softmax_beta(Q'(s', .)) [] from noisy target actions, Algorithm 1 line 17.

    Samples on empty table are ignored unless all are. beta is relative to the returns' range.
    """
    cfg, frames, (lowest, highest) = learner.cfg.target, learner.frames, learner.bounds

    def sample(
        primitive: jax.Array, single: maps.DenseMaps
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        mean = maps.normalise(frames, actor.pose(frames, single, 0))
        key_noise = jax.random.fold_in(key, primitive)
        noisy, log_density = losses.noisy_actions(key_noise, cfg, mean)
        poses = jax.vmap(maps.denormalise, (None, 0))(frames, noisy)
        read = jax.vmap(maps.read_valid, (None, None, None, 0))(frames, single, 0, poses)
        return *read, log_density

    samples = maps.map_primitives(sample, state, maps.allowed_primitives(learner.cfg.policy))
    q, valid, log_density = (leaf.reshape(-1) for leaf in samples)
    counted = valid | ~jnp.any(valid)
    return losses.softmax(
        jnp.where(counted, q, lowest),
        jnp.where(counted, log_density, jnp.inf),
        cfg.inverse_temperature / (highest - lowest),
    )


def renewed_reward(
    learner: ActorCritic, params: Params, batch: Transition, next_maps: maps.DenseMaps
) -> jax.Array:
    """Returns rewards [B] with eq. 16's label of pushes by `params`; as stored without labels."""
    if batch.push_better is None:
        return batch.reward
    cfg, pushed = learner.cfg.reward, batch.action.primitive == Primitive.PUSH
    before = values.best_grasps(learner, params, heightmap.unpack(batch.obs), pushed)
    good = rewards.gains_value(cfg, before, jax.vmap(values.best_grasp)(next_maps))
    relabelled = rewards.relabel(cfg, batch.reward, batch.push_better, good)
    return jnp.where(pushed, relabelled, batch.reward)


def q_of_actions(
    learner: ActorCritic, critic: Any, obs: heightmap.Observation, action: Action
) -> tuple[jax.Array, Any]:
    """Computes Q(s, a) [M, B] from two passes per state, in the frames next to the action's yaw.

    Also returns the critics' running statistics after it.
    """
    frames, num = learner.frames, learner.frames.yaws.shape[0]
    index = maps.yaw_index(frames, action.pose[:, 2])
    lower = rotate.floor(index)
    k = jnp.mod(lower[:, None].astype(jnp.int32) + np.array([[0, 1]], np.int32), num)  # [B, 2]
    half = jnp.mod(k, num // 2)
    passes = jax.vmap(maps.rotated_inputs, (None, 0, 0))(frames, obs, half)
    flat, net = passes.reshape(-1, *passes.shape[2:]), frames.networks.critic
    (q, _), statistics = values.map_critics(lambda own: networks.train(net, own, flat), critic)
    q = q.reshape(q.shape[0], *k.shape, *q.shape[2:])  # [M, B, 2, h, w, OUTPUTS]
    push_output = (k >= num // 2).astype(jnp.int32)
    is_grasp = (action.primitive == Primitive.GRASP)[:, None]
    output = jnp.where(is_grasp, dense.OUTPUTS - 1, push_output)

    def at(q: jax.Array, output: jax.Array, half: jax.Array, xy: jax.Array) -> jax.Array:
        yaw = jnp.asarray(frames.yaws)[half]
        position = rotate.to_cell(frames.side, frames.cell, yaw, xy)
        return rotate.bilinear(q[..., output], position)

    read = jax.vmap(jax.vmap(at, (0, 0, 0, None)))
    near = jax.vmap(read, (0, None, None, None))(q, output, half, action.pose[:, :2])  # [M, B, 2]
    share = (index - lower)[None]
    return (1.0 - share) * near[..., 0] + share * near[..., 1], statistics


def update(
    key: jax.Array, learner: ActorCritic, state: LearnerState, batch: Transition, weights: jax.Array
) -> tuple[LearnerState, UpdateInfo]:
    """Updates theta^Q on a batch, then the targets; Algorithm 1 lines 17-26.

    L = mean_i w_i huber(y_i - Q(s_i, a_i)) with `weights` w [B], 1 but for a prioritised replay.
    """
    cfg = learner.cfg
    next_maps = values.dense_maps(learner, state.target, heightmap.unpack(batch.next_obs))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(batch.reward.shape[0]))
    next_values = jax.vmap(next_value, (None, 0, 0))(learner, keys, next_maps)
    next_values = jnp.clip(next_values, *learner.bounds)
    reward = renewed_reward(learner, state.target, batch, next_maps)
    y = losses.td_target(reward, cfg.target.gamma, batch.terminated, next_values)
    obs, critic = heightmap.unpack(batch.obs), state.online.critic

    def loss(learned: Any) -> tuple[jax.Array, tuple[jax.Array, Any]]:
        q, statistics = q_of_actions(learner, {**critic, **learned}, obs, batch.action)  # [M, B]
        per_row = jnp.sum(losses.td_loss(cfg.learn, y[None] - q), axis=0)
        return jnp.mean(weights * per_row), (jnp.mean(q, axis=0), statistics)

    before = networks.learned(critic)
    (critic_loss, (q, statistics)), gradient = jax.value_and_grad(loss, has_aux=True)(before)
    step, optimiser = learner.critic_optimiser.update(gradient, state.critic_optimiser)
    online = state.online.replace(critic={**optax.apply_updates(before, step), **statistics})
    target = losses.update_target(cfg.learn, online, state.target)
    state = LearnerState(online, target, optimiser, state.actor_optimiser, state.updates + 1)
    return state, UpdateInfo(critic_loss, jnp.mean(q), y - q)
