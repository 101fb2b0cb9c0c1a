"""What the critic is trained towards, how its error is weighed, and how targets follow."""

from typing import Any

import jax
import jax.numpy as jnp


def huber(error: jax.Array, width: float) -> jax.Array:
    """Huber loss of `error`, any shape: e^2 / 2 up to `width`, width (|e| - width / 2) beyond; CSAC sec. 4.

    Written without a branch, so that the gradient is finite for every finite error.
    """
    size = jnp.abs(error)
    quadratic = jnp.minimum(size, width)
    return 0.5 * quadratic**2 + width * (size - quadratic)


def td_target(reward: jax.Array, gamma: float, terminated: jax.Array, next_value: jax.Array) -> jax.Array:
    """y = r + gamma (1 - terminated) V(s'), eq. 9 and Algorithm 1 line 19; any one shape, no gradient.

    Only a true end stops the bootstrap: pass `terminated`, not `done`; a cut-off episode (truncated) goes on in V(s').
    The value after an end is left out, not multiplied by 0, so that it may be NaN.
    """
    return jax.lax.stop_gradient(reward + gamma * jnp.where(terminated, 0.0, next_value))


def polyak(online: Any, target: Any, tau: float) -> Any:
    """theta' <- tau theta + (1 - tau) theta' for each leaf, Algorithm 1 lines 24-26; tau = 1 is a copy."""
    return jax.tree.map(lambda new, old: tau * new + (1.0 - tau) * old, online, target)
