"""Rewards of one action, CSAC eqs. 10-16: R = r + Gamma(phi) I."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from csac_jax.config import RewardConfig
from csac_jax.constants import Outcome, Primitive


class ActionResult(NamedTuple):
    """Effects of an action that its reward depends on."""

    primitive: jax.Array  # [] int32, Primitive
    outcome: jax.Array  # [] int32, Outcome; read for grasps only
    distance: jax.Array  # [] m, from the chosen place to where the finger tips acted
    phi_before: jax.Array  # [] value of the best grasp before the action
    phi_after: jax.Array  # [] the same after it, by the same critic
    changed: jax.Array  # [] bool, more of the map moved than counts as a change
    blocks_lost: jax.Array  # [] int32, blocks that left the workspace


def gains_value(cfg: RewardConfig, before: jax.Array, after: jax.Array) -> jax.Array:
    """Checks that the best grasp's value phi, any shape, rose above the dead band, eq. 16."""
    return after > before + cfg.dead_band


def _gained(cfg: RewardConfig, result: ActionResult) -> jax.Array:
    return gains_value(cfg, result.phi_before, result.phi_after)


def scale(cfg: RewardConfig, level: float) -> float:
    """Returns Gamma = eta0 + eta1 2^(s - s_max), eq. 13; a grasp's level is s_max."""
    return cfg.eta[0] + cfg.eta[1] * 2.0 ** (level - cfg.grasp_level)


def push_effect(cfg: RewardConfig, good: jax.Array) -> jax.Array:
    """Returns I_c of pushes that are `good` or not, any shape, from `push_levels`."""
    worse, better = cfg.push_levels
    return jnp.where(good, better, worse)


def relabel(cfg: RewardConfig, reward: jax.Array, was: jax.Array, good: jax.Array) -> jax.Array:
    """Corrects rewards of pushes, any shape, from label `was` to label `good`."""
    change = push_effect(cfg, good) - push_effect(cfg, was)
    return reward + scale(cfg, cfg.push_level) * change


def reward(cfg: RewardConfig, result: ActionResult) -> jax.Array:
    """Computes R = r + Gamma(phi) I [], eqs. 10-14: r = r2 - w r1, r1 the distance, r2 for a lift.

    Deviation: the paper adds r1, which would reward distance. Ours: `lost_block_penalty`, once.
    """
    grasped = result.primitive == Primitive.GRASP
    levels = jnp.asarray(cfg.grasp_levels, jnp.float32)  # I_g, eq. 15
    grasp = scale(cfg, cfg.grasp_level) * levels.at[result.outcome].get(mode="clip")
    good = result.changed if cfg.push_label == "map_changed" else _gained(cfg, result)
    push = scale(cfg, cfg.push_level) * push_effect(cfg, good)
    lifted = grasped & (result.outcome == Outcome.LIFTED)
    loss = cfg.distance_weight * jnp.minimum(result.distance, cfg.distance_cap)
    base = jnp.where(lifted, cfg.success_bonus, 0.0) - loss
    penalty = jnp.where(result.blocks_lost > 0, cfg.lost_block_penalty, 0.0)
    return base + jnp.where(grasped, grasp, push) - penalty


def rewards_of(cfg: RewardConfig, results: ActionResult) -> tuple[jax.Array, jax.Array]:
    """Computes rewards [E] and which pushes were good [E] bool, of results with leaves [E]."""
    all_rewards = jax.vmap(reward, (None, 0))(cfg, results)
    return all_rewards, (results.primitive == Primitive.PUSH) & _gained(cfg, results)


def bounds(cfg: RewardConfig, gamma: float) -> tuple[float, float]:
    """Returns the smallest and largest discounted return of an episode of any length."""
    grasp = [scale(cfg, cfg.grasp_level) * level for level in cfg.grasp_levels]
    grasp[Outcome.LIFTED] += cfg.success_bonus
    push = [scale(cfg, cfg.push_level) * effect for effect in cfg.push_levels]
    lowest = min(grasp + push) - cfg.distance_weight * cfg.distance_cap - cfg.lost_block_penalty
    highest = max(grasp + push)
    return min(lowest, lowest / (1.0 - gamma)), max(highest, highest / (1.0 - gamma))
