"""The box [-1, 1]^3 of normalised poses u: x and y over half the workspace, yaw / pi - 1."""

import jax
import jax.numpy as jnp
import numpy as np

POSE_WRAPS = np.array([False, False, True])  # of (x, y, yaw)


def wrap(u: jax.Array) -> jax.Array:
    """Wraps a circle of circumference 2 to [-1, 1), any shape.

    Near the seam u + 1 is exact in float32: the remainder cannot round up to a whole turn.
    """
    return jnp.mod(u + 1.0, 2.0) - 1.0


def wrap_yaw(u: jax.Array) -> jax.Array:
    """Wraps the yaw of poses, or of offsets between them, [..., 3]."""
    return jnp.where(jnp.broadcast_to(POSE_WRAPS, u.shape), wrap(u), u)


def project(u: jax.Array) -> jax.Array:
    """Projects points `u` [..., 3] to the box: yaw wraps, x and y are clipped."""
    return jnp.where(jnp.broadcast_to(POSE_WRAPS, u.shape), wrap(u), jnp.clip(u, -1.0, 1.0))
