"""The critic's target, the loss of its error, and the update of target networks."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from csac_jax.config import LearnConfig

TD_LOSSES: dict[str, Callable[[LearnConfig, jax.Array], jax.Array]] = {
    "huber": lambda cfg, error: optax.losses.huber_loss(error, delta=cfg.huber),  # CSAC sec. 4
    "squared": lambda cfg, error: optax.losses.squared_error(error),  # Algorithm 1 line 21
}


def td_loss(cfg: LearnConfig, error: jax.Array) -> jax.Array:
    """Loss of TD errors, any shape."""
    return TD_LOSSES[cfg.loss](cfg, error)


def td_target(
    reward: jax.Array, gamma: float, terminated: jax.Array, next_value: jax.Array
) -> jax.Array:
    """y = r + gamma (1 - terminated) V(s'), eq. 9 and Algorithm 1 line 19; no gradient.

    All of one shape. Pass `terminated`, not `done`: an episode that is cut off goes on in V(s').
    V(s') after an end may be NaN: it is left out, not multiplied by 0.
    """
    return jax.lax.stop_gradient(reward + gamma * jnp.where(terminated, 0.0, next_value))


def update_target(cfg: LearnConfig, online: Any, target: Any, updates: jax.Array) -> Any:
    """Target networks after the critic's update number `updates` [] int32, counted from 1."""
    followed = optax.incremental_update(online, target, cfg.tau)  # Algorithm 1 lines 24-26
    if cfg.target_update_period == 1:
        return followed
    return optax.periodic_update(followed, target, updates, cfg.target_update_period)  # sec. 3.4
