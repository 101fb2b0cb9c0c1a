"""What a real depth camera gets wrong, drawn from a key; what has a spread of 0 is left out of the
program."""

import jax
import jax.numpy as jnp

from csac_jax import geometry
from csac_jax.config import SensorConfig
from csac_jax.vision.camera import Camera


def depth(key: jax.Array, cfg: SensorConfig, true: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Measured depths m, normal about the true ones with sigma = depth_floor + depth_square d^2,
    and which pixels have one, bool; any shape. See SensorConfig for the source."""
    key_noise, key_drop = jax.random.split(key)
    measured, kept = true, jnp.ones(true.shape, bool)
    if cfg.depth_floor > 0.0 or cfg.depth_square > 0.0:
        sigma = cfg.depth_floor + cfg.depth_square * true**2
        measured = true + sigma * jax.random.normal(key_noise, true.shape)
    if cfg.dropped > 0.0:
        kept = jax.random.bernoulli(key_drop, 1.0 - cfg.dropped, true.shape)
    return measured, kept


def pose(key: jax.Array, cfg: SensorConfig, believed: Camera) -> Camera:
    """Where the camera really stands: moved and turned a little."""
    key_position, key_rotation = jax.random.split(key)
    position, rotation = believed.position, believed.rotation
    if cfg.position > 0.0:
        position = position + cfg.position * jax.random.normal(key_position, (3,))
    if cfg.rotation > 0.0:
        half_turn = 0.5 * cfg.rotation * jax.random.normal(key_rotation, (3,))
        quat = jnp.concatenate([jnp.ones(1), half_turn])  # small angles
        turn = geometry.quat_to_matrix(quat / jnp.sqrt(jnp.sum(quat**2)))
        rotation = (turn[:, :, None] * rotation[None]).sum(1)
    return believed.replace(position=position, rotation=rotation)


def colour(key: jax.Array, cfg: SensorConfig, true: jax.Array) -> jax.Array:
    """Colours [H, W, 3] under another white balance, 0 .. 1."""
    if cfg.colour == 0.0:
        return true
    gain = 1.0 + cfg.colour * jax.random.normal(key, (3,))
    return jnp.clip(gain[None, None] * true, 0.0, 1.0)
