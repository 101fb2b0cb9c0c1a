"""Means over seeds with bootstrap bands, after Agarwal et al. (arXiv:2108.13264); no JAX.

A stratum is a task: a sequence with an item per seed, its value or an array of its values on
several hosts. The bootstrap is hierarchical: it draws seeds within each stratum, then hosts within
each drawn seed. A seed counts with the mean of its hosts, however many it has.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

RESAMPLES = 10_000

Stratum = Sequence[Any] | np.ndarray  # [seeds], of numbers or of arrays [hosts]


class Band(NamedTuple):
    """A value and its 95 % band; None for the band of a single seed."""

    value: float
    low: float | None
    high: float | None
    n: int  # seeds, the fewest of any stratum


def by_seed(seeds: Sequence[int], values: Sequence[Any] | np.ndarray) -> list[np.ndarray]:
    """Groups values [n, ...] by their seeds [n] into a stratum: an array [hosts, ...] per seed."""
    values, owners = np.asarray(values, float), np.asarray(seeds)
    return [values[owners == seed] for seed in dict.fromkeys(seeds)]


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Averages over the last axis: a quarter of the values, rounded down, is cut at either end. As
    SciPy's `trim_mean`, which takes five times as long."""
    cut = values.shape[-1] // 4
    return np.sort(values, axis=-1)[..., cut : values.shape[-1] - cut].mean(axis=-1)


