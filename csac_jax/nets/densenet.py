"""DenseNet-121 (Huang et al., arXiv:1608.06993, table 1) as the paper's network over turned maps, CSAC sec. 3.4.

One trunk each for colour, height and, in the target task, the mask; what they see is joined, two 1 x 1 convolutions
turn it into maps, and these are brought up to a finer grid. Push and grasp come from one network. Modules are named as
in torchvision, so that its weights fit.

The trunks are the same program with other weights: they are stacked along an axis T, leaves [T, ...], and run in turn.
"""

import functools
import math

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import DENSENET_STRIDE, NetConfig
from csac_jax.nets.dense import OUTPUTS, TABLE_HEIGHT, compute_dtype

_COLOUR_MEAN = np.array([0.485, 0.456, 0.406], np.float32)  # of ImageNet, as torchvision's weights want it
_COLOUR_STD = np.array([0.229, 0.224, 0.225], np.float32)
_HEIGHT_SCALE = 0.03  # m (VPG)
_BOTTLENECK = 4  # channels of a layer's 1 x 1 convolution per channel that the layer adds
_EPSILON = 1e-5  # of both norms, torchvision's
_MOMENTUM = 0.9  # share that running statistics keep in an update, torchvision's (there written 0.1)
_GROUPS = 32
_KAIMING = nn.initializers.variance_scaling(2.0, "fan_in", "normal")  # torchvision's


def inputs(colour: jax.Array | None, height: jax.Array, target: jax.Array | None) -> jax.Array:
    """Maps that the net is fed [..., H, W, I] from colour [..., H, W, 3] in 0..1 and height [..., H, W] m.

    I = 3 with colour, + 1, + 1 with a target mask [..., H, W] bool. Bare table is 0, like what lies outside of a turned
    map; VPG takes a mean off the heights too.
    """
    maps = [height[..., None] / _HEIGHT_SCALE]
    if colour is not None:
        mean, std = (jnp.broadcast_to(v, colour.shape) for v in (_COLOUR_MEAN, _COLOUR_STD))
        normal = (colour - mean) / std
        maps.insert(0, jnp.where(height[..., None] > TABLE_HEIGHT, normal, 0.0))
    if target is not None:
        maps.append(target[..., None].astype(height.dtype))
    return jnp.concatenate(maps, axis=-1)


def _norm(cfg: NetConfig, channels: int, train: bool, name: str) -> nn.Module:
    """Norm of maps [..., channels]; `train`: batch norm takes the batch's statistics and moves the running ones."""
    dtype = compute_dtype(cfg)
    if cfg.norm == "batch":
        # E x^2 - (E x)^2, Flax's default, would cost a decimal in the last block: 1.5e-4 away from Keras, not 1.3e-5.
        return nn.BatchNorm(
            not train, use_fast_variance=False, momentum=_MOMENTUM, epsilon=_EPSILON, dtype=dtype, name=name
        )
    groups = math.gcd(_GROUPS, channels)
    return nn.GroupNorm(groups, epsilon=_EPSILON, dtype=dtype, reduction_axes=(-3, -2, -1), name=name)


def _convolution(cfg: NetConfig, features: int, size: int, stride: int, name: str) -> nn.Conv:
    return nn.Conv(
        features,
        (size, size),
        (stride, stride),
        padding=size // 2,
        use_bias=False,
        dtype=compute_dtype(cfg),
        kernel_init=_KAIMING,
        name=name,
    )


def max_pool(maps: jax.Array) -> jax.Array:
    """Largest of 3 x 3 cells, every second one: [B, H, W, F], H and W even, none below 0 -> [B, H / 2, W / 2, F].

    As the maximum of nine shifted maps: the gradient of XLA's own window needs an operation that GPUs lack when
    results are to repeat bit for bit (flax issue 4233).
    """
    rows, cols = maps.shape[1:3]
    padded = jnp.pad(maps, ((0, 0), (1, 1), (1, 1), (0, 0)))
    shifted = [padded[:, i : i + rows : 2, j : j + cols : 2] for i in range(3) for j in range(3)]
    return functools.reduce(jnp.maximum, shifted)


def average_pool(maps: jax.Array) -> jax.Array:
    """Mean of 2 x 2 cells: [B, H, W, F], H and W even -> [B, H / 2, W / 2, F]."""
    return 0.25 * (maps[:, ::2, ::2] + maps[:, ::2, 1::2] + maps[:, 1::2, ::2] + maps[:, 1::2, 1::2])


class DenseLayer(nn.Module):
    """Adds `block_growth` channels to maps: [B, H, W, F] -> [B, H, W, F + block_growth]."""

    cfg: NetConfig

    @nn.compact
    def __call__(self, maps: jax.Array, train: bool) -> jax.Array:
        growth, norm = self.cfg.block_growth, functools.partial(_norm, self.cfg, train=train)
        hidden = nn.relu(norm(maps.shape[-1], name="norm1")(maps))
        hidden = _convolution(self.cfg, _BOTTLENECK * growth, 1, 1, "conv1")(hidden)
        hidden = nn.relu(norm(_BOTTLENECK * growth, name="norm2")(hidden))
        return jnp.concatenate([maps, _convolution(self.cfg, growth, 3, 1, "conv2")(hidden)], axis=-1)


