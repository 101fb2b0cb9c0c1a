"""Convolutions and pools of DenseNet-121 as matrix products and shifted maps.

Under `vmap` over trunks XLA's own are grouped, slow on GPUs, and take minutes to tune.
"""

import functools
import itertools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from csac_jax.nets.convolution import convolve_by_taps, windows
from csac_jax.nets.dense import pixel_shuffle

_STEM = 7  # pixels, side of the first convolution's kernel
_KAIMING = nn.initializers.variance_scaling(2.0, "fan_in", "normal")  # torchvision's


class TapConvolution(nn.Module):
    """Zero-padded convolution without bias: [B, H, W, I] -> [B, H, W, features]."""

    features: int
    size: int  # cells, side of the kernel, odd
    dtype: Any

    @nn.compact
    def __call__(self, maps: jax.Array) -> jax.Array:
        shape = (self.size, self.size, maps.shape[-1], self.features)
        kernel = self.param("kernel", _KAIMING, shape).astype(self.dtype)
        return convolve_by_taps(maps, kernel, 1)


class Stem(nn.Module):
    """The first convolution, of stride 2: [B, H, W, I] -> [B, H / 2, W / 2, features].

    With `doubled` each cell of the maps stands for 2 x 2 pixels: -> [B, H, W, features].
    """

    features: int
    doubled: bool
    dtype: Any

    @nn.compact
    def __call__(self, maps: jax.Array) -> jax.Array:
        kernel = self.param("kernel", _KAIMING, (_STEM, _STEM, maps.shape[-1], self.features))
        if self.doubled:  # taps on the same cell are summed: of a row, the first alone, then pairs
            side = (_STEM + 1) // 2
            padded = jnp.pad(kernel, ((1, 0), (1, 0), (0, 0), (0, 0)))
            kernel = padded.reshape(side, 2, side, 2, *kernel.shape[2:]).sum((1, 3))
        taps = jnp.concatenate(windows(maps, len(kernel), 1 if self.doubled else 2), axis=-1)
        # A plain product: over several axes XLA would transpose all taps for the kernel's gradient.
        rows, matrix = taps.shape[-1], kernel.astype(self.dtype)
        product = taps.reshape(-1, rows) @ matrix.reshape(rows, -1)
        return product.reshape(*taps.shape[:-1], -1)


@jax.custom_vjp
def max_pool(maps: jax.Array) -> jax.Array:
    """Computes the maximum over 3 x 3 cells, stride 2: [B, 2 H, 2 W, F] >= 0 -> [B, H, W, F].

    The gradient goes to the first of the largest. That of XLA's own window needs an operation that
    GPUs lack in deterministic mode (flax issue 4233).
    """
    return functools.reduce(jnp.maximum, windows(maps, 3, 2))


def _max_pool_forward(maps: jax.Array) -> tuple[jax.Array, jax.Array]:
    first, *others = windows(maps, 3, 2)
    largest, which = first, jnp.zeros(first.shape, jnp.uint8)
    for k, window in enumerate(others, start=1):
        which = jnp.where(window > largest, jnp.uint8(k), which)
        largest = jnp.maximum(largest, window)
    return largest, which


def _max_pool_backward(which: jax.Array, gradient: jax.Array) -> tuple[jax.Array]:
    """Returns the gradient: even rows lie in one window, odd rows in two; columns likewise."""
    padded = [jnp.pad(leaf, ((0, 0), (0, 1), (0, 1), (0, 0))) for leaf in (which, gradient)]
    rows, cols = which.shape[1:3]

    def share_of(vertical: tuple[int, int], horizontal: tuple[int, int]) -> jax.Array:
        (down, i), (right, j) = vertical, horizontal
        index, share = (leaf[:, down : down + rows, right : right + cols] for leaf in padded)
        return jnp.where(index == 3 * i + j, share, 0)

    # By parity: (windows further on, row of the window that the cell lies in).
    offsets = (((0, 1),), ((0, 2), (1, 0)))
    parities = itertools.product(offsets, repeat=2)
    cells = [sum(itertools.starmap(share_of, itertools.product(*parity))) for parity in parities]
    return (pixel_shuffle(jnp.concatenate(cells, axis=-1), 2),)


max_pool.defvjp(_max_pool_forward, _max_pool_backward)


def average_pool(maps: jax.Array) -> jax.Array:
    """Averages 2 x 2 cells: [B, 2 H, 2 W, F] -> [B, H, W, F]."""
    quarters = (maps[:, i::2, j::2] for i in (0, 1) for j in (0, 1))
    return 0.25 * functools.reduce(jnp.add, quarters)
