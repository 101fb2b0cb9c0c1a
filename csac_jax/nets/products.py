"""Convolutions and pools of DenseNet-121 as matrix products and shifted maps, for `vmap`.

Under `vmap` over trunks XLA's own convolutions become grouped ones, which are slow on GPUs. XLA
also tunes each of them, which takes minutes in all (`experiments/bench`).
"""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

_STEM = 7  # pixels, side of the first convolution's kernel
_KAIMING = nn.initializers.variance_scaling(2.0, "fan_in", "normal")  # torchvision's


class TapConvolution(nn.Module):
    """Convolution without bias, zero-padded: [B, H, W, I] -> [B, H, W, features].

    The products of the taps are shifted and added, as fewer channels go out than come in.
    """

    features: int
    size: int  # cells, side of the kernel, odd
    dtype: Any

    @nn.compact
    def __call__(self, maps: jax.Array) -> jax.Array:
        ins, taps = maps.shape[-1], self.size**2
        shape = (self.size, self.size, ins, self.features)
        kernel = self.param("kernel", _KAIMING, shape).astype(self.dtype)
        matrix = jnp.transpose(kernel, (2, 0, 1, 3)).reshape(ins, taps * self.features)
        products = _times(maps, matrix)
        return products if taps == 1 else shift_and_add(products, self.size)


class Stem(nn.Module):
    """The first convolution, of stride 2: [B, H, W, I] -> [B, H / 2, W / 2, features].

    The windows of all taps are joined, as few channels come in. With `doubled` each cell of the
    maps stands for 2 x 2 pixels, which are not built: [B, H, W, I] -> [B, H, W, features].
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
            pairs = padded.reshape(side, 2, side, 2, *kernel.shape[2:])
            kernel = jnp.sum(pairs, axis=(1, 3))
        taps = windows(maps, len(kernel), 1 if self.doubled else 2)
        return _times(jnp.concatenate(taps, axis=-1), kernel.astype(self.dtype))


def _times(maps: jax.Array, matrix: jax.Array) -> jax.Array:
    """Maps [..., I] times a matrix [..., O], whose other axes have I entries together: [..., O].

    A plain product: over several axes XLA would transpose all maps for the matrix's gradient.
    """
    matrix = matrix.reshape(maps.shape[-1], -1)
    return (maps.reshape(-1, maps.shape[-1]) @ matrix).reshape(*maps.shape[:-1], -1)


def windows(maps: jax.Array, size: int, stride: int = 1) -> list[jax.Array]:
    """The window [B, H / stride, W / stride, F] of each tap of a kernel, row by row.

    Maps are [B, H, W, F], zero-padded.
    """
    rows, cols = maps.shape[1:3]
    around = (size // 2, (size - 1) // 2)
    padded = jnp.pad(maps, ((0, 0), around, around, (0, 0)))
    return [
        padded[:, i : i + rows : stride, j : j + cols : stride]
        for i in range(size)
        for j in range(size)
    ]


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def shift_and_add(products: jax.Array, size: int) -> jax.Array:
    """Sum over a kernel's taps of their shifted products: [B, H, W, size^2 F] -> [B, H, W, F].

    Sums are float32. The gradient is written out: autodiff would pad each tap's slice with zeros.
    """
    features = products.shape[-1] // size**2
    shifted = (
        window[..., k * features : (k + 1) * features].astype(jnp.float32)
        for k, window in enumerate(windows(products, size))
    )
    return functools.reduce(jnp.add, shifted).astype(products.dtype)


def _shift_and_add_forward(products: jax.Array, size: int) -> tuple[jax.Array, None]:
    return shift_and_add(products, size), None


def _shift_and_add_backward(size: int, _: None, gradient: jax.Array) -> tuple[jax.Array]:
    return (jnp.concatenate(windows(gradient, size)[::-1], axis=-1),)


shift_and_add.defvjp(_shift_and_add_forward, _shift_and_add_backward)


@jax.custom_vjp
def max_pool(maps: jax.Array) -> jax.Array:
    """Maximum over 3 x 3 cells, stride 2: [B, H, W, F], H and W even, none below 0 -> [B, H / 2,
    W / 2, F].

    The gradient goes to the first of the largest. It is written out: that of XLA's own window needs
    an operation that GPUs lack in deterministic mode (flax issue 4233).
    """
    return functools.reduce(jnp.maximum, windows(maps, 3, 2))


def _max_pool_forward(maps: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The largest, and which of the nine it is, uint8."""
    first, *others = windows(maps, 3, 2)
    largest, which = first, jnp.zeros(first.shape, jnp.uint8)
    for k, window in enumerate(others, start=1):
        which = jnp.where(window > largest, jnp.uint8(k), which)
        largest = jnp.maximum(largest, window)
    return largest, which


def _max_pool_backward(which: jax.Array, gradient: jax.Array) -> tuple[jax.Array]:
    """Cells of even row lie in the middle row of one window, those of odd row in two windows;
    columns likewise."""
    padded = [jnp.pad(leaf, ((0, 0), (0, 1), (0, 1), (0, 0))) for leaf in (which, gradient)]
    rows, cols = which.shape[1:3]

    def share_of(down: int, right: int, tap: int) -> jax.Array:
        index, share = (leaf[:, down : down + rows, right : right + cols] for leaf in padded)
        return jnp.where(index == tap, share, 0)

    # By parity: (windows further on, row of the window that the cell lies in).
    offsets = (((0, 1),), ((0, 2), (1, 0)))
    cells = [
        sum(
            share_of(down, right, 3 * i + j)
            for down, i in offsets[odd_row]
            for right, j in offsets[odd_col]
        )
        for odd_row in (0, 1)
        for odd_col in (0, 1)
    ]
    batch, channels = which.shape[0], which.shape[-1]
    grid = jnp.stack(cells, axis=-2).reshape(batch, rows, cols, 2, 2, channels)
    return (jnp.transpose(grid, (0, 1, 3, 2, 4, 5)).reshape(batch, 2 * rows, 2 * cols, channels),)


max_pool.defvjp(_max_pool_forward, _max_pool_backward)


def average_pool(maps: jax.Array) -> jax.Array:
    """Mean of 2 x 2 cells: [B, H, W, F], H and W even -> [B, H / 2, W / 2, F]."""
    return 0.25 * (
        maps[:, ::2, ::2] + maps[:, ::2, 1::2] + maps[:, 1::2, ::2] + maps[:, 1::2, 1::2]
    )
