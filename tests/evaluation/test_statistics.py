"""The interquartile mean over seeds."""

import functools

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

from csac_jax.evaluation import statistics


def _middle(values: np.ndarray) -> np.ndarray:
    """Mean of the middle half of `values` [..., n], by SciPy."""
    return scipy.stats.trim_mean(values, 0.25, axis=-1)


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


def _nested(rng: np.random.Generator, hosts: list[np.ndarray]) -> np.ndarray:
    """Interquartile means of the hierarchical bootstrap [RESAMPLES], one draw after the other."""
    means = []
    for _ in range(statistics.RESAMPLES):
        seeds = rng.integers(0, len(hosts), len(hosts))
        means.append([rng.choice(hosts[seed], len(hosts[seed])).mean() for seed in seeds])
    return _middle(np.array(means))


def test_bootstrap_draws_seeds_then_hosts():
    """Claim: the band draws seeds, then hosts within each drawn seed; a seed counts once, however
    many hosts it ran on."""
    rng = np.random.default_rng(2)
    hosts = [rng.normal(0.0, 2.0, n) for n in (2, 2, 2, 2, 2, 3)]
    hosts = [one - 0.9 * one.mean() for one in hosts]  # seeds hardly differ
    result = statistics.band([hosts])
    assert result.value == pytest.approx(_middle(np.array([one.mean() for one in hosts])))
    assert result.n == 6
    wanted = np.percentile(_nested(np.random.default_rng(8), hosts), [2.5, 97.5])
    np.testing.assert_allclose((result.low, result.high), wanted, atol=0.04)  # of a width of 1.3
    # The 13 runs as seeds of their own:
    flat = statistics.band([np.concatenate(hosts)])
    assert abs((flat.high - flat.low) - (result.high - result.low)) > 0.2


def test_improvement_is_mann_whitney():
    """Claim: the probability of improvement is SciPy's Mann-Whitney U over the pairs, ties by half,
    mean over strata; its band is SciPy's percentile bootstrap."""
    rng = np.random.default_rng(6)
    ours, theirs = [rng.integers(0, 5, (2, n)).astype(float) for n in (7, 9)]
    pairs = list(zip(ours, theirs, strict=True))
    result = statistics.improvement(ours, theirs)
    share = [scipy.stats.mannwhitneyu(x, y).statistic / (x.size * y.size) for x, y in pairs]
    assert result.value == pytest.approx(np.mean(share))

    def probability(x: np.ndarray, y: np.ndarray, axis: int) -> np.ndarray:
        return scipy.stats.mannwhitneyu(x, y, axis=axis, method="asymptotic").statistic / 63

    one = statistics.improvement(ours[:1], theirs[:1], seed=5)
    wanted = scipy.stats.bootstrap(
        (ours[0], theirs[0]), probability, n_resamples=10_000, method="percentile", rng=5
    ).confidence_interval
    np.testing.assert_allclose((one.low, one.high), wanted, rtol=1e-13)
    mirrored = statistics.improvement(theirs, ours)
    assert mirrored.value == pytest.approx(1.0 - result.value)
    with pytest.raises(ValueError, match="two values"):
        statistics.improvement(ours, [row[:1] for row in theirs])


def test_profile_is_the_share_above():
    """Claim: the performance profile is the share of seeds above each threshold, one less SciPy's
    empirical distribution; its band is the binomial law's."""
    values = np.random.default_rng(7).uniform(size=40)
    thresholds = np.linspace(0.05, 0.95, 19)
    found = statistics.profile([values], thresholds)
    distribution = scipy.stats.ecdf(values)
    shares = distribution.sf.evaluate(thresholds)
    assert [band.value for band in found] == pytest.approx(shares)
    law = scipy.stats.binom(40, shares)  # what draws with replacement count
    for end, share in (("low", 0.025), ("high", 0.975)):
        got = [getattr(band, end) for band in found]
        np.testing.assert_allclose(got, law.ppf(share) / 40, atol=1.01 / 40)
    two = statistics.profile([values, values + 1.0], thresholds)
    assert [band.value for band in two] == pytest.approx((shares + 1.0) / 2)
    assert statistics.profile([values[:1]], thresholds)[0].low is None


def test_area_in_closed_form():
    """Claim: the area is the integral of the curve over its length: its first value held before its
    points, linear between, cut at the end."""
    x, y = np.array([100.0, 300.0, 500.0]), np.array([0.2, 0.6, 0.6])
    assert statistics.area(x, y, 500.0) == pytest.approx((100 * 0.2 + 200 * 0.4 + 200 * 0.6) / 500)
    assert statistics.area(x, y, 200.0) == pytest.approx((100 * 0.2 + 100 * 0.3) / 200)
    assert statistics.area(x[:1], y[:1], 100.0) == pytest.approx(0.2)


def test_verdicts_by_hand():
    """Claim: Holm's correction steps down from the smallest p."""
    assert statistics.holm([0.024, 0.01, 0.02, 0.9]) == [False, True, False, False]
    assert statistics.holm([0.01, 0.012, 0.02, 0.04]) == [True] * 4


@pytest.mark.parametrize(("n", "worst"), [(1, 1), (4, 1), (5, 2), (8, 2), (12, 3)])
def test_averages_of_a_band(n: int, worst: int):
    """Claim: `band` takes another average than the interquartile mean: the mean, or that of the
    worst quarter of seeds, rounded up; the interval is of the same bootstrap."""
    values = np.random.default_rng(n).normal(size=n)
    lowest = statistics.band([values], average=statistics.worst_quartile)
    assert_allclose(lowest.value, np.mean(sorted(values)[:worst]))
    plain = statistics.band([values], average=functools.partial(np.mean, axis=-1))
    assert_allclose(plain.value, np.mean(values))
    if n > 1:
        drawn = values[np.random.default_rng(0).integers(0, n, (statistics.RESAMPLES, n))]
        lows = [np.mean(sorted(row)[:worst]) for row in drawn]
        assert_allclose(lowest[1:3], np.percentile(lows, [2.5, 97.5]))
        assert_allclose(plain[1:3], np.percentile(drawn.mean(axis=1), [2.5, 97.5]))
