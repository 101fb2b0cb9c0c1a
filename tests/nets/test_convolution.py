"""The convolution against NumPy, and its two gradients against JAX's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from csac_jax.nets.convolution import conv2d, convolve_by_taps

SETTINGS = [  # rows, columns, kernel, stride, dilation, padding; the first five are the net's
    (12, 16, 4, 2, 1, 1),
    (12, 16, 8, 4, 1, 2),
    (9, 8, 3, 1, 1, 1),
    (9, 8, 3, 1, 2, 2),
    (9, 12, 3, 1, 4, 4),
    (11, 8, 3, 2, 1, 1),
    (12, 13, 3, 3, 2, 0),
    (12, 14, 8, 4, 1, 2),
    (12, 16, 4, 2, 2, 1),
]


def _random(rows: int, cols: int, size: int, inputs: int = 3, outputs: int = 5) -> list[jax.Array]:
    """Maps and a kernel."""
    rng, shapes = np.random.default_rng(0), ((2, rows, cols, inputs), (size, size, inputs, outputs))
    return [jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes]


def numpy_convolution(
    maps: np.ndarray, kernel: np.ndarray, stride: int, dilation: int, padding: int
) -> np.ndarray:
    """The sum over taps, cell by cell, in float64."""
    padded = np.pad(np.asarray(maps, np.float64), ((0, 0), (padding,) * 2, (padding,) * 2, (0, 0)))
    reach = dilation * (kernel.shape[0] - 1) + 1
    rows, cols = ((length - reach) // stride + 1 for length in padded.shape[1:3])
    out = np.zeros((maps.shape[0], rows, cols, kernel.shape[3]))
    for row in range(rows):
        for col in range(cols):
            top, left = row * stride, col * stride
            seen = padded[:, top : top + reach : dilation, left : left + reach : dilation]
            out[:, row, col] = np.einsum("bijc,ijco->bo", seen, kernel)
    return out


def _plain(maps, kernel, stride, dilation, padding):
    window, axes = [(padding, padding)] * 2, ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(
        maps, kernel, (stride,) * 2, window, rhs_dilation=(dilation,) * 2, dimension_numbers=axes
    )


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
@pytest.mark.parametrize("setting", SETTINGS)
def test_forward_is_numpys(setting, backend, monkeypatch: pytest.MonkeyPatch):
    """Claim: the value is the sum over the kernel's taps, in the form for a CPU and for a GPU."""
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    maps, kernel = _random(*setting[:3])
    expected = numpy_convolution(maps, kernel, *setting[3:])
    assert_allclose(conv2d(maps, kernel, *setting[3:]), expected, atol=2e-5)


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
@pytest.mark.parametrize("channels", [(3, 5), (5, 3)])
@pytest.mark.parametrize("setting", SETTINGS)
def test_gradients_are_jaxs(setting, channels, backend, monkeypatch: pytest.MonkeyPatch):
    """Claim: the gradients in maps and kernel are those that JAX derives from its own convolution,
    also inside scan.

    In the form for a CPU and in that for a GPU, both computed here.
    """
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    maps, kernel = _random(*setting[:3], *channels)
    many = backend == "gpu" and setting[2] == 8  # 320 products, summed in another order

    def loss(conv):
        return lambda maps, kernel: jnp.sum(jnp.sin(conv(maps, kernel, *setting[3:])))

    wanted = jax.jit(jax.grad(loss(_plain), argnums=(0, 1)))(maps, kernel)
    ours = jax.grad(loss(conv2d), argnums=(0, 1))
    scan = jax.jit(lambda *args: jax.lax.scan(lambda c, _: (c, ours(*args)), 0, length=2)[1])
    for name, got, want in zip(("maps", "kernel"), scan(maps, kernel), wanted, strict=True):
        assert_allclose(got[1], want, atol=1e-4 if many else 3e-5, err_msg=name)


@pytest.mark.parametrize("dilation", [1, 2, 4])
@pytest.mark.parametrize("size", [1, 3, 5])
def test_taps_are_a_convolution(size: int, dilation: int):
    """Claim: by taps, runs under `vmap` have the values and gradients of JAX's convolution."""
    rng, padding = np.random.default_rng(0), dilation * (size // 2)
    shapes = (3, 2, 9, 12, 4), (3, size, size, 4, 5), (3, 2, 9, 12, 5)
    maps, kernels, gradients = (jnp.asarray(rng.normal(size=one), jnp.float32) for one in shapes)

    @jax.jit
    @jax.vmap
    def ours(maps, kernel, gradient):
        value, back = jax.vjp(lambda m, k: convolve_by_taps(m, k, dilation), maps, kernel)
        return value, *back(gradient)

    results = ours(maps, kernels, gradients)
    for run in range(3):
        plain = lambda m, k: _plain(m, k, 1, dilation, padding)  # noqa: E731
        value, back = jax.vjp(plain, maps[run], kernels[run])
        for got, wanted in zip(results, (value, *back(gradients[run])), strict=True):
            assert_allclose(got[run], wanted, atol=1e-4)
