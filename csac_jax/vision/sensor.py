"""Errors of a real depth camera; those that are off are left out of the program.

An image of another renderer, drawn from the camera of `pose`, goes through `image`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.config import CameraConfig, SensorConfig
from csac_jax.vision import camera, depth_camera
from csac_jax.vision.camera import Camera

GREY = 0.5  # level of a view without colours (ours), which the small net takes as 0
_OWN = np.uint32(2**31)  # distinct from children by `split`
_SRGB = 2.2  # exponent from a colour level to light, about that of sRGB


def episode_key(key: jax.Array | None, cfg: SensorConfig) -> jax.Array | None:
    """Returns an episode's root key of noise, or None without noise. Raises ValueError for a
    missing key."""
    if not cfg.active:
        return None
    if key is None:
        raise ValueError("a reset with sensor noise (config section `sensor`) needs a key")
    return jax.random.fold_in(key, _OWN)


def depth(key: jax.Array, cfg: SensorConfig, exact: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Measures exact depths m of any shape; returns them and bool, there is one."""
    key_noise, key_drop = jax.random.split(key)
    measured, valid = exact, jnp.ones(exact.shape, bool)
    floor, square = cfg.depth_noise
    if floor > 0.0 or square > 0.0:
        std = floor + square * exact**2
        measured = exact + std * jax.random.normal(key_noise, exact.shape)
    if cfg.dropped > 0.0:
        valid = jax.random.bernoulli(key_drop, 1.0 - cfg.dropped, exact.shape)
    return measured, valid


def image(
    key: jax.Array, cfg: SensorConfig, eye: CameraConfig, rgb: Any, depth: Any
) -> tuple[jax.Array, jax.Array]:
    """Adds sensor errors to an image of any renderer; errors of pose and lens are in `pose`.

    Args: rgb [h, w, 3] uint8; depth [h, w] m along the optical axis, 0 or NaN without one.
    """
    key_depth, key_colour = jax.random.split(key)
    exact, valid = depth.astype(jnp.float32), depth > 0.0
    lit = rgb.astype(jnp.float32) / 255.0
    measured, known = depths(key_depth, cfg, eye, jnp.where(valid, exact, 0.0), valid, lit)
    levels = jnp.round(255.0 * colour(key_colour, cfg, lit)).astype(jnp.uint8)
    return levels, jnp.where(known, jnp.maximum(measured, 0.0), 0.0)


def depths(
    key: jax.Array,
    cfg: SensorConfig,
    eye: CameraConfig,
    exact: jax.Array,
    valid: jax.Array,
    colour: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Measures an image by `depth_camera`, then `depth`, whose values it returns.

    Args: exact [h, w] m; valid [h, w] bool; colour [h, w, 3], 0 .. 1, as lit.
    """
    if cfg.kind != "none":
        lightness = jnp.mean(colour, axis=-1) ** _SRGB
        model, key_model = depth_camera.CAMERAS[cfg.kind], jax.random.fold_in(key, _OWN)
        exact, valid = depth_camera.measure(key_model, model, eye, exact, valid, lightness)
    measured, known = depth(key, cfg, exact)
    return measured, valid & known


def pose(key: jax.Array, cfg: SensorConfig, believed: Camera) -> Camera:
    """Draws the real camera: the believed one, moved and rotated a little, with another lens."""
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
    focal, centre = believed.focal, believed.centre
    if cfg.intrinsics_noise != (0.0, 0.0):
        std = jnp.asarray(cfg.intrinsics_noise, jnp.float32)[:, None]
        off = std * jax.random.normal(jax.random.fold_in(key, _OWN), (2, 2))
        focal, centre = focal * (1.0 + off[0]), centre + focal * off[1]
    return believed.replace(position=position, rotation=rotation, focal=focal, centre=centre)


def light(key: jax.Array, cfg: SensorConfig) -> jax.Array:
    """Draws the unit vector [3] towards the light: that of `camera.shade`, turned a little."""
    towards = jnp.asarray(camera.LIGHT, jnp.float32) + cfg.light * jax.random.normal(key, (3,))
    return towards / jnp.sqrt(jnp.sum(towards**2))


def grey(root: jax.Array, cfg: SensorConfig, colour: jax.Array) -> jax.Array:
    """Replaces colours [H, W, 3] by GREY in all views of a share `cfg.grey` of episodes.

    Args: root, of the episode, see `episode_key`.
    """
    if cfg.grey == 0.0:
        return colour
    dropped = jax.random.bernoulli(jax.random.fold_in(root, _OWN), cfg.grey)
    return jnp.where(dropped, jnp.full_like(colour, GREY), colour)


def colour(key: jax.Array, cfg: SensorConfig, exact: jax.Array) -> jax.Array:
    """Changes white balance and brightness of colours [H, W, 3] in 0 .. 1 by random gains."""
    if cfg.colour == 0.0 and cfg.light == 0.0:
        return exact
    gain = 1.0 + cfg.colour * jax.random.normal(key, (3,))
    if cfg.light > 0.0:
        gain = gain * jnp.exp(cfg.light * jax.random.normal(jax.random.fold_in(key, _OWN)))
    return jnp.clip(gain[None, None] * exact, 0.0, 1.0)
