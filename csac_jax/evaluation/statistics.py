"""Means over seeds with bootstrap bands, after Agarwal et al. (arXiv:2108.13264); no JAX."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats

RESAMPLES = 10_000


class Band(NamedTuple):
    """A value and its 95 % band; None for the band of a single seed."""

    value: float
    low: float | None
    high: float | None
    n: int  # seeds, the fewest of any stratum


def band(strata: Sequence[np.ndarray], seed: int = 0) -> Band:
    """Mean over strata (tasks) of the IQM over each one's seeds [seeds], drawn within each stratum.

    Unlike Agarwal et al. there is no IQM over all strata at once: of four cases it would leave out
    the hardest. Raises ValueError where a stratum is empty.
    """
    fewest = min(map(len, strata), default=0)
    if fewest == 0:
        raise ValueError("no values to take a mean of")
    if fewest == 1:
        return Band(float(_mean_iqm(*strata)), None, None, 1)
    return _bootstrapped(strata, _mean_iqm, seed)


def difference(ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray], seed: int = 0) -> Band:
    """`band` of ours less `band` of theirs, seeds drawn independently; strata in the same order.
    Raises ValueError where one has fewer than two values."""
    if min(map(len, (*ours, *theirs)), default=0) < 2:
        raise ValueError("a difference needs two values of each")

    def gap(*strata: np.ndarray, axis: int = -1) -> np.ndarray:
        return _mean_iqm(*strata[: len(ours)]) - _mean_iqm(*strata[len(ours) :])

    return _bootstrapped((*ours, *theirs), gap, seed)


def _mean_iqm(*strata: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean over strata of the IQM over the last axis, which SciPy passes by name: without a quarter
    of the values, rounded down, at either end."""
    means = [scipy.stats.trim_mean(np.asarray(values, float), 0.25, axis=-1) for values in strata]
    return np.mean(means, axis=0)


def _bootstrapped(strata: Sequence[np.ndarray], statistic: Callable, seed: int) -> Band:
    """The statistic of strata [seeds], with its 95 % percentile bootstrap band."""
    samples = [np.asarray(stratum, float) for stratum in strata]
    low, high = scipy.stats.bootstrap(
        samples, statistic, n_resamples=RESAMPLES, method="percentile", rng=seed
    ).confidence_interval
    return Band(float(statistic(*samples)), float(low), float(high), min(map(len, samples)))


def curves(points: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, list[Band]]:
    """IQM and band of curves, one per seed, at the first one's places x [m] up to the shortest's
    end. A curve holds its first value before its points, x [n] rising and y [n], and is linear
    between them."""
    end = min(x[-1] for x, _ in points)
    places = points[0][0][points[0][0] <= end]
    values = np.stack([np.interp(places, x, y) for x, y in points])  # [seeds, m]
    return places, [band([column]) for column in values.T]
