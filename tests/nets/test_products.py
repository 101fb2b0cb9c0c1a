"""Convolutions as matrix products against XLA's own, the pool against Flax's; values and
gradients."""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax.nets import products

Function = Callable[[jax.Array, jax.Array], jax.Array]  # of maps and kernel


def _random(seed: int, *shapes: tuple[int, ...]) -> list[jax.Array]:
    rng = np.random.default_rng(seed)
    return [jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes]


def _assert_same(one: Function, other: Function, inputs: Any, gradient: jax.Array) -> None:
    """Compares values and gradients of two functions."""

    def evaluate(function: Function) -> Any:
        value, back = jax.vjp(function, *inputs)
        return value, *back(gradient)

    for got, wanted in zip(*jax.jit(lambda: (evaluate(one), evaluate(other)))(), strict=True):
        assert_allclose(got, wanted, atol=1e-4)  # sums of up to 192 products of numbers near 1


@pytest.mark.parametrize(
    ("module", "stride", "size"),
    [
        (products.TapConvolution(5, 1, jnp.float32), 1, 1),
        (products.TapConvolution(5, 3, jnp.float32), 1, 3),
        (products.Stem(5, False, jnp.float32), 2, 7),
    ],
)
def test_products_are_convolutions(module: nn.Module, stride: int, size: int):
    """Claim: value and gradients are those of a convolution with zeros around."""
    shapes = (2, 8, 12, 4), (size, size, 4, 5), (2, 8 // stride, 12 // stride, 5)
    maps, kernel, gradient = _random(0, *shapes)

    def ours(maps: jax.Array, kernel: jax.Array) -> jax.Array:
        return module.apply({"params": {"kernel": kernel}}, maps)

    def plain(maps: jax.Array, kernel: jax.Array) -> jax.Array:
        pad = [(size // 2, size // 2)] * 2
        return jax.lax.conv_general_dilated(
            maps, kernel, (stride, stride), pad, dimension_numbers=("NHWC", "HWIO", "NHWC")
        )

    _assert_same(ours, plain, (maps, kernel), gradient)


def _flax_pool(maps: jax.Array) -> jax.Array:
    return nn.max_pool(maps, (3, 3), (2, 2), ((1, 1), (1, 1)))


def test_max_pool_is_flaxs():
    """Claim: value and gradient are those of a max pool, without `select_and_scatter`."""
    maps, weight = _random(0, (2, 8, 12, 3), (2, 4, 6, 3))
    maps = jnp.maximum(maps, 0.0)
    assert_array_equal(products.max_pool(maps), _flax_pool(maps))
    losses = [lambda maps, f=f: jnp.sum(weight * f(maps)) for f in (products.max_pool, _flax_pool)]
    got, wanted = (jax.jit(jax.grad(loss))(maps) for loss in losses)
    # At 0 several cells are the largest; the ReLU before takes the gradient away there.
    assert_allclose(jnp.where(maps > 0.0, got, 0.0), jnp.where(maps > 0.0, wanted, 0.0), atol=1e-6)
    named = ["select_and_scatter" in str(jax.make_jaxpr(jax.grad(loss))(maps)) for loss in losses]
    assert named == [False, True]
