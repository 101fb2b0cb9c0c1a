"""Which transitions are drawn."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from csac_jax.config import ReplayConfig
from csac_jax.replay import ring, samplers

NUM = 20_000
CAPACITY = 1000

beta_slots = jax.jit(samplers.beta_slots, static_argnums=5)
sample = jax.jit(samplers.sample, static_argnums=(1, 4))


def ranks(errors: np.ndarray, slots: np.ndarray) -> np.ndarray:
    """Rank of each slot's error among all, 0 = largest."""
    order = np.argsort(-np.abs(errors))
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    return rank[slots]


@pytest.mark.parametrize(("a", "b"), [(1.0, 1.0), (0.5, 0.5), (1.0, 2.0), (1.0, 12.0), (2.0, 5.0)])
@pytest.mark.parametrize("size", [CAPACITY, 400])
def test_ranks_follow_the_beta_law(a, b, size):
    """Claim: rank / n ~ Beta(a, b), rank 0 the largest abs error, in a ring that is full or partly filled."""
    errors = np.random.default_rng(0).normal(size=CAPACITY).astype(np.float32)  # signed, and garbage beyond `size`
    errors[size:] *= 100.0
    slots = np.asarray(beta_slots(jax.random.key(0), jnp.array(errors), jnp.int32(size), a, b, NUM))
    assert slots.min() >= 0
    assert slots.max() < size
    decile = ranks(errors[:size], slots) * 10 // size
    expected = np.diff(special.betainc(a, b, np.linspace(0, 1, 11))) * NUM
    assert stats.chisquare(np.bincount(decile, minlength=10), expected).pvalue > 1e-4


