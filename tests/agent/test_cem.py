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
CELLS = 2.0 * (jnp.arange(32, dtype=jnp.float32) + 0.5) / 32 - 1.0  # centres of map cells
YAWS = jnp.arange(16, dtype=jnp.float32) / 8 - 1.0


def peaks(centres, heights, widths, action: jax.Array) -> jax.Array:
    """Returns the highest of P bell curves at `action` [3]."""
    offset = box.wrap_yaw(action[None] - centres)
    return jnp.max(heights * jnp.exp(-0.5 * jnp.sum(offset**2, axis=-1) / widths**2))


def one_peak(centre, width: float) -> cem.Score:
    return functools.partial(peaks, jnp.array([centre]), jnp.ones(1), jnp.full(1, width))


def best_pixels(score: cem.Score, num: int) -> jax.Array:
    """The `num` best poses [num, 3] of the 16 x 32 x 32 map of `score`."""
    yaw, y, x = jnp.meshgrid(YAWS, CELLS, CELLS, indexing="ij")
    poses = jnp.stack([x, y, yaw], axis=-1).reshape(-1, 3)
    return poses[jax.lax.top_k(jax.vmap(score)(poses), num)[1]]


def search(cfg: CEMConfig, score: cem.Score, mean, start=NO_START, seed: int = 0, num: int = 1):
    """Results of `num` searches, leaves [num, ...]."""
    keys = jax.random.split(jax.random.key(seed), num)
    run = jax.vmap(lambda key: cem.maximise(key, cfg, score, jnp.asarray(mean), start))
    return jax.jit(run)(keys)


def search_random_maps(num_start: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns values of searches on random maps, and their best pixels', in maxima."""

    def run(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_num, key_centre, key_height, key_width, key_mean, key_search = jax.random.split(key, 6)
        present = jnp.arange(5) < jax.random.randint(key_num, (), 1, 6)
        heights = jax.random.uniform(key_height, (5,), minval=0.3, maxval=1.0)
        heights = jnp.where(present, heights, 0.0)
        widths = jax.random.uniform(key_width, (5,), minval=0.12, maxval=0.3)
        centres = jax.random.uniform(key_centre, (5, 3), minval=-1.0)
        score = functools.partial(peaks, centres, heights, widths)
        pixels = best_pixels(score, 8)
        mean = jax.random.uniform(key_mean, (3,), minval=-1.0)
        result = cem.maximise(key_search, CEMConfig(), score, mean, pixels[:num_start])
        return result.value / jnp.max(heights), score(pixels[0]) / jnp.max(heights)

    values = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(3), 200))
    return np.asarray(values[0]), np.asarray(values[1])


def test_best_pixels_lead_to_the_global_peak():
    """Claim: from the 8 best pixels of a map of one to five peaks, 98 % of searches end near the
    top of the highest, better than the best pixel; without them, from a random proposal, fewer
    than half do."""
    value, pixel = search_random_maps(8)
    assert np.mean(value >= 0.94) >= 0.98
    assert np.all(value >= pixel)
    assert np.mean(value >= 0.99) > 0.75 > 0.35 > np.mean(pixel >= 0.99)
    assert np.mean(search_random_maps(0)[0] >= 0.94) < 0.5


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


def test_start_must_fit():
    """Claim: more starting points than candidates is an error that names the setting."""
    cfg, key = CEMConfig(candidates=8), jax.random.key(0)
    with pytest.raises(ValueError, match=r"cem\.candidates"):
        cem.maximise(key, cfg, jnp.sum, jnp.zeros(3), jnp.zeros((9, 3)))


def _elites(*values: float) -> jax.Array:
    """Elites [K, 3] whose x, y and yaw are these values."""
    return jnp.tile(jnp.array(values)[:, None], 3)


def test_fit_by_hand():
    """Claim: line 12 by hand: elites 0.1, 0.2, 0.6 have mean 0.3 and deviation sqrt(0.14 / 3)."""
    elites, valid = _elites(0.1, 0.2, 0.6), jnp.ones(3, bool)
    mean, std = cem.fit(CEMConfig(), elites, valid)
    for got, want in ((mean, 0.3), (std, np.sqrt(0.14 / 3))):
        assert_allclose(got, [want] * 3, rtol=1e-6)


def test_fit_across_the_seam():
    """Claim: yaws 0.9, -0.9, -1.0 have mean 1 = -1 and the deviation of -0.1, 0.1, 0; x and y of
    these values do not."""
    mean, std = cem.fit(CEMConfig(), _elites(0.9, -0.9, -1.0), jnp.ones(3, bool))
    assert_allclose([abs(mean[2]), std[2]], [1.0, np.sqrt(0.02 / 3)], atol=1e-6)
    assert_allclose(mean[:2], [-1.0 / 3.0] * 2, atol=1e-6)


def test_fit_leaves_out_invalid_elites():
    """Claim: elites without a value do not count, and a single one has the least std."""
    elites = _elites(0.1, 0.3, 0.9)
    mean, _ = cem.fit(CEMConfig(), elites, jnp.array([True, True, False]))
    assert_allclose(mean, [0.2] * 3, atol=1e-6)
    _, std = cem.fit(CEMConfig(), elites, jnp.arange(3) < 1)
    assert_allclose(std, [CEMConfig.std_min] * 3)


def test_wrap():
    """Claim: wrapping moves by whole turns into [-1, 1), never to 1 itself, from just below the
    seam either; of a pose (x, y, yaw), yaw alone wraps."""
    below = np.nextafter(np.float32(-1.0), np.float32(-2.0))
    u = jnp.array([-3.2, -1.0, -0.5, 0.0, 0.99, 1.0, 1.5, 7.25, below])
    assert_allclose(box.wrap(u), [0.8, -1.0, -0.5, 0.0, 0.99, -1.0, -0.5, -0.75, 1.0], atol=1e-6)
    assert np.all(box.wrap(u) < 1.0)
    assert box.POSE_WRAPS.tolist() == [False, False, True]


def test_last_rounds_are_what_the_search_tries():
    """Claim: `candidates` are the samples of the last round."""
    score, start = (
        one_peak([0.3, -0.2, 0.9], 0.3),
        jnp.array([[-0.6, 0.7, -0.4], [-0.5, 0.5, -0.5]]),
    )
    results = [
        search(CEMConfig(rounds=rounds, candidates=16), score, [-0.4, 0.5, -0.7], start, seed=5)
        for rounds in (1, 2, 3)
    ]
    tried = jnp.concatenate([result.candidates for result in results])
    assert tried.shape == (3, 16, 3)
    poses = tried.reshape(-1, 3)
    values = jax.vmap(score)(poses)
    assert_allclose(results[-1].value[0], values.max(), atol=1e-6)
    assert_allclose(results[-1].action[0], poses[values.argmax()], atol=1e-6)
    away = np.linalg.norm(tried[..., :2] - np.array([[[0.3, -0.2]]]), axis=-1).mean(axis=1)
    assert away[2] < away[1] < away[0]
