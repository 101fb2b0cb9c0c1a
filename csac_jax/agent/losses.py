"""What the critic is trained towards, how its error is weighed, and how targets follow."""

from typing import Any

import jax
import jax.numpy as jnp

from csac_jax.config import LearnConfig


def of_error(cfg: LearnConfig, error: jax.Array) -> jax.Array:
    """Loss of TD errors, any shape: `huber` (CSAC sec. 4) or `squared`, e^2 (Algorithm 1 line
    21)."""
    if cfg.loss == "huber":
        return huber(error, cfg.huber)
    if cfg.loss == "squared":
        return error**2
    raise ValueError(f"learn.loss: {cfg.loss!r} is neither 'huber' nor 'squared'")


def huber(error: jax.Array, width: float) -> jax.Array:
    """Huber loss of `error`, any shape: e^2 / 2 up to `width`, width (|e| - width / 2) beyond; CSAC
    sec. 4.

    Written without a branch, so that the gradient is finite for every finite error.
    """
    size = jnp.abs(error)
    quadratic = jnp.minimum(size, width)
    return 0.5 * quadratic**2 + width * (size - quadratic)


def td_target(
    reward: jax.Array, gamma: float, terminated: jax.Array, next_value: jax.Array
) -> jax.Array:
    """y = r + gamma (1 - terminated) V(s'), eq. 9 and Algorithm 1 line 19; any one shape, no
    gradient.

    Only a true end stops the bootstrap: pass `terminated`, not `done`; a cut-off episode
    (truncated) goes on in V(s'). The value after an end is left out, not multiplied by 0, so that
    it may be NaN.
    """
    return jax.lax.stop_gradient(reward + gamma * jnp.where(terminated, 0.0, next_value))


def polyak(online: Any, target: Any, tau: float) -> Any:
    """theta' <- tau theta + (1 - tau) theta' for each leaf, Algorithm 1 lines 24-26; tau = 1 is a
    copy."""
    return jax.tree.map(lambda new, old: tau * new + (1.0 - tau) * old, online, target)


def copy(online: Any, target: Any, due: jax.Array) -> Any:
    """theta' <- theta for each leaf where `due` [] bool, CSAC sec. 3.4; else theta' as it is."""
    return jax.tree.map(lambda new, old: jnp.where(due, new, old), online, target)


def follow(cfg: LearnConfig, online: Any, target: Any, updates: jax.Array) -> Any:
    """Target networks after the critic's update number `updates` [] int32, counted from 1: `soft`
    or `hard`."""
    if cfg.target_update == "soft":
        return polyak(online, target, cfg.tau)
    if cfg.target_update == "hard":
        return copy(online, target, updates % cfg.target_update_period == 0)
    raise ValueError(f"learn.target_update: {cfg.target_update!r} is neither 'soft' nor 'hard'")
