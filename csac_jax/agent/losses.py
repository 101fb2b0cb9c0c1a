"""The softmax value of the next state, the critic's target and loss, and target networks."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.typing import ArrayLike

from csac_jax.agent import box
from csac_jax.config import LearnConfig, TargetConfig


def softmax(q: jax.Array, log_density: jax.Array, inverse_temperature: ArrayLike) -> jax.Array:
    """Estimates int exp(beta Q(a)) Q(a) da / int exp(beta Q(a)) da [] from samples, line 17.

    As SD3 (arXiv:2010.09177): sum w_i q_i / sum w_i with w_i = exp(beta q_i) / p_i, of finite `q`
    [N] and log p [N]. Only distances below the largest q are weighted: rounding cannot pass that q.
    """
    weight = jax.nn.softmax(inverse_temperature * q - log_density)  # no overflow
    top = jnp.max(q)
    return top + jnp.sum(weight * (q - top))


def noisy_actions(
    key: jax.Array, cfg: TargetConfig, mean: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Draws actions [samples, 3] around `mean` [3], and log densities [samples] in the box.

    a = mu + eps, eps ~ N(0, std) truncated to [-clip, clip] (Algorithm 1 line 13, SD3), x and y
    also to the box, yaw to half a turn: no pose can be drawn in two ways. Deviation: line 13 clips
    the normal, which has no density at its bounds. p = phi(eps / std) / (std Z), Z = Phi(high /
    std) - Phi(low / std), of which nothing cancels as low <= 0 <= high.
    """
    centre = box.project(mean)
    wall_low = jnp.where(box.POSE_WRAPS, -1.0, -1.0 - centre)
    wall_high = jnp.where(box.POSE_WRAPS, 1.0, 1.0 - centre)
    low = jnp.maximum(-cfg.clip, wall_low) / cfg.std  # [3], in units of std
    high = jnp.minimum(cfg.clip, wall_high) / cfg.std
    lows, highs = (jnp.broadcast_to(bound, (cfg.samples, 3)) for bound in (low, high))
    noise = jax.random.truncated_normal(key, lows, highs)
    mass = 0.5 * (jax.lax.erf(high / np.sqrt(2.0)) - jax.lax.erf(low / np.sqrt(2.0)))  # [3], Z
    log_scale = jnp.log(mass) + np.log(cfg.std * np.sqrt(2.0 * np.pi))
    log_density = jnp.sum(-0.5 * noise**2 - log_scale[None], axis=-1)
    return box.project(centre[None] + cfg.std * noise), log_density


def td_loss(cfg: LearnConfig, error: jax.Array) -> jax.Array:
    """Computes the loss of TD errors, any shape: Algorithm 1 line 21, or Huber's of CSAC sec. 4."""
    if cfg.loss == "squared":
        return optax.losses.squared_error(error)
    return optax.losses.huber_loss(error, delta=cfg.huber)


def td_target(
    reward: jax.Array, gamma: float, terminated: jax.Array, next_value: jax.Array
) -> jax.Array:
    """Computes y = r + gamma (1 - terminated) V(s'), eq. 9 and line 19; no gradient.

    An episode that is cut off is not `terminated`. V(s') after an end may be NaN and is ignored.
    """
    return jax.lax.stop_gradient(reward + gamma * jnp.where(terminated, 0.0, next_value))


def update_target(cfg: LearnConfig, online: Any, target: Any) -> Any:
    """Moves target networks towards the online ones, Algorithm 1 lines 24-26."""
    return optax.incremental_update(online, target, cfg.tau)
