"""The dense net against a second implementation in NumPy, and how its maps follow the picture."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax.config import SmallNet
from csac_jax.nets import dense, networks
from tests.nets.test_convolution import numpy_convolution
from tests.sections import with_constants

CFG = SmallNet(growth=8, dilations=(1, 2), stem=16, head=8)
EPSILON = 1e-6  # of Flax's group norm
CHANNELS = 4
GROUP = 8  # channels per group


COARSE = dataclasses.replace(CFG, stride=4, growth=4)


@pytest.fixture(scope="module")
def params() -> dict:
    return _random(CFG)


def _random(cfg: SmallNet) -> dict:
    """Parameters that are all random: scales and biases too, which start at 1 and 0."""
    rng = np.random.default_rng(1)
    fresh = dense.Critic(cfg).init(jax.random.key(0), jnp.zeros((1, 16, 16, CHANNELS)))
    return jax.tree.map(
        lambda leaf: leaf + jnp.asarray(rng.normal(scale=0.2, size=leaf.shape), leaf.dtype), fresh
    )


def _apply(params: dict, maps: np.ndarray, cfg: SmallNet = CFG) -> np.ndarray:
    return np.asarray(jax.jit(dense.Critic(cfg).apply)(params, jnp.asarray(maps, jnp.float32))[0])


def _norm(maps: np.ndarray, weights: dict) -> np.ndarray:
    """Group norm, then the positive part."""
    batch, rows, cols, channels = maps.shape
    grouped = maps.reshape(batch, rows * cols, max(channels // GROUP, 1), -1)
    mean, variance = (f(grouped, axis=(1, 3), keepdims=True) for f in (np.mean, np.var))
    normal = ((grouped - mean) / np.sqrt(variance + EPSILON)).reshape(maps.shape)
    return np.maximum(normal * weights["scale"] + weights["bias"], 0.0)


def _numpy_net(params: dict, maps: np.ndarray, cfg: SmallNet = CFG) -> np.ndarray:
    """Computes the critic's values of each cell of the features in float64."""
    weights = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params["params"])
    trunk, head = weights["trunk"], weights["head"]
    stem = trunk["Convolution_0"]["kernel"]
    assert stem.shape[0] == 2 * cfg.stride
    features = _norm(
        numpy_convolution(maps, stem, cfg.stride, 1, cfg.stride // 2), trunk["GroupNorm_0"]
    )
    for layer, dilation in enumerate(cfg.dilations, start=1):
        kernel = trunk[f"Convolution_{layer}"]["kernel"]
        new = numpy_convolution(features, kernel, 1, dilation, dilation)
        features = np.concatenate([features, _norm(new, trunk[f"GroupNorm_{layer}"])], axis=-1)
    hidden = np.maximum(features @ head["Dense_0"]["kernel"] + head["Dense_0"]["bias"], 0.0)
    return hidden @ head["Dense_1"]["kernel"] + head["Dense_1"]["bias"]


@pytest.mark.slow
def test_half_precision_is_near(params):
    """Claim: in bfloat16 maps stay float32, within 2 % of their spread; gradients too."""
    maps = jnp.asarray(np.random.default_rng(0).normal(size=(4, 32, 32, CHANNELS)), jnp.float32)

    def run(dtype: str):
        net = dense.Critic(with_constants(CFG, dtype=dtype))
        q, pull = jax.jit(lambda params: jax.vjp(lambda p: net.apply(p, maps)[0], params))(params)
        return q, jax.tree.leaves(jax.jit(pull)(jnp.ones_like(q)))

    with jax.numpy_dtype_promotion("standard"):  # Flax's norm promotes in half precision
        (exact, gradients), (half, half_gradients) = run("float32"), run("bfloat16")
    assert half.dtype == jnp.float32
    assert all(leaf.dtype == jnp.float32 for leaf in half_gradients)
    assert 0.0 < np.abs(half - exact).mean() < 0.02 * np.std(exact)
    for a, b in zip(gradients, half_gradients, strict=True):
        assert np.linalg.norm(a - b) < 0.05 * np.linalg.norm(a) + 1e-4


@pytest.mark.parametrize(("stride", "finer"), [(2, 1), (4, 1), (2, 2), (4, 2), (4, 4)])
def test_net_is_numpys(stride: int, finer: int):
    """Claim: densely connected, group norm over the whole map. With s maps' cells per cell of the
    features, cell (s r + i, s c + j) of output o is value (i, j, o) of the features' cell (r, c);
    with s = stride the maps have the resolution of what the net sees."""
    cfg = dataclasses.replace(COARSE, stride=stride, subpixel=finer)
    maps, params = np.random.default_rng(0).normal(size=(2, 16, 24, CHANNELS)), _random(cfg)
    got, values = _apply(params, maps, cfg), _numpy_net(params, maps, cfg)  # [2, h, w, s s OUTPUTS]
    assert got.shape == (2, 16 * finer // stride, 24 * finer // stride, dense.OUTPUTS)
    for i, j, output in np.ndindex(finer, finer, dense.OUTPUTS):
        channel = values[..., (finer * i + j) * dense.OUTPUTS + output]
        assert_allclose(got[:, i::finer, j::finer, output], channel, rtol=1e-3, atol=1e-4)


def test_bare_table_is_zero():
    """Claim: bare table is 0, whatever its colour; a block's height comes out near 1."""
    height = jnp.array([[0.0, 0.001], [0.05, 0.025]])
    net_input = np.asarray(networks.make(CFG).inputs(jnp.full((2, 2, 3), 0.9), height, None))
    assert_array_equal(net_input[0, 0], 0.0)
    assert_array_equal(net_input[0, 1, :3], 0.0)
    assert_allclose(net_input[1, 0], [0.4, 0.4, 0.4, 1.0], rtol=1e-6)
