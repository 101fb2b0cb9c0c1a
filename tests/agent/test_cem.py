"""The cross-entropy method and the box it searches."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from csac_jax.agent import box, cem
from csac_jax.config import CEMConfig
from tests.sections import with_constants

NO_START = jnp.zeros((0, 3))


def peaks(centres, heights, widths, action: jax.Array) -> jax.Array:
    """Returns the highest of P bell curves at `action` [3]."""
    offset = box.wrap_yaw(action[None] - centres)
    return jnp.max(heights * jnp.exp(-0.5 * jnp.sum(offset**2, axis=-1) / widths**2))


def one_peak(centre, width: float) -> cem.Score:
    return functools.partial(peaks, jnp.array([centre]), jnp.ones(1), jnp.full(1, width))


def search(cfg: CEMConfig, score: cem.Score, mean, start=NO_START, seed: int = 0, num: int = 1):
    """Results of `num` searches, leaves [num, ...]."""
    keys = jax.random.split(jax.random.key(seed), num)
    run = jax.vmap(lambda key: cem.maximise(key, cfg, score, jnp.asarray(mean), start))
    return jax.jit(run)(keys)


@pytest.mark.parametrize(
    ("mean_yaw", "peak_yaw"), [(0.9, -0.95), (-0.9, 0.95), (0.8, -1.0), (-0.8, -1.0)]
)
def test_yaw_is_searched_across_the_seam(mean_yaw, peak_yaw):
    """Claim: a peak on the other side of yaw = +-1 is as near as it looks on the circle."""
    cfg, score = with_constants(CEMConfig(rounds=4), std=0.15), one_peak([0.1, -0.2, peak_yaw], 0.2)
    assert np.mean(search(cfg, score, [0.1, -0.2, mean_yaw], num=100).value > 0.98) >= 0.98


def test_more_rounds_come_nearer():
    """Claim: elites' mean and std carry the search to a peak outside the first round's reach."""
    peak = [0.35, -0.35, 0.2]

    def median_miss(rounds):
        cfg = with_constants(CEMConfig(rounds=rounds), std=0.2)
        action = search(cfg, one_peak(peak, 1.0), jnp.zeros(3), num=100).action
        return np.median(np.linalg.norm(action - np.array([peak]), axis=-1))

    assert median_miss(6) < 0.02 < 0.15 < median_miss(1)


def test_best_sample_is_kept():
    """Claim: the result is the best sample ever seen, a needle among the starting points too."""
    needle = jnp.array([0.7, 0.7, 0.0])

    def score(action):
        return jnp.where(jnp.max(jnp.abs(action - needle)) < 1e-6, 1.0, -jnp.sum(action**2))

    result = search(CEMConfig(rounds=4), score, jnp.zeros(3), needle[None])
    assert_allclose(result.action[0], needle, atol=1e-6)
    assert result.value[0] == 1.0


def test_samples_stay_in_the_box():
    """Claim: no sample leaves the box: a score that pays only outside it is never paid."""
    outside = lambda u: jnp.where(jnp.any(jnp.abs(u) > 1.0) | (u[2] == 1.0), 1.0, 0.0)  # noqa: E731
    cfg = with_constants(CEMConfig(), std=2.0)
    assert search(cfg, outside, [1.5, -1.0, 0.99], jnp.full((2, 3), 1.0)).value[0] == 0.0


def test_scores_that_are_not_numbers():
    """Claim: samples whose score is NaN are neither returned nor fitted to; if all are, the action
    is the proposal, in the box, and the value -inf."""
    half = lambda action: jnp.where(action[0] > 0.0, jnp.nan, -jnp.abs(action[0] + 0.5))  # noqa: E731
    result = search(CEMConfig(rounds=4), half, jnp.full(3, 0.2))
    assert_allclose(result.action[0, 0], -0.5, atol=0.02)
    result = search(CEMConfig(), lambda action: jnp.nan * action[0], [0.2, 2.0, 1.25])
    assert_allclose(result.action[0], [0.2, 1.0, -0.75], atol=1e-6)
    assert result.value[0] == -jnp.inf


def test_search_goes_on_where_no_score_was_found():
    """Claim: a round without any value leaves mean and std as they are."""
    score = lambda action: jnp.where(jnp.max(jnp.abs(action - 0.25)) < 0.06, 1.0, -jnp.inf)  # noqa: E731
    result = search(CEMConfig(rounds=40), score, jnp.zeros(3), num=50)  # P(hit) = 0.0014 a sample
    assert np.mean(result.value == 1.0) > 0.8


@pytest.mark.parametrize(
    ("values", "valid", "mean", "yaw", "std"),
    [((0.1, 0.2, 0.6), 3, 0.3, 0.3, np.sqrt(0.14 / 3)),
     ((0.9, -0.9, -1.0), 3, -1.0 / 3.0, 1.0, np.sqrt(0.02 / 3)),  # of -0.1, 0.1, 0 from the seam
     ((0.1, 0.3, 0.9), 2, 0.2, 0.2, 0.1), ((0.1, 0.3, 0.9), 1, 0.1, 0.1, CEMConfig.std_min)],
)  # fmt: skip
def test_fit_by_hand(values, valid, mean, yaw, std):
    """Claim: line 12 by hand, of the yaw across the seam too; elites without a value do not count,
    and a single one has the least std."""
    elites = jnp.tile(jnp.array(values)[:, None], 3)
    got_mean, got_std = cem.fit(CEMConfig(), elites, jnp.arange(3) < valid)
    assert_allclose([*got_mean[:2], abs(got_mean[2])], [mean, mean, yaw], atol=1e-6)
    assert_allclose(got_std[2], std, rtol=1e-5)


def test_wrap():
    """Claim: wrapping moves by whole turns into [-1, 1), never to 1 itself, from just below the
    seam either; of a pose (x, y, yaw), yaw alone wraps."""
    below = np.nextafter(np.float32(-1.0), np.float32(-2.0))
    u = jnp.array([-3.2, -1.0, -0.5, 0.0, 0.99, 1.0, 1.5, 7.25, below])
    assert_allclose(box.wrap(u), [0.8, -1.0, -0.5, 0.0, 0.99, -1.0, -0.5, -0.75, 1.0], atol=1e-6)
    assert np.all(box.wrap(u) < 1.0)
    assert box.POSE_WRAPS.tolist() == [False, False, True]
