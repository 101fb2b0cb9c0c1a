"""The small dense net: densely connected convolutions with group norm on rotated maps.

Features have 1/`net.stride` of the input's resolution. The last 1 x 1 convolution gives
`net.subcells`^2 values per cell of them, as sub-pixel convolution (arXiv:1609.05158).

The net sees maps in an action's own frame: a push goes ahead, a grasp closes across. The frame of
yaw + pi shows the same picture upside down. So each pass gives three maps, push ahead, push back
and grasp (a parallel gripper is symmetric); K / 2 passes give all K yaws of both primitives.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from csac_jax.config import NetConfig, SmallNet
from csac_jax.nets.convolution import conv2d

OUTPUTS = 3  # push along the frame's yaw, push against it, grasp
COLOUR_MIN_HEIGHT = 0.002  # m: lower cells are bare table, of which no net sees the colour
OUTPUT_INIT = nn.initializers.variance_scaling(0.01, "fan_in", "normal")  # maps begin near 0
_HEIGHT_SCALE = 0.05  # m, a block's height: brings heights near 1
_GROUP_SIZE = 8  # channels per group of the norm
_EPSILON = 1e-6  # of the norm, Flax's


def compute_dtype(cfg: NetConfig) -> Any:
    """A net's type for computing on this machine; its parameters and its Q maps are float32."""
    if cfg.dtype == "auto":
        return jnp.float32 if jax.default_backend() == "cpu" else jnp.bfloat16
    return jnp.dtype(cfg.dtype)


def inputs(colour: jax.Array | None, height: jax.Array, target: jax.Array | None) -> jax.Array:
    """The net's input maps [..., H, W, I]; bare table is 0, like cells outside of a rotated map.

    Args: colour [..., H, W, 3] in 0..1 or None; height [..., H, W] m; target [..., H, W] bool or
    None. I = 1, + 3, + 1.
    """
    maps = [jnp.maximum(height, 0.0)[..., None] / _HEIGHT_SCALE]
    if colour is not None:
        maps.insert(0, jnp.where(height[..., None] > COLOUR_MIN_HEIGHT, colour - 0.5, 0.0))
    if target is not None:
        maps.append(target[..., None].astype(height.dtype))
    return jnp.concatenate(maps, axis=-1)


class Convolution(nn.Module):
    """Convolution without bias: [B, H, W, I] -> [B, H', W', features]."""

    features: int
    size: int  # cells, side of the kernel
    padding: int  # cells of zeros around the maps
    stride: int = 1
    dilation: int = 1
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, maps: jax.Array) -> jax.Array:
        shape = (self.size, self.size, maps.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.he_normal(), shape)
        maps, kernel = maps.astype(self.dtype), kernel.astype(self.dtype)
        return conv2d(maps, kernel, self.stride, self.dilation, self.padding)


class Trunk(nn.Module):
    """Features of rotated maps: [B, C, C, I] -> [B, C / stride, C / stride, F].

    F = stem + layers * growth.
    """

    cfg: SmallNet

    @nn.compact
    def __call__(self, maps: jax.Array) -> jax.Array:
        cfg, stride, dtype = self.cfg, self.cfg.stride, compute_dtype(self.cfg)
        stem = Convolution(cfg.stem, 2 * stride, stride // 2, stride, dtype=dtype)
        features = nn.relu(GroupNorm(dtype)(stem(maps)))
        for dilation in cfg.dilations:
            layer = Convolution(cfg.growth, 3, dilation, dilation=dilation, dtype=dtype)
            new = layer(features)
            features = jnp.concatenate([features, nn.relu(GroupNorm(dtype)(new))], axis=-1)
        return features


class Head(nn.Module):
    """Two 1 x 1 convolutions: [..., h, w, F] -> [..., s h, s w, OUTPUTS], s = subcells."""

    cfg: SmallNet

    @nn.compact
    def __call__(self, features: jax.Array, train: bool = False) -> jax.Array:
        del train  # group norm is the same in both
        cfg = self.cfg
        hidden = nn.relu(nn.Dense(cfg.head, dtype=compute_dtype(cfg))(features))
        output = nn.Dense(OUTPUTS * cfg.subcells**2, kernel_init=OUTPUT_INIT)
        return pixel_shuffle(output(hidden.astype(jnp.float32)), cfg.subcells)


def pixel_shuffle(maps: jax.Array, factor: int) -> jax.Array:
    """Channels laid out as cells: [..., h, w, s s O] -> [..., s h, s w, O], s = factor."""
    *batch, rows, cols, channels = maps.shape
    parts = maps.reshape(*batch, rows, cols, factor, factor, channels // factor**2)
    return jnp.swapaxes(parts, -4, -3).reshape(*batch, factor * rows, factor * cols, -1)


class GroupNorm(nn.Module):
    """Group norm of maps [B, H, W, F], `_GROUP_SIZE` channels a group.

    It takes 0.6 to 0.7 of the time of Flax's on a CPU: sums run over cells first, for which XLA
    takes all channels at a time, then over a group's channels.
    """

    dtype: Any

    @nn.compact
    def __call__(self, maps: jax.Array) -> jax.Array:
        channels = maps.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (channels,))
        bias = self.param("bias", nn.initializers.zeros, (channels,))
        groups = max(channels // _GROUP_SIZE, 1)
        exact = maps.astype(jnp.float32)

        def group_mean(values: jax.Array) -> jax.Array:
            """[B, H, W, F] -> [B, 1, 1, F], the same within a group."""
            each = jnp.mean(values, axis=(1, 2)).reshape(-1, groups, channels // groups)
            return jnp.repeat(jnp.mean(each, axis=2), channels // groups, axis=1)[:, None, None]

        mean = group_mean(exact)
        variance = jnp.maximum(group_mean(exact**2) - mean**2, 0.0)
        factor = jax.lax.rsqrt(variance + _EPSILON) * scale[None, None, None]
        return ((exact - mean) * factor + bias[None, None, None]).astype(self.dtype)


class Critic(nn.Module):
    """Q in three maps per frame, and the features that the actor reads."""

    cfg: SmallNet

    def setup(self) -> None:
        self.trunk = Trunk(self.cfg)
        self.head = Head(self.cfg)

    def __call__(self, maps: jax.Array, train: bool = False) -> tuple[jax.Array, jax.Array]:
        """[B, C, C, I] -> Q [B, s h, s h, OUTPUTS] and features [B, h, h, F].

        h = C / stride, s = subcells.
        """
        del train  # group norm is the same in both
        features = self.trunk(maps)
        return self.head(features), features