def test_top_decile_shares():
    """Claim: the top tenth's share is 72 % for Beta(1, 12), 19 % for (1, 2), 20.5 % for (0.5, 0.5), 10 % for (1, 1)."""
    errors = jnp.arange(CAPACITY, 0, -1).astype(jnp.float32)  # slot = rank
    for a, b, share in ((1.0, 12.0, 0.72), (1.0, 2.0, 0.19), (0.5, 0.5, 0.205), (1.0, 1.0, 0.10)):
        slots = beta_slots(jax.random.key(1), errors, jnp.int32(CAPACITY), a, b, NUM)
        np.testing.assert_allclose(np.mean(np.asarray(slots) < CAPACITY // 10), share, atol=0.012)


def test_ranked_items_are_those_with_large_errors():
    """Claim: through the ring, with items numbered from 1 and wrapped, the largest error is drawn most."""
    cfg = ReplayConfig(capacity=8, beta_start=(1.0, 12.0))
    state = ring.init(cfg, {"id": jnp.int32(0)})
    for i in range(1, 12):
        state = ring.add(state, {"id": jnp.array([i])}, jnp.array([True]))
    ids = np.asarray(state.items["id"])
    state = ring.set_errors(state, jnp.arange(8), jnp.array(np.where(ids == 7, 5.0, 0.1 * ids), jnp.float32))
    slots = sample(jax.random.key(0), cfg, state, jnp.float32(0.0), NUM)
    count = np.bincount(ring.gather(state, slots)["id"], minlength=12)
    assert count[:4].sum() == 0
    assert count.argmax() == 7
    np.testing.assert_allclose(count[7] / NUM, special.betainc(1.0, 12.0, 1 / 8), atol=0.01)


def test_uniform_slots_are_uniform():
    """Claim: the uniform sampler draws each filled slot equally often (chi-square), no other."""
    slots = np.asarray(samplers.uniform_slots(jax.random.key(0), jnp.int32(50), NUM))
    assert slots.min() >= 0
    assert slots.max() < 50
    assert stats.chisquare(np.bincount(slots)).pvalue > 1e-4


def test_equal_errors_are_drawn_equally():
    """Claim: ranks of equal errors are shared at random: no slot is preferred, whatever the Beta law."""
    keys = jax.random.split(jax.random.key(0), 2000)
    errors = jnp.ones(20)
    draw = jax.jit(jax.vmap(lambda key: samplers.beta_slots(key, errors, jnp.int32(10), 1.0, 12.0, 1)))
    count = np.bincount(np.asarray(draw(keys)).ravel(), minlength=20)
    assert count[10:].sum() == 0
    assert stats.chisquare(count[:10]).pvalue > 1e-4


def test_nan_is_ranked_first():
    """Claim: NaN errors are ranked first and never let an unfilled slot in."""
    errors = jnp.array([1.0, jnp.nan, 3.0, jnp.nan, 9.0, jnp.nan])
    slots = np.asarray(beta_slots(jax.random.key(0), errors, jnp.int32(4), 1.0, 2.0, NUM))
    count = np.bincount(slots, minlength=6)
    assert count[4:].sum() == 0
    assert min(count[1], count[3]) > count[2] > count[0] > 0
    slots = np.asarray(beta_slots(jax.random.key(0), errors, jnp.int32(4), 12.0, 1.0, NUM))
    assert slots.max() < 4


@pytest.mark.parametrize("sampler", ["uniform", "beta"])
@pytest.mark.parametrize("size", [0, 1, 2, 7, 8])
@pytest.mark.parametrize("progress", [0.0, 0.4, 1.0])
def test_slots_are_always_inside(sampler, size, progress):
    """Claim: slots are filled ones, at any fill; in an empty ring they are at least slots."""
    cfg = ReplayConfig(capacity=8, sampler=sampler)
    state = dataclasses.replace(ring.init(cfg, jnp.int32(0)), size=jnp.int32(size))
    slots = np.asarray(sample(jax.random.key(0), cfg, state, jnp.float32(progress), 500))
    assert slots.dtype == np.int32
    assert slots.min() >= 0
    assert slots.max() < (size or 8)
    assert size == 0 or progress == 1.0 or np.unique(slots).size == size  # Beta(1, 12) seldom does


@pytest.mark.parametrize(
    ("progress", "expected"),
    [(-1.0, (0.5, 0.5)), (0.0, (0.5, 0.5)), (0.2, (0.75, 0.75)), (0.4, (1.0, 1.0)), (0.7, (1.0, 6.5)),
     (1.0, (1.0, 12.0)), (2.0, (1.0, 12.0))],
)  # fmt: skip
def test_schedule_by_hand(progress, expected):
    """Claim: (a, b) goes from (0.5, 0.5) to (1, 1) at 40 % and on to (1, 12), in straight lines, and stays there."""
    np.testing.assert_allclose(samplers.beta_schedule(ReplayConfig(), jnp.float32(progress)), expected, rtol=1e-5)


def test_sampler_follows_the_schedule():
    """Claim: the share of the worst tenth falls from 20.5 % over 10 % to none as training goes on."""
    cfg = ReplayConfig(capacity=CAPACITY)
    state = dataclasses.replace(
        ring.init(cfg, jnp.int32(0)), size=jnp.int32(CAPACITY), error=jnp.arange(CAPACITY, 0, -1).astype(jnp.float32)
    )
    for progress, share in ((0.0, 0.205), (0.4, 0.10), (1.0, 0.0)):
        slots = np.asarray(sample(jax.random.key(0), cfg, state, jnp.float32(progress), NUM))
        np.testing.assert_allclose(np.mean(slots >= 0.9 * CAPACITY), share, atol=0.012)


@pytest.mark.parametrize("sampler", ["uniform", "beta"])
def test_keys_differ(sampler):
    """Claim: two keys give two draws, one key one."""
    cfg = ReplayConfig(capacity=CAPACITY, sampler=sampler)
    state = dataclasses.replace(ring.init(cfg, jnp.int32(0)), size=jnp.int32(CAPACITY))
    first, again, other = (sample(jax.random.key(i), cfg, state, jnp.float32(0.3), 32) for i in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


def test_unknown_sampler():
    """Claim: a sampler of another name is an error, not a silent default."""
    cfg = dataclasses.replace(ReplayConfig(capacity=8), sampler="rank")
    with pytest.raises(ValueError, match="rank"):
        samplers.sample(jax.random.key(0), cfg, ring.init(cfg, jnp.int32(0)), jnp.float32(0.0), 4)
