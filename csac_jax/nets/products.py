"""Convolutions and pools of DenseNet-121 as matrix products and shifted maps, which may stand side
by side.

XLA's own convolutions would be grouped ones there, of trunks with weights of their own, and those
are slow on GPUs; and XLA tries out what is fastest for each, which takes minutes in all
(`experiments/bench`).
"""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

_STEM = 7  # pixels, side of the first convolution's kernel
_KAIMING = nn.initializers.variance_scaling(2.0, "fan_in", "normal")  # torchvision's


class Convolution(nn.Module):
    """Convolution without bias, zeros around: [B, H, W, I] -> [B, H, W, features].

    What each tap makes of each cell is shifted and added, since fewer channels go out than come in.
    """

    features: int
    size: int  # cells, side of the kernel, odd
    dtype: Any

    @nn.compact
    def __call__(self, maps: jax.Array) -> jax.Array:
        ins, taps = maps.shape[-1], self.size**2
        kernel = self.param("kernel", _KAIMING, (self.size, self.size, ins, self.features)).astype(
            self.dtype
        )
        products = _times(
            maps, jnp.transpose(kernel, (2, 0, 1, 3)).reshape(ins, taps * self.features)
        )
        return products if taps == 1 else shift_and_add(products, self.size)


class Stem(nn.Module):
    """The first convolution, at every second pixel: [B, H, W, I] -> [B, H / 2, W / 2, features].

    Few channels come in, so what all taps see of a cell is laid side by side. With `doubled` each
    cell of the maps stands for 2 x 2 pixels, which need not be there: [B, H, W, I] -> [B, H, W,
    features].
    """

    features: int
    doubled: bool
    dtype: Any

    @nn.compact
    def __call__(self, maps: jax.Array) -> jax.Array:
        kernel = self.param("kernel", _KAIMING, (_STEM, _STEM, maps.shape[-1], self.features))
        if (
            self.doubled
        ):  # of the pixels around one, the first is alone in its cell, the others are two in each
            side = (_STEM + 1) // 2
            pairs = jnp.pad(kernel, ((1, 0), (1, 0), (0, 0), (0, 0))).reshape(
                side, 2, side, 2, *kernel.shape[2:]
            )
            kernel = jnp.sum(pairs, axis=(1, 3))
        seen = windows(maps, len(kernel), 1 if self.doubled else 2)
        return _times(jnp.concatenate(seen, axis=-1), kernel.astype(self.dtype))


def _times(maps: jax.Array, matrix: jax.Array) -> jax.Array:
    """Maps [..., I] times a matrix [..., O], whose other axes have I entries together: [..., O].

    As a product of two axes: over several, XLA would turn all maps about for the gradient for the
    matrix.
    """
    matrix = matrix.reshape(maps.shape[-1], -1)
    return (maps.reshape(-1, maps.shape[-1]) @ matrix).reshape(*maps.shape[:-1], -1)


def windows(maps: jax.Array, size: int, stride: int = 1) -> list[jax.Array]:
    """What each tap of a kernel sees of maps [B, H, W, F], zeros around: [B, H / stride, W /
    stride, F], row by row."""
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
    """Sum over the taps of a kernel of what each makes of the cell it sees: [B, H, W, size^2 F] ->
    [B, H, W, F].

    Sums are float32's. The gradient is written out: that of a slice would be a map of zeros around
    it, for each tap.
    """
    features = products.shape[-1] // size**2
    seen = windows(products, size)
    each = (
        one[..., k * features : (k + 1) * features].astype(jnp.float32)
        for k, one in enumerate(seen)
    )
    return functools.reduce(jnp.add, each).astype(products.dtype)


def _shift_and_add_forward(products: jax.Array, size: int) -> tuple[jax.Array, None]:
    return shift_and_add(products, size), None


def _shift_and_add_backward(size: int, _: None, gradient: jax.Array) -> tuple[jax.Array]:
    return (jnp.concatenate(windows(gradient, size)[::-1], axis=-1),)


shift_and_add.defvjp(_shift_and_add_forward, _shift_and_add_backward)


@jax.custom_vjp
def max_pool(maps: jax.Array) -> jax.Array:
    """Largest of 3 x 3 cells, every second one: [B, H, W, F], H and W even, none below 0 -> [B, H /
    2, W / 2, F].

    The gradient goes to the first of the largest. It is written out, since that of XLA's own window
    needs an operation that GPUs lack when results are to repeat bit for bit (flax issue 4233).
    """
    return functools.reduce(jnp.maximum, windows(maps, 3, 2))


def _max_pool_forward(maps: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The largest, and which of the nine it is, uint8."""
    seen = windows(maps, 3, 2)
    largest, which = seen[0], jnp.zeros(seen[0].shape, jnp.uint8)
    for k, one in enumerate(seen[1:], start=1):
        which = jnp.where(one > largest, jnp.uint8(k), which)
        largest = jnp.maximum(largest, one)
    return largest, which


def _max_pool_backward(which: jax.Array, gradient: jax.Array) -> tuple[jax.Array]:
    """A cell of even row was seen by the middle row of one window alone, one of odd row by two;
    columns likewise."""
    padded = [jnp.pad(leaf, ((0, 0), (0, 1), (0, 1), (0, 0))) for leaf in (which, gradient)]
    rows, cols = which.shape[1:3]

    def seen_by(down: int, right: int, tap: int) -> jax.Array:
        index, share = (leaf[:, down : down + rows, right : right + cols] for leaf in padded)
        return jnp.where(index == tap, share, 0)

    offsets = (
        ((0, 1),),
        ((0, 2), (1, 0)),
    )  # (window further on, its row that sees the cell), by parity
    cells = [
        sum(
            seen_by(down, right, 3 * i + j)
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