def worst_quartile(values: np.ndarray) -> np.ndarray:
    """Averages the lowest quarter of the last axis, rounded up."""
    count = -(-values.shape[-1] // 4)
    return np.sort(values, axis=-1)[..., :count].mean(axis=-1)


def band(strata: Sequence[Stratum], seed: int = 0, average: Callable = interquartile_mean) -> Band:
    """Averages over strata (tasks) the `average`, [..., seeds] -> [...], over each one's seeds,
    drawn within each stratum. Unlike Agarwal et al. there is no IQM over all strata at once: of
    four cases it would leave out the hardest. Raises ValueError where a stratum is empty."""
    over = lambda *tasks: np.mean(list(map(average, tasks)), axis=0)  # noqa: E731
    return _bands(strata, over, seed)[0]


def difference(ours: Sequence[Stratum], theirs: Sequence[Stratum], seed: int = 0) -> Band:
    """Subtracts the `band` of theirs from that of ours, seeds drawn independently; strata in the
    same order. Raises ValueError where one has fewer than two seeds."""
    return _bands(_pair(ours, theirs), _gap, seed)[0]


def holm(p_values: Sequence[float], alpha: float = 0.05) -> list[bool]:
    """Tells which of several tests stay significant together (Holm 1979, step down)."""
    order = np.argsort(p_values, kind="stable")
    limits = alpha / np.arange(len(order), 0, -1)
    survives = np.empty(len(order), bool)
    survives[order] = np.logical_and.accumulate(np.asarray(p_values)[order] <= limits)
    return survives.tolist()


def improvement(ours: Sequence[Stratum], theirs: Sequence[Stratum], seed: int = 0) -> Band:
    """Estimates the probability that a seed of ours is above one of theirs in a random stratum.

    P = mean over strata of mean over pairs of (x > y) + (x = y) / 2, Agarwal et al. sec. 4.3: the
    Mann-Whitney U over the number of pairs. Raises ValueError as `difference`.
    """

    def probability(*strata: np.ndarray) -> np.ndarray:
        half = len(strata) // 2
        return np.mean(list(map(_above, strata[:half], strata[half:])), axis=0)

    return _bands(_pair(ours, theirs), probability, seed)[0]


def profile(strata: Sequence[Stratum], thresholds: np.ndarray, seed: int = 0) -> list[Band]:
    """Returns the share of the seeds above each threshold [m], mean over strata: the performance
    profile of Agarwal et al. sec. 4.2. Raises ValueError where a stratum is empty."""

    def shares(*strata: np.ndarray) -> np.ndarray:
        above = [np.mean(values[..., None] > thresholds, axis=-2) for values in strata]
        return np.mean(above, axis=0)  # [..., m]

    return _bands(strata, shares, seed)


def curves(
    points: Sequence[tuple[np.ndarray, np.ndarray]], seeds: Sequence[int]
) -> tuple[np.ndarray, list[Band]]:
    """Returns IQM and band of runs' curves, at the first one's places x [m] up to the shortest's
    end. A curve holds its first value before its points, x [n] rising and y [n], and
    is linear between them."""
    end = min(x[-1] for x, _ in points)
    places = points[0][0][points[0][0] <= end]
    values = np.stack([np.interp(places, x, y) for x, y in points])  # [runs, m]
    return places, [band([by_seed(seeds, column)]) for column in values.T]


def area(x: np.ndarray, y: np.ndarray, end: float) -> float:
    """Averages a curve, see `curves`, from 0 to `end`: the area below it over its length."""
    inner = x[(x > 0.0) & (x < end)]
    places = np.concatenate([[0.0], inner, [end]])
    return float(np.trapezoid(np.interp(places, x, y), places) / end)


def _pair(ours: Sequence[Stratum], theirs: Sequence[Stratum]) -> tuple[Stratum, ...]:
    if len(ours) != len(theirs) or min(map(len, (*ours, *theirs)), default=0) < 2:
        raise ValueError("a difference needs the same strata and two values of each")
    return (*ours, *theirs)


def _gap(*strata: np.ndarray) -> np.ndarray:
    half = len(strata) // 2
    return _mean_iqm(*strata[:half]) - _mean_iqm(*strata[half:])


def _mean_iqm(*strata: np.ndarray) -> np.ndarray:
    """Averages over strata the IQM over the last axis."""
    return np.mean(list(map(interquartile_mean, strata)), axis=0)


def _above(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the share [...] of pairs of x [..., n] and y [..., m] with x above y, ties half."""
    pairs, axes = x.shape[-1] * y.shape[-1], (-2, -1)
    x, y = x[..., :, None], y[..., None, :]
    return ((x > y).sum(axes) + 0.5 * (x == y).sum(axes)) / pairs


def _bands(strata: Sequence[Stratum], statistic: Callable, seed: int) -> list[Band]:
    """Bootstraps a statistic of strata, arrays [..., seeds] -> [...] or [..., m]; 95 % bands."""
    fewest = min(map(len, strata), default=0)
    if fewest == 0:
        raise ValueError("no values to take a mean of")
    means = [np.array([np.mean(hosts) for hosts in stratum], float) for stratum in strata]
    values = np.atleast_1d(statistic(*means)).tolist()
    if fewest == 1:
        return [Band(value, None, None, 1) for value in values]
    low, high = np.percentile(statistic(*_draws(strata, seed)), [2.5, 97.5], axis=0)
    rows = zip(values, np.atleast_1d(low).tolist(), np.atleast_1d(high).tolist(), strict=True)
    return [Band(*row, fewest) for row in rows]


def _draws(strata: Sequence[Stratum], seed: int) -> list[np.ndarray]:
    """Draws RESAMPLES times from each stratum, [RESAMPLES, seeds]."""
    rng = np.random.default_rng(seed)
    return [_draw(rng, [np.atleast_1d(hosts) for hosts in stratum]) for stratum in strata]


def _draw(rng: np.random.Generator, hosts: Sequence[np.ndarray]) -> np.ndarray:
    """Means of drawn hosts of drawn seeds, [RESAMPLES, seeds]; hosts [seeds][hosts of a seed]."""
    drawn = rng.integers(0, len(hosts), (RESAMPLES, len(hosts)))
    counts = np.array(list(map(len, hosts)))
    most = counts.max()
    table = np.stack([np.resize(np.asarray(one, float), most) for one in hosts])  # cyclic padding
    if most == 1:
        return table[drawn, 0]
    number = counts[drawn][..., None]  # [RESAMPLES, seeds, 1]
    which = (rng.random((*drawn.shape, most)) * number).astype(np.int64)
    return np.mean(table[drawn[..., None], which], axis=-1, where=np.arange(most) < number)
