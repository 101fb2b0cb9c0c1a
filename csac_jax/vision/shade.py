"""Flat shading: every surface has one brightness, by its normal."""

import jax
import jax.numpy as jnp
import numpy as np

LIGHT = (
    0.36,
    0.48,
    0.8,
)  # unit vector towards the light; oblique, so that sloping faces differ in brightness
AMBIENT = 0.4  # share of the colour that a face turned away from the light keeps
SKY = np.array([0.75, 0.8, 0.85], np.float32)  # colour of what is not hit


def flat(colour: jax.Array, normal: jax.Array) -> jax.Array:
    """Colours [S, 3] of lit surfaces from their own colours [S, 3] and unit normals [S, 3]."""
    x, y, z = LIGHT
    facing = normal[:, 0] * x + normal[:, 1] * y + normal[:, 2] * z  # [S] cosine
    return (AMBIENT + (1.0 - AMBIENT) * jnp.maximum(facing, 0.0))[:, None] * colour
