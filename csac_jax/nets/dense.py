"""The small dense net: densely connected convolutions with group norm, at 1/`net.stride` of its
input's resolution.

Its maps may be finer: the last 1 x 1 convolution then gives `net.subcells`^2 values per cell of the
features, laid out beside each other (Shi et al., arXiv:1609.05158), at next to no cost.

It sees maps already turned to a frame, so that what it must know of a push is "ahead" and of a
grasp "across". The frame of yaw + pi shows the same picture upside down: each pass gives three
maps, push ahead, push back and grasp (a parallel gripper is symmetric), and K / 2 passes give all K
yaws of both primitives.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from csac_jax.config import NetConfig, SmallNet
from csac_jax.nets.convolution import conv2d

OUTPUTS = 3  # push along the frame's yaw, push against it, grasp
TABLE_HEIGHT = 0.002  # m: what is lower is bare table
_HEIGHT_SCALE = 0.05  # m, a block's height: brings heights near 1
_GROUP = 8  # channels per group of the norm
_EPSILON = 1e-6  # of the norm, Flax's


def compute_dtype(cfg: NetConfig) -> Any:
    """What a net computes in on this machine; its parameters and its maps are float32."""
    if cfg.dtype == "auto":
        return jnp.float32 if jax.default_backend() == "cpu" else jnp.bfloat16
    return jnp.dtype(cfg.dtype)


def inputs(
    colour: jax.Array | None, height: jax.Array, target: jax.Array | None, border: bool = False
) -> jax.Array:
    """Maps that the net is fed [..., H, W, I] from colour [..., H, W, 3] in 0..1 and height [...,
    H, W] m.

    I = 3 with colour, + 1, + 1 with a target mask [..., H, W] bool, + 1 with the border: 1 on the
    workspace. Bare table is 0 in the others, like what lies outside of a turned map, where all are
    0; heights below 0 are outside too.
    """
    maps = [jnp.maximum(height, 0.0)[..., None] / _HEIGHT_SCALE]
    if colour is not None:
        maps.insert(0, jnp.where(height[..., None] > TABLE_HEIGHT, colour - 0.5, 0.0))
    if target is not None:
        maps.append(target[..., None].astype(height.dtype))
    if border:
        maps.append((height >= 0.0)[..., None].astype(height.dtype))
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
    """Dense features of turned maps: [B, C, C, I] -> [B, C / stride, C / stride, stem + layers *
    growth]."""

    cfg: SmallNet

    @nn.compact
    def __call__(self, maps: jax.Array) -> jax.Array:
        cfg, stride, dtype = self.cfg, self.cfg.stride, compute_dtype(self.cfg)
        features = Convolution(
            cfg.stem, 2 * stride, stride=stride, padding=stride // 2, dtype=dtype
        )(maps)
        features = nn.relu(GroupNorm(dtype)(features))
        for dilation in cfg.dilations:
            new = Convolution(cfg.growth, size=3, dilation=dilation, padding=dilation, dtype=dtype)(
                features
            )
            features = jnp.concatenate([features, nn.relu(GroupNorm(dtype)(new))], axis=-1)
        return features


class Head(nn.Module):
    """Dense maps from features: [..., h, w, F] -> [..., s h, s w, OUTPUTS], s = subcells; two 1 x 1
    convolutions."""

    cfg: SmallNet

    @nn.compact
    def __call__(self, features: jax.Array, train: bool = False) -> jax.Array:
        del train  # group norm is the same in both
        hidden = nn.relu(nn.Dense(self.cfg.head, dtype=compute_dtype(self.cfg))(features)).astype(
            jnp.float32
        )
        small = nn.initializers.variance_scaling(0.01, "fan_in", "normal")
        return _spread(
            nn.Dense(OUTPUTS * self.cfg.subcells**2, kernel_init=small)(hidden), self.cfg.subcells
        )


def _spread(maps: jax.Array, factor: int) -> jax.Array:
    """Channels laid out as cells: [..., h, w, s s O] -> [..., s h, s w, O], s = factor; row,
    column, output."""
    *batch, rows, cols, channels = maps.shape
    parts = maps.reshape(*batch, rows, cols, factor, factor, channels // factor**2)
    return jnp.swapaxes(parts, -4, -3).reshape(*batch, factor * rows, factor * cols, -1)


class GroupNorm(nn.Module):
    """Group norm of maps [B, H, W, F], `_GROUP` channels a group: Flax's, in 0.6 to 0.7 of its time
    on a CPU.

    Sums run over cells first and over a group's channels then, which XLA computes a whole row of
    channels at a time.
    """

    dtype: Any

    @nn.compact
    def __call__(self, maps: jax.Array) -> jax.Array:
        channels = maps.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (channels,))
        bias = self.param("bias", nn.initializers.zeros, (channels,))
        groups = max(channels // _GROUP, 1)
        wide = maps.astype(jnp.float32)

        def mean(
            values: jax.Array,
        ) -> jax.Array:  # [B, H, W, F] -> [B, 1, 1, F], the same within a group
            each = jnp.mean(values, axis=(1, 2)).reshape(-1, groups, channels // groups)
            return jnp.repeat(jnp.mean(each, axis=2), channels // groups, axis=1)[:, None, None]

        middle = mean(wide)
        variance = jnp.maximum(mean(wide**2) - middle**2, 0.0)
        factor = jax.lax.rsqrt(variance + _EPSILON) * scale[None, None, None]
        return ((wide - middle) * factor + bias[None, None, None]).astype(self.dtype)


class Critic(nn.Module):
    """Q in three maps per frame, and the features that the actor reads."""

    cfg: SmallNet

    def setup(self) -> None:
        self.trunk = Trunk(self.cfg)
        self.head = Head(self.cfg)

    def __call__(self, maps: jax.Array, train: bool = False) -> tuple[jax.Array, jax.Array]:
        """[B, C, C, I] -> Q [B, s h, s h, OUTPUTS], features [B, h, h, F]; h = C / stride, s =
        subcells."""
        del train  # group norm is the same in both
        features = self.trunk(maps)
        return self.head(features), features
