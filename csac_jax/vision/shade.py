"""Flat shading: colours of hits from the colours of what was hit."""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.vision.raycast import Hit

LIGHT = (0.36, 0.48, 0.8)  # unit vector towards the light; oblique, so that sloping faces differ in brightness
AMBIENT = 0.4  # share of the colour that a face turned away from the light keeps
SKY = np.array([0.75, 0.8, 0.85], np.float32)  # colour of what is not hit


def flat(colour: jax.Array, hit: Hit) -> jax.Array:
    """Colours [R, 3] of hits [R]; SKY where not valid. Args: colour [1 + geoms, 3] of geoms -1, 0, 1, ..."""
    x, y, z = LIGHT
    facing = hit.normal[:, 0] * x + hit.normal[:, 1] * y + hit.normal[:, 2] * z  # [R] cosine
    brightness = AMBIENT + (1.0 - AMBIENT) * jnp.maximum(facing, 0.0)
    lit = brightness[:, None] * colour.at[hit.geom + 1].get(mode="promise_in_bounds")
    return jnp.where(hit.valid[:, None], lit, SKY[None])
