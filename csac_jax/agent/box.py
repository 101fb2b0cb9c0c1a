"""The box [-1, 1]^A of normalised actions: some dimensions end at its walls, others wrap around.

A pose (x, y, yaw) becomes u with x, y divided by half the workspace and u_yaw = yaw / pi - 1.
"""

import jax
import jax.numpy as jnp
import numpy as np

POSE_WRAPS = np.array([False, False, True])  # which dimensions of a pose (x, y, yaw) wrap


def wrap(u: jax.Array) -> jax.Array:
    """The same point of a circle of circumference 2 in [-1, 1), any shape.

    Near the seam u + 1 is exact in float32: the remainder cannot round up to a whole turn.
    """
    return jnp.mod(u + 1.0, 2.0) - 1.0


def project(u: jax.Array, wraps: jax.Array | np.ndarray) -> jax.Array:
    """Points `u` [..., A] in the box: dimensions of `wraps` [A] bool wrap, others are clipped."""
    return jnp.where(jnp.broadcast_to(wraps, u.shape), wrap(u), jnp.clip(u, -1.0, 1.0))
