"""Noise of a real depth camera; noise of standard deviation 0 is left out of the program."""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.config import SensorConfig
from csac_jax.vision.camera import Camera


def episode_key(key: jax.Array | None, cfg: SensorConfig) -> jax.Array | None:
    """Root key of the noise of an episode reset with `key`, None without noise; ValueError if there
    is noise but no key."""
    if not cfg.active:
        return None
    if key is None:
        raise ValueError("a reset with sensor noise (config section `sensor`) needs a key")
    return jax.random.fold_in(key, np.uint32(2**31))  # distinct from the key's children by `split`


def depth(key: jax.Array, cfg: SensorConfig, exact: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Measured depths m of the exact ones, any shape, and which pixels have one, bool.

    Normal with standard deviation floor + square d^2; source: SensorConfig.
    """
    key_noise, key_drop = jax.random.split(key)
    measured, valid = exact, jnp.ones(exact.shape, bool)
    floor, square = cfg.depth_noise
    if floor > 0.0 or square > 0.0:
        std = floor + square * exact**2
        measured = exact + std * jax.random.normal(key_noise, exact.shape)
    if cfg.dropped > 0.0:
        valid = jax.random.bernoulli(key_drop, 1.0 - cfg.dropped, exact.shape)
    return measured, valid


def pose(key: jax.Array, cfg: SensorConfig, believed: Camera) -> Camera:
    """The real camera: the believed one, moved and rotated a little."""
    key_position, key_rotation = jax.random.split(key)
    position, rotation = believed.position, believed.rotation
    std_position, std_rotation = cfg.pose_noise
    if std_position > 0.0:
        position = position + std_position * jax.random.normal(key_position, (3,))
    if std_rotation > 0.0:
        half_angle = 0.5 * std_rotation * jax.random.normal(key_rotation, (3,))
        quat = jnp.concatenate([jnp.ones(1), half_angle])  # small angles
        jitter = geometry.quat_to_matrix(quat / jnp.sqrt(jnp.sum(quat**2)))
        rotation = (jitter[:, :, None] * rotation[None]).sum(1)
    return believed.replace(position=position, rotation=rotation)


def colour(key: jax.Array, cfg: SensorConfig, exact: jax.Array) -> jax.Array:
    """Colours [H, W, 3] in 0 .. 1 under another white balance: one random gain per channel."""
    if cfg.colour == 0.0:
        return exact
    gain = 1.0 + cfg.colour * jax.random.normal(key, (3,))
    return jnp.clip(gain[None, None] * exact, 0.0, 1.0)
