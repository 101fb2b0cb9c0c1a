"""The softmax value and the noisy actions it is estimated from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import special, stats

from csac_jax.agent import losses
from csac_jax.config import TargetConfig
from tests.sections import with_constants

NUM = 20_000
CFG = with_constants(TargetConfig(), samples=NUM)

noisy_actions = jax.jit(losses.noisy_actions, static_argnums=1)

MEANS = [(0.0, 0.0, 0.0), (0.95, -1.0, 0.98), (-0.7, 0.6, -1.0), (1.0, 1.0, 0.3)]
CONFIGS = [CFG, with_constants(CFG, std=5.0, clip=0.5), with_constants(CFG, std=1.0, clip=3.0)]


def reference(cfg: TargetConfig, mean: tuple[float, ...], dim: int):
    """SciPy's law of the noise of one dimension, and its bounds."""
    low, high = -min(cfg.clip, 1.0), min(cfg.clip, 1.0)  # yaw: half a turn at most
    if dim < 2:
        low, high = max(-cfg.clip, -1.0 - mean[dim]), min(cfg.clip, 1.0 - mean[dim])
    return stats.truncnorm(low / cfg.std, high / cfg.std, scale=cfg.std), low, high


@pytest.mark.parametrize("cfg", CONFIGS)
@pytest.mark.parametrize("mean", MEANS)
def test_noise_and_its_density_are_scipys(cfg, mean):
    """Claim: noise and log density are those of SciPy's truncated normal, at the walls and over
    half a turn too; 1 / p averages to the volume of the support."""
    actions, log_density = map(np.asarray, noisy_actions(jax.random.key(0), cfg, jnp.array(mean)))
    assert np.all(np.abs(actions) <= 1.0)
    noise = np.asarray(actions, np.float64) - np.array(mean)[None]
    noise[:, 2] = (noise[:, 2] + 1.0) % 2.0 - 1.0
    laws, expected = [reference(cfg, mean, dim) for dim in range(3)], 0.0
    for values, (law, low, high) in zip(noise.T, laws, strict=True):
        assert low - 1e-6 <= values.min()
        assert values.max() <= high + 1e-6
        assert stats.kstest(values, law.cdf).pvalue > 1e-4
        expected = expected + law.logpdf(np.clip(values, low, high))
    assert_allclose(log_density, expected, atol=1e-4)
    inverse, volume = np.exp(-log_density), np.prod([high - low for _, low, high in laws])
    assert abs(inverse.mean() - volume) <= 4 * inverse.std() / np.sqrt(NUM) + 1e-5 * volume


def test_expectation_by_hand():
    """Claim: q = 0, 1 at beta = ln 3 gives 3/4; with p = 1/2, 1/4 the weights are 2 and 12:
    12/14."""
    q, beta, half = jnp.array([0.0, 1.0]), float(np.log(3.0)), jnp.log(jnp.array([0.5, 0.25]))
    assert_allclose(losses.softmax(q, jnp.zeros(2), beta), 0.75, rtol=1e-6)
    assert_allclose(losses.softmax(q, half, beta), 12.0 / 14.0, rtol=1e-6)


def test_expectation_lies_between_mean_and_maximum():
    """Claim: beta = 0 is the mean weighted by 1 / p, large beta the maximum, in order; of a
    thousand sets of values, rounding leaves none above its largest value."""
    key_q, key_density = jax.random.split(jax.random.key(0))
    q, log_density = jax.random.normal(key_q, (50,)), jax.random.normal(key_density, (50,))
    weight = np.exp(-np.asarray(log_density, np.float64))
    betas = [0.0, 0.05, 1.0, 5.0, 20.0, 100.0, 1e5]
    values = np.array([losses.softmax(q, log_density, beta) for beta in betas])
    assert_allclose(values[0], np.sum(weight * np.asarray(q)) / weight.sum(), atol=1e-5)
    assert_allclose(values[-1], np.max(q), atol=1e-6)
    assert np.all(np.diff(values) >= 0.0)
    assert np.all(values <= np.max(q))
    many = jax.random.uniform(jax.random.key(0), (1000, 50), minval=-100.0, maxval=1.0)
    values = jax.vmap(losses.softmax, (0, None, None))(many, jnp.zeros(50), 10.0)
    assert np.all(values <= np.max(many, axis=1))


def test_expectation_does_not_overflow():
    """Claim: exponents of a million overflow nothing, up or down."""
    q = jnp.array([1e5, -1e5, 9e4])
    assert losses.softmax(q, jnp.zeros(3), 20.0) == losses.softmax(-q, jnp.zeros(3), 20.0) == 1e5


@pytest.mark.parametrize("beta", [0.0, 2.0, 10.0])
def test_expectation_is_that_of_the_continuous_softmax(beta):
    """Claim: the estimate's mean is the softmax summed over a fine grid of actions."""
    cfg = with_constants(TargetConfig(), samples=4096, std=0.2, clip=0.5)
    mean = (0.8, -0.3, 0.9)
    key_wave, key_phase, key_sample = jax.random.split(jax.random.key(5), 3)
    waves = 6.0 * jax.random.normal(key_wave, (8, 2))
    phases = jax.random.uniform(key_phase, (8,), maxval=6.0)

    def q(action):
        plane = jnp.sum(waves * action[None, :2], axis=-1)
        return jnp.mean(jnp.sin(plane + phases + jnp.pi * action[2]))

    bounds = [reference(cfg, mean, dim)[1:] for dim in range(3)]
    share = (np.arange(48) + 0.5) / 48
    axes = [m + low + (high - low) * share for m, (low, high) in zip(mean, bounds, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = jnp.asarray(grid, jnp.float32)
    values = np.asarray(jax.vmap(q)(grid))
    true = np.sum(special.softmax(beta * values) * values)

    def estimate(i):
        key = jax.random.fold_in(key_sample, i)
        actions, log_density = losses.noisy_actions(key, cfg, jnp.array(mean))
        return losses.softmax(jax.vmap(q)(actions), log_density, beta)

    estimates = np.asarray(jax.lax.map(estimate, jnp.arange(200)))
    assert abs(estimates.mean() - true) <= 4 * estimates.std() / np.sqrt(200) + 1e-4
    assert estimates.std() < 0.02