class DenseBlock(nn.Module):
    """Dense layers one after the other."""

    cfg: NetConfig
    layers: int

    @nn.compact
    def __call__(self, maps: jax.Array, train: bool) -> jax.Array:
        for i in range(self.layers):
            maps = DenseLayer(self.cfg, name=f"denselayer{i + 1}")(maps, train)
        return maps


class Transition(nn.Module):
    """Half of the channels at half of the resolution."""

    cfg: NetConfig

    @nn.compact
    def __call__(self, maps: jax.Array, train: bool) -> jax.Array:
        channels = maps.shape[-1]
        maps = nn.relu(_norm(self.cfg, channels, train, "norm")(maps))
        return average_pool(_convolution(self.cfg, channels // 2, 1, 1, "conv")(maps))


class Trunk(nn.Module):
    """DenseNet-121 without its top: [B, H, W, 3] -> [B, H / 32, W / 32, 1024], after the last norm."""

    cfg: NetConfig

    @nn.compact
    def __call__(self, maps: jax.Array, train: bool = False) -> jax.Array:
        stem = 2 * self.cfg.block_growth
        maps = _convolution(self.cfg, stem, 7, 2, "conv0")(maps)
        maps = max_pool(nn.relu(_norm(self.cfg, stem, train, "norm0")(maps)))
        for i, layers in enumerate(self.cfg.block_layers, start=1):
            maps = DenseBlock(self.cfg, layers, name=f"denseblock{i}")(maps, train)
            if i < len(self.cfg.block_layers):
                maps = Transition(self.cfg, name=f"transition{i}")(maps, train)
        return _norm(self.cfg, maps.shape[-1], train, "norm5")(maps)


class Head(nn.Module):
    """Dense maps from features: [..., h, w, F] -> [..., s h, s w, OUTPUTS] float32, s = 32 / (zoom * output_stride).

    Twice norm, ReLU and a 1 x 1 convolution, then upsampling (VPG). The last convolution has a bias (ours).
    """

    cfg: NetConfig

    @nn.compact
    def __call__(self, features: jax.Array, train: bool = False) -> jax.Array:
        cfg = self.cfg
        hidden = nn.relu(_norm(cfg, features.shape[-1], train, "norm0")(features))
        hidden = nn.Dense(cfg.head, use_bias=False, dtype=compute_dtype(cfg), name="conv0")(hidden)
        hidden = nn.relu(_norm(cfg, cfg.head, train, "norm1")(hidden)).astype(jnp.float32)
        small = nn.initializers.variance_scaling(0.01, "fan_in", "normal")
        maps = nn.Dense(OUTPUTS, kernel_init=small, name="conv1")(hidden)
        return _upsample(maps, DENSENET_STRIDE // (cfg.zoom * cfg.output_stride))


def _upsample(maps: jax.Array, factor: int) -> jax.Array:
    """Maps [..., h, w, F] at `factor` times the resolution, bilinear; cells keep their place."""
    *batch, rows, cols, channels = maps.shape
    return jax.image.resize(maps, (*batch, factor * rows, factor * cols, channels), "bilinear")


class Critic(nn.Module):
    """Q in three maps per frame, and the features that the actor reads."""

    cfg: NetConfig

    @nn.compact
    def __call__(self, maps: jax.Array, train: bool = False) -> tuple[jax.Array, jax.Array]:
        """[B, C, C, I] -> Q [B, C / output_stride, C / output_stride, OUTPUTS], features [B, h, w, F]."""
        run = nn.scan(
            lambda trunk, carry, seen: (carry, trunk(seen, train)),
            variable_axes={"params": 0, "batch_stats": 0},
            split_rngs={"params": True},
        )
        _, features = run(Trunk(self.cfg, name="trunk"), None, _trunk_inputs(self.cfg, maps))  # [T, B, h, w, f]
        features = jnp.concatenate(list(features), axis=-1)
        return Head(self.cfg, name="head")(features, train), features


def _trunk_inputs(cfg: NetConfig, maps: jax.Array) -> jax.Array:
    """What each trunk sees [T, B, zoom C, zoom C, 3] of maps [B, C, C, I]: colour, and every other map three times."""
    colour, rest = (maps[..., :3], maps[..., 3:]) if cfg.colour else (maps[..., :0], maps)
    seen = [colour] if cfg.colour else []
    seen += [jnp.repeat(rest[..., i : i + 1], 3, axis=-1) for i in range(rest.shape[-1])]
    stacked = jnp.stack(seen).astype(compute_dtype(cfg))
    return jnp.repeat(jnp.repeat(stacked, cfg.zoom, axis=2), cfg.zoom, axis=3)
