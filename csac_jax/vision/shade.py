"""Flat shading: every surface has one brightness, by its normal."""

import jax
import jax.numpy as jnp
import numpy as np

LIGHT = (0.36, 0.48, 0.8)  # unit vector towards the light; oblique, so that slopes differ
AMBIENT = 0.4  # share of the colour that a face turned away from the light keeps
SKY = np.array([0.75, 0.8, 0.85], np.float32)  # colour of pixels that hit nothing


def flat(colour: jax.Array, normal: jax.Array) -> jax.Array:
    """Lit colours [S, 3] of surfaces with these colours [S, 3] and unit normals [S, 3]."""
    x, y, z = LIGHT
    cosine = normal[:, 0] * x + normal[:, 1] * y + normal[:, 2] * z  # [S]
    return (AMBIENT + (1.0 - AMBIENT) * jnp.maximum(cosine, 0.0))[:, None] * colour
