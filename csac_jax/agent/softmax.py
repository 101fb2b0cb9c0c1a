"""The softmax value of a state over continuous actions, Algorithm 1 line 17, as SD3.

SD3 is arXiv:2010.09177.

softmax_beta(Q) = integral of exp(beta Q(a)) Q(a) da / integral of exp(beta Q(a)) da, estimated from
noisy actions a_i ~ p with weights exp(beta Q(a_i)) / p(a_i).
"""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.agent import box
from csac_jax.config import TargetConfig


def scaled_inverse_temperature(cfg: TargetConfig, return_range: float) -> float:
    """beta for returns that span `return_range`: beta Q does not depend on their scale (ours)."""
    return cfg.inverse_temperature / return_range


def expectation(
    q: jax.Array, log_density: jax.Array, inverse_temperature: jax.Array | float
) -> jax.Array:
    """Self-normalised importance-sampled softmax_beta, [].

    sum_i w_i q_i / sum_i w_i, w_i = exp(beta q_i) / p_i, line 17. The largest exponent is
    subtracted before exp: no weight overflows. Only distances below the largest q are weighted:
    rounding cannot pass that q.

    Args: q [N] finite values; log_density [N] log p of the samples; inverse_temperature [] beta.
    """
    weight = jax.nn.softmax(inverse_temperature * q - log_density)  # subtracts the maximum
    top = jnp.max(q)
    return top + jnp.sum(weight * (q - top))


def exact(q_map: jax.Array, inverse_temperature: jax.Array | float, valid: jax.Array) -> jax.Array:
    """softmax_beta [] over the `valid` [...] bool cells of `q_map` [...], one at least."""
    top = jnp.max(jnp.where(valid, q_map, -jnp.inf))
    below = jnp.where(valid, q_map - top, 0.0)
    weight = jnp.where(valid, jnp.exp(inverse_temperature * below), 0.0)
    return top + jnp.sum(weight * below) / jnp.sum(weight)


def noisy_actions(
    key: jax.Array, cfg: TargetConfig, mean: jax.Array, num: int
) -> tuple[jax.Array, jax.Array]:
    """Poses around `mean` [3] = normalised (x, y, yaw), and the log density of each.

    a = mu + eps, eps ~ N(0, std) truncated to [-clip, clip] (Algorithm 1 line 13, SD3), x and y
    also to the box. Deviation: line 13 clips the normal, which has no density at its bounds.
    p = phi(eps / std) / (std Z), Z = Phi(high / std) - Phi(low / std). As low <= 0 <= high, Z is
    a sum of two positive terms and nothing cancels. Yaw is truncated to half a turn at most:
    no pose can be drawn in two ways.

    Returns: actions [num, 3] in the box; log density [num] per unit of the box.
    """
    centre = box.project(mean, box.POSE_WRAPS)
    wall_low = jnp.where(box.POSE_WRAPS, -1.0, -1.0 - centre)
    wall_high = jnp.where(box.POSE_WRAPS, 1.0, 1.0 - centre)
    low = jnp.maximum(-cfg.clip, wall_low) / cfg.std  # [3], in units of std
    high = jnp.minimum(cfg.clip, wall_high) / cfg.std
    shape = (num, *mean.shape)
    noise = jax.random.truncated_normal(
        key, jnp.broadcast_to(low, shape), jnp.broadcast_to(high, shape), shape
    )
    mass = 0.5 * (jax.lax.erf(high / np.sqrt(2.0)) - jax.lax.erf(low / np.sqrt(2.0)))  # [3], Z
    log_scale = jnp.log(mass) + np.log(cfg.std * np.sqrt(2.0 * np.pi))
    log_density = jnp.sum(-0.5 * noise**2 - log_scale[None], axis=-1)
    return box.project(centre[None] + cfg.std * noise, box.POSE_WRAPS), log_density
