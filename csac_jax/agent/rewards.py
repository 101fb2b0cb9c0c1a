"""Rewards of one action, CSAC eqs. 10-16: R = r + Gamma(phi) I.

Primitive 0 is a push, 1 a grasp. Outcome of a grasp: 0 nothing, 1 empty, 2 touched, 3 dropped, 4 lifted.
"""

import jax
import jax.numpy as jnp

from csac_jax.config import RewardConfig

PUSH, GRASP = 0, 1
PUSH_LEVEL, GRASP_LEVEL = 0, 1
"""s of eq. 13; the grasp's is s_max."""
LIFTED = 4
FARTHEST = 1.0
"""Distance beyond which the penalty of eq. 10 grows no more, m (ours: so that returns are bounded)."""


def scale(cfg: RewardConfig, level: int, level_max: int) -> float:
    """Gamma = eta0 + eta1 2^(s - s_max), eq. 13: with the default etas, 0.5 for a push and 1 for a grasp."""
    return cfg.eta0 + cfg.eta1 * 2.0 ** (level - level_max)


def base(cfg: RewardConfig, lifted: jax.Array, distance: jax.Array) -> jax.Array:
    """r = r2 - w r1 [], eqs. 10-11.

    Deviation: the paper adds r1, which would pay for staying away from the target.

    Args: lifted [] bool, the hand came back with a block; distance [] m, from the chosen place to where the tips acted.
    """
    return jnp.where(lifted, cfg.reach, 0.0) - cfg.distance * jnp.minimum(distance, FARTHEST)


def grasp_effect(cfg: RewardConfig, outcome: jax.Array) -> jax.Array:
    """I_g [] of `outcome` [] int32, eq. 15."""
    levels = jnp.asarray(_grasp_levels(cfg), jnp.float32)
    return levels.at[outcome].get(mode="clip")


def push_effect(cfg: RewardConfig, phi_before: jax.Array, phi_after: jax.Array) -> jax.Array:
    """I_c [], eq. 16: `push_better` if phi(s') > phi(s) + dead band, else `push_worse`, also for NaN.

    Args: phi_before, phi_after [] best grasp's value before and after the push, of one and the same critic.
    """
    return jnp.where(phi_after > phi_before + cfg.dead_band, cfg.push_better, cfg.push_worse)


def reward(
    cfg: RewardConfig,
    primitive: jax.Array,
    outcome: jax.Array,
    distance: jax.Array,
    phi_before: jax.Array,
    phi_after: jax.Array,
) -> jax.Array:
    """R = r + Gamma(phi) I [], eqs. 12 and 14; a push earns no r2.

    The text below eq. 12 swaps the names of its two factors; the product is the same.

    Args: primitive [] int32; outcome [] int32, read for grasps only; the others as in `base` and `push_effect`.
    """
    grasped = primitive == GRASP
    effect = jnp.where(
        grasped,
        scale(cfg, GRASP_LEVEL, GRASP_LEVEL) * grasp_effect(cfg, outcome),
        scale(cfg, PUSH_LEVEL, GRASP_LEVEL) * push_effect(cfg, phi_before, phi_after),
    )
    return base(cfg, grasped & (outcome == LIFTED), distance) + effect


def bounds(cfg: RewardConfig, gamma: float) -> tuple[float, float]:
    """Smallest and largest discounted return of an episode of any length.

    r + gamma r' + ... with every reward in [r_min, r_max]: r_min / (1 - gamma) if r_min is a loss, else r_min alone,
    from an episode that ends at once; likewise above.
    """
    grasp = [scale(cfg, GRASP_LEVEL, GRASP_LEVEL) * level for level in _grasp_levels(cfg)]
    grasp[LIFTED] += cfg.reach
    push = [scale(cfg, PUSH_LEVEL, GRASP_LEVEL) * effect for effect in (cfg.push_better, cfg.push_worse)]
    lowest, highest = min(grasp + push) - cfg.distance * FARTHEST, max(grasp + push)
    return min(lowest, lowest / (1.0 - gamma)), max(highest, highest / (1.0 - gamma))


def _grasp_levels(cfg: RewardConfig) -> tuple[float, ...]:
    return (cfg.nothing, cfg.empty, cfg.touched, cfg.dropped, cfg.lifted)
