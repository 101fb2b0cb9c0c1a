"""Rewards of one action, CSAC eqs. 10-16: R = r + Gamma(phi) I.

Primitive 0 is a push, 1 a grasp. Outcome of a grasp: 0 nothing, 1 empty, 2 touched, 3 dropped, 4
lifted.
"""

import jax
import jax.numpy as jnp

from csac_jax.config import RewardConfig
from csac_jax.constants import Outcome, Primitive


def scale(cfg: RewardConfig, level: float) -> float:
    """Gamma = eta0 + eta1 2^(s - s_max), eq. 13: by default 0.5 for a push and 1 for a grasp, whose
    level is s_max."""
    return cfg.eta0 + cfg.eta1 * 2.0 ** (level - cfg.grasp_level)


def base(cfg: RewardConfig, lifted: jax.Array, distance: jax.Array) -> jax.Array:
    """r = r2 - w r1 [], eqs. 10-11.

    Deviation: the paper adds r1, which would pay for staying away from the target.

    Args: lifted [] bool, the hand came back with a block; distance [] m, from the chosen place to
    where the tips acted.
    """
    return jnp.where(lifted, cfg.success_bonus, 0.0) - cfg.distance_weight * jnp.minimum(
        distance, cfg.distance_cap
    )


def grasp_effect(cfg: RewardConfig, outcome: jax.Array) -> jax.Array:
    """I_g [] of `outcome` [] int32, eq. 15."""
    levels = jnp.asarray(_grasp_levels(cfg), jnp.float32)
    return levels.at[outcome].get(mode="clip")


def push_effect(
    cfg: RewardConfig, phi_before: jax.Array, phi_after: jax.Array, changed: jax.Array
) -> jax.Array:
    """I_c []: `push_better` after a good push, else `push_worse`.

    Good is, by `value`, phi(s') > phi(s) + dead band, eq. 16, never NaN; by `change`, that the map
    has changed (VPG).

    Args: phi_before, phi_after [] best grasp's value before and after the push, of one and the same
    critic; changed [] bool, more of the map moved than counts as a change.
    """
    if cfg.push_effect == "value":
        good = phi_after > phi_before + cfg.dead_band
    elif cfg.push_effect == "change":
        good = changed
    else:
        raise ValueError(f"reward.push_effect: {cfg.push_effect!r} is neither 'value' nor 'change'")
    return jnp.where(good, cfg.push_better, cfg.push_worse)


def reward(
    cfg: RewardConfig,
    primitive: jax.Array,
    outcome: jax.Array,
    distance: jax.Array,
    phi_before: jax.Array,
    phi_after: jax.Array,
    changed: jax.Array,
    blocks_lost: jax.Array,
) -> jax.Array:
    """R = r + Gamma(phi) I [], eqs. 12 and 14; a push earns no r2. Ours: blocks that left cost
    `cfg.lost_block_penalty`, once.

    The text below eq. 12 swaps the names of its two factors; the product is the same.

    Args: primitive [] int32; outcome [] int32, read for grasps only; blocks_lost [] int32, blocks
    that left the workspace; the others as in `base` and `push_effect`.
    """
    grasped = primitive == Primitive.GRASP
    effect = jnp.where(
        grasped,
        scale(cfg, cfg.grasp_level) * grasp_effect(cfg, outcome),
        scale(cfg, cfg.push_level) * push_effect(cfg, phi_before, phi_after, changed),
    )
    return (
        base(cfg, grasped & (outcome == Outcome.LIFTED), distance)
        + effect
        - jnp.where(blocks_lost > 0, cfg.lost_block_penalty, 0.0)
    )


def bounds(cfg: RewardConfig, gamma: float) -> tuple[float, float]:
    """Smallest and largest discounted return of an episode of any length.

    r + gamma r' + ... with every reward in [r_min, r_max]: r_min / (1 - gamma) if r_min is a loss,
    else r_min alone, from an episode that ends at once; likewise above.
    """
    grasp = [scale(cfg, cfg.grasp_level) * level for level in _grasp_levels(cfg)]
    grasp[Outcome.LIFTED] += cfg.success_bonus
    push = [scale(cfg, cfg.push_level) * effect for effect in (cfg.push_better, cfg.push_worse)]
    lowest, highest = (
        min(grasp + push) - cfg.distance_weight * cfg.distance_cap - cfg.lost_block_penalty,
        max(grasp + push),
    )
    return min(lowest, lowest / (1.0 - gamma)), max(highest, highest / (1.0 - gamma))


def _grasp_levels(cfg: RewardConfig) -> tuple[float, ...]:
    return (cfg.nothing, cfg.empty, cfg.touched, cfg.dropped, cfg.lifted)
