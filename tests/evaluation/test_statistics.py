"""The interquartile mean over seeds."""

import numpy as np
import pytest

from csac_jax.evaluation import statistics


def _middle(values: np.ndarray) -> np.ndarray:
    """Mean of the middle half of `values` [..., n], written out."""
    ordered = np.sort(values, axis=-1)
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)


def _draws(rng: np.random.Generator, strata: list[np.ndarray]) -> np.ndarray:
    """Mean of the strata's interquartile means [RESAMPLES], seeds drawn within each."""
    drawn = [
        _middle(one[rng.integers(0, len(one), (statistics.RESAMPLES, len(one)))]) for one in strata
    ]
    return np.mean(drawn, axis=0)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8, 16, 17])
def test_value_is_the_interquartile_mean(n: int):
    """Claim: the value is the mean without a quarter, rounded down, at either end."""
    values = np.random.default_rng(n).normal(size=n)
    result = statistics.band([values])
    assert result.n == n
    np.testing.assert_allclose(result.value, _middle(values), rtol=1e-14, atol=1e-15)


def test_band_is_the_stratified_bootstrap():
    """Claim: the band holds 95 % of the means over strata, seeds drawn within each; draws follow
    from the seed."""
    rng = np.random.default_rng(3)
    strata = [rng.normal(size=16), rng.normal(2.0, size=5)]
    result = statistics.band(strata, 7)
    wanted = np.percentile(_draws(np.random.default_rng(7), strata), [2.5, 97.5])
    np.testing.assert_allclose((result.low, result.high), wanted, rtol=1e-13)
    assert result.low < result.value < result.high
    assert result.n == 5


def test_difference_is_bootstrapped():
    """Claim: a difference is that of the values, its interval the percentile bootstrap's over the
    seeds of both."""
    rng = np.random.default_rng(5)
    ours, theirs = rng.normal(1.0, 1.0, 16), rng.normal(0.0, 2.0, 12)
    result = statistics.difference([ours], [theirs])
    assert result.n == 12
    np.testing.assert_allclose(
        result.value, statistics.band([ours]).value - statistics.band([theirs]).value
    )

    draws = np.random.default_rng(0)
    wanted = np.percentile(_draws(draws, [ours]) - _draws(draws, [theirs]), [2.5, 97.5])
    np.testing.assert_allclose((result.low, result.high), wanted, rtol=1e-13)
    with pytest.raises(ValueError, match="two values"):
        statistics.difference([ours], [theirs[:1]])
