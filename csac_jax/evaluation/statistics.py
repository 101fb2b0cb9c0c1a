"""What several seeds say together: interquartile mean and stratified bootstrap (Agarwal et al.,
arXiv:2108.13264).

NumPy only.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

RESAMPLES = 10_000
CUT = 0.25  # share of the values left out at either end


class Band(NamedTuple):
    """A value and its 95 % band; no band (None) where one seed is all there is."""

    value: float
    low: float | None
    high: float | None
    n: int  # seeds, the fewest of any stratum


def iqm(values: np.ndarray) -> np.ndarray:
    """Mean of the middle half of `values` [..., n]: a quarter of them, rounded down, is left out at
    either end."""
    ordered = np.sort(values, axis=-1)
    cut = int(CUT * ordered.shape[-1])
    return ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)


def band(strata: Sequence[np.ndarray], seed: int = 0) -> Band:
    """Mean over strata (tasks) of the IQM over seeds in each [seeds]; seeds are drawn anew in each
    for the band.

    Unlike Agarwal et al., no IQM over all strata at once: of four cases that would leave out the
    hardest. Raises ValueError where a stratum has no value.
    """
    every = [np.asarray(stratum, float) for stratum in strata]
    fewest = min((len(stratum) for stratum in every), default=0)
    if fewest == 0:
        raise ValueError("no values to take a mean of")
    value = float(np.mean([iqm(stratum) for stratum in every]))
    if fewest < 2:
        return Band(value, None, None, fewest)
    rng = np.random.default_rng(seed)
    drawn = [
        iqm(stratum[rng.integers(0, len(stratum), (RESAMPLES, len(stratum)))]) for stratum in every
    ]
    low, high = np.percentile(np.mean(drawn, axis=0), [2.5, 97.5])
    return Band(value, float(low), float(high), fewest)


def difference(ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray], seed: int = 0) -> Band:
    """`band` of ours less `band` of theirs, whose seeds are drawn independently of ours; strata in
    the same order.

    Raises ValueError where a stratum has fewer than two values: one seed tells nothing of the
    spread.
    """
    if min((len(stratum) for stratum in (*ours, *theirs)), default=0) < 2:
        raise ValueError("a difference needs two values of each")
    rng = np.random.default_rng(seed)

    def drawn(strata: Sequence[np.ndarray]) -> np.ndarray:
        draws = (
            np.asarray(one, float)[rng.integers(0, len(one), (RESAMPLES, len(one)))]
            for one in strata
        )
        return np.mean([iqm(each) for each in draws], axis=0)

    low, high = np.percentile(drawn(ours) - drawn(theirs), [2.5, 97.5])
    value = band(ours).value - band(theirs).value
    return Band(value, float(low), float(high), min(len(stratum) for stratum in (*ours, *theirs)))


def curves(points: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, list[Band]]:
    """IQM and band of curves, one a seed, at the places x that the first one has, up to where the
    shortest ends.

    Args: points, for each seed x [n], rising, and y [n]; between its points a curve is a straight
    line. Returns: x [m] and a band for each. A seed whose curve begins later holds its first value
    until then.
    """
    end = min(x[-1] for x, _ in points)
    places = points[0][0][points[0][0] <= end]
    values = np.stack([np.interp(places, x, y) for x, y in points])  # [seeds, m]
    return places, [band([column]) for column in values.T]
