"""The interquartile mean over seeds."""

import numpy as np
import pytest
import scipy.stats

from csac_jax.evaluation import statistics


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8, 16, 17])
def test_value_is_scipys(n: int):
    """Claim: the value is SciPy's mean with a quarter cut off at either end."""
    values = np.random.default_rng(n).normal(size=n)
    result = statistics.band([values])
    assert result.n == n
    np.testing.assert_allclose(result.value, scipy.stats.trim_mean(values, 0.25), rtol=1e-12)


def test_interval_is_scipys():
    """Claim: the interval is the 95 % percentile bootstrap's over seeds, as SciPy has it, to its
    own scatter."""
    values = np.random.default_rng(3).normal(size=16)
    result = statistics.band([values])

    def middle(x, axis):
        return scipy.stats.trim_mean(x, 0.25, axis=axis)

    wanted = scipy.stats.bootstrap(
        (values,), middle, method="percentile", rng=np.random.default_rng(1)
    ).confidence_interval
    np.testing.assert_allclose((result.low, result.high), wanted, atol=0.03)
    assert result.low < result.value < result.high


def test_difference_is_scipys():
    """Claim: a difference is that of the values, its interval the percentile bootstrap's over the
    seeds of both."""
    rng = np.random.default_rng(5)
    ours, theirs = rng.normal(1.0, 1.0, 16), rng.normal(0.0, 2.0, 12)
    result = statistics.difference([ours], [theirs])
    assert result.n == 12
    np.testing.assert_allclose(
        result.value, statistics.band([ours]).value - statistics.band([theirs]).value
    )

    def apart(x, y, axis):
        return scipy.stats.trim_mean(x, 0.25, axis=axis) - scipy.stats.trim_mean(y, 0.25, axis=axis)

    wanted = scipy.stats.bootstrap(
        (ours, theirs), apart, method="percentile", rng=np.random.default_rng(1)
    )
    np.testing.assert_allclose((result.low, result.high), wanted.confidence_interval, atol=0.06)
    with pytest.raises(ValueError, match="two values"):
        statistics.difference([ours], [theirs[:1]])
