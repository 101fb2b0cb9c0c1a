"""DenseNet-121 (arXiv:1608.06993, table 1) as the paper's network over rotated maps, CSAC sec. 3.4.

Colour, height and, in the target task, the mask have a trunk each, with weights [T, ...]. Modules
have torchvision's names: its weights fit.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name

from csac_jax.config import DenseNet121
from csac_jax.nets.dense import OUTPUT_INIT, OUTPUTS, compute_dtype
from csac_jax.nets.products import Stem, TapConvolution, average_pool, max_pool

HEIGHT_SCALE = 0.03  # m (VPG, which subtracts a mean from heights too)
# Mean and standard deviation of ImageNet's colours, by which torchvision's weights want them.
COLOUR_SCALE = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]], np.float32)
_BOTTLENECK = 4  # channels of a layer's 1 x 1 convolution per channel that the layer adds
_EPSILON = 1e-5  # of both norms, torchvision's
_MOMENTUM = 0.9  # share that running statistics keep in an update; torchvision writes 0.1
_MAX_GROUPS = 32  # of group norm
_SAVED = "saved"  # name of values that the backward pass does not compute again


class Piece(NamedTuple):
    """Output of one layer, with the statistics of each channel."""

    maps: jax.Array  # [..., F]
    mean: jax.Array  # [F] float32
    variance: jax.Array  # [F] float32


def _piece(maps: jax.Array) -> Piece:
    """Computes the statistics of maps; all are saved for the gradient, see `DenseNetCritic`."""
    axes, exact = tuple(range(maps.ndim - 1)), maps.astype(jnp.float32)
    mean = jnp.mean(exact, axes, keepdims=True)
    variance = jnp.mean(jnp.square(exact - mean), axes)  # E x^2 - (E x)^2 would cost a decimal
    return Piece(*(checkpoint_name(leaf, _SAVED) for leaf in (maps, mean.reshape(-1), variance)))


class BatchNorm(nn.Module):
    """Batch norm of maps [..., F] by given mean and variance [F], or by the running ones."""

    dtype: Any

    @nn.compact
    def __call__(self, maps: jax.Array, statistics: Sequence[jax.Array] | None) -> jax.Array:
        shape = maps.shape[-1:]
        starts = (("mean", jnp.zeros), ("var", jnp.ones))
        running = [self.variable("batch_stats", name, start, shape) for name, start in starts]
        scale = self.param("scale", nn.initializers.ones, shape)
        bias = self.param("bias", nn.initializers.zeros, shape)
        mean, variance = statistics or [variable.value for variable in running]
        if statistics and not self.is_initializing():
            for variable, value in zip(running, statistics, strict=True):
                variable.value = _MOMENTUM * variable.value + (1.0 - _MOMENTUM) * value
        factor = scale * jax.lax.rsqrt(variance + _EPSILON)
        ones = (1,) * (maps.ndim - 1)
        factor, shift = (leaf.reshape(ones + shape) for leaf in (factor, bias - mean * factor))
        return (maps.astype(jnp.float32) * factor + shift).astype(self.dtype)


def _norm(cfg: DenseNet121, pieces: Sequence[Piece], train: bool, name: str) -> jax.Array:
    """Joins and normalises pieces: [..., F]; with `train` batch norm takes batch statistics."""
    dtype = compute_dtype(cfg)
    maps, *statistics = (jnp.concatenate(leaves, axis=-1) for leaves in zip(*pieces, strict=True))
    if cfg.norm == "batch":
        return BatchNorm(dtype, name=name)(maps, statistics if train else None)
    groups, axes = math.gcd(_MAX_GROUPS, maps.shape[-1]), (-3, -2, -1)
    norm = nn.GroupNorm(groups, epsilon=_EPSILON, dtype=dtype, reduction_axes=axes, name=name)
    return norm(maps)


class DenseLayer(nn.Module):
    """The piece [B, H, W, block_growth] that a layer adds to those before it."""

    cfg: DenseNet121

    @nn.compact
    def __call__(self, pieces: Sequence[Piece], train: bool) -> Piece:
        growth, dtype = self.cfg.block_growth, compute_dtype(self.cfg)
        hidden = nn.relu(_norm(self.cfg, pieces, train, "norm1"))
        narrow = _piece(TapConvolution(_BOTTLENECK * growth, 1, dtype, name="conv1")(hidden))
        hidden = nn.relu(_norm(self.cfg, [narrow], train, "norm2"))
        return _piece(TapConvolution(growth, 3, dtype, name="conv2")(hidden))


class DenseBlock(nn.Module):
    """Dense layers, each on all pieces before it; returns all, to be joined by the next norm."""

    cfg: DenseNet121
    layers: int

    @nn.compact
    def __call__(self, pieces: list[Piece], train: bool) -> list[Piece]:
        for i in range(self.layers):
            pieces = [*pieces, DenseLayer(self.cfg, name=f"denselayer{i + 1}")(pieces, train)]
        return pieces


class TransitionLayer(nn.Module):
    """Half of the channels at half of the resolution."""

    cfg: DenseNet121

    @nn.compact
    def __call__(self, pieces: Sequence[Piece], train: bool) -> Piece:
        channels = sum(piece.maps.shape[-1] for piece in pieces)
        maps = nn.relu(_norm(self.cfg, pieces, train, "norm"))
        halve = TapConvolution(channels // 2, 1, compute_dtype(self.cfg), name="conv")
        return _piece(average_pool(halve(maps)))


class DenseNetTrunk(nn.Module):
    """DenseNet-121 without its top: [B, H, W, 3] -> [B, H / 32, W / 32, 1024], after the last norm.

    With `cfg.upsample` above 1 each cell stands for 2 x 2 pixels: [B, H / 16, W / 16, 1024].
    """

    cfg: DenseNet121

    @nn.compact
    def __call__(self, maps: jax.Array, train: bool = False) -> jax.Array:
        stem = 2 * self.cfg.block_growth
        maps = Stem(stem, self.cfg.upsample > 1, compute_dtype(self.cfg), name="conv0")(maps)
        pieces = [_piece(max_pool(nn.relu(_norm(self.cfg, [_piece(maps)], train, "norm0"))))]
        for i, layers in enumerate(self.cfg.block_layers):
            if i > 0:
                pieces = [TransitionLayer(self.cfg, name=f"transition{i}")(pieces, train)]
            pieces = DenseBlock(self.cfg, layers, name=f"denseblock{i + 1}")(pieces, train)
        return _norm(self.cfg, pieces, train, "norm5")


class DenseNetHead(nn.Module):
    """Twice norm, ReLU and a 1 x 1 convolution, then upsampling (VPG); the last bias is ours.

    [..., h, w, F] -> [..., s h, s w, OUTPUTS] float32, s = 32 / (upsample * output_stride).
    """

    cfg: DenseNet121

    @nn.compact
    def __call__(self, features: jax.Array, train: bool = False) -> jax.Array:
        cfg = self.cfg
        hidden = nn.relu(_norm(cfg, [_piece(features)], train, "norm0"))
        hidden = nn.Dense(cfg.head, use_bias=False, dtype=compute_dtype(cfg), name="conv0")(hidden)
        hidden = nn.relu(_norm(cfg, [_piece(hidden)], train, "norm1")).astype(jnp.float32)
        maps = nn.Dense(OUTPUTS, kernel_init=OUTPUT_INIT, name="conv1")(hidden)
        return _upsample(maps, DenseNet121.STRIDE // (cfg.upsample * cfg.output_stride))


def _upsample(maps: jax.Array, factor: int) -> jax.Array:
    *batch, rows, cols, channels = maps.shape
    return jax.image.resize(maps, (*batch, factor * rows, factor * cols, channels), "bilinear")


class DenseNetCritic(nn.Module):
    """Q in three maps per frame, and the features that the actor reads.

    [B, C, C, I] -> Q [B, C / output_stride, C / output_stride, OUTPUTS] and features [B, h, w, F].
    The backward pass keeps outputs of convolutions and computes those of norms again.
    """

    cfg: DenseNet121

    @nn.compact
    def __call__(self, maps: jax.Array, train: bool = False) -> tuple[jax.Array, jax.Array]:
        policy = jax.checkpoint_policies.save_only_these_names(_SAVED)
        apply = nn.vmap(
            nn.remat(lambda trunk, inputs: trunk(inputs, train), policy=policy),
            variable_axes={"params": 0, "batch_stats": 0},
            split_rngs={"params": True},
        )
        trunk = DenseNetTrunk(self.cfg, name="trunk")
        features = apply(trunk, _trunk_inputs(self.cfg, maps))  # [T, B, h, w, f]
        features = jnp.concatenate(list(features), axis=-1)
        return DenseNetHead(self.cfg, name="head")(features, train), features


def _trunk_inputs(cfg: DenseNet121, maps: jax.Array) -> jax.Array:
    """Splits maps [B, C, C, I] into colour and, three times, the others: [T, B, z C, z C, 3]."""
    inputs = [maps[..., :3]] if cfg.colour else []
    others = range(3 * len(inputs), maps.shape[-1])
    inputs += [jnp.repeat(maps[..., i : i + 1], 3, axis=-1) for i in others]
    # The barrier keeps XLA from rotating the maps once per window.
    stacked = jax.lax.optimization_barrier(jnp.stack(inputs).astype(compute_dtype(cfg)))
    upsample = max(cfg.upsample // 2, 1)  # z: a trunk doubles its cells itself
    return jnp.repeat(jnp.repeat(stacked, upsample, axis=2), upsample, axis=3)
