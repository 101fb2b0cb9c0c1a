"""The ring and its priorities against a model in NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax.config import BetaReplay, PrioritisedReplay
from csac_jax.replay import ring, samplers
from csac_jax.replay.samplers import Sampler
from tests.sections import with_constants

CAPACITY, NUM, BATCH = 7, 3, 5
REPLAY = with_constants(PrioritisedReplay(), alpha=0.7, per_epsilon=0.05)
PRIORITISED = samplers.Prioritised(REPLAY)
PLAIN = samplers.make(BetaReplay())  # its priorities are abs(error)
EXAMPLE = {"id": jnp.int32(0), "map": jnp.zeros((2, 2), jnp.uint16)}

add, gather = jax.jit(ring.add), jax.jit(ring.gather)
sample = jax.jit(PRIORITISED.sample, static_argnums=3)


@functools.partial(jax.jit, static_argnums=3)
def set_errors(state, slots, errors, sampler: Sampler = PLAIN):
    """Stores abs(errors), or what a prioritised sampler makes of them."""
    return sampler.update(state, slots, errors)


def empty(capacity: int = CAPACITY) -> ring.ReplayState:
    return ring.init(PRIORITISED.init(capacity), EXAMPLE)


def items(ids) -> dict[str, jax.Array]:
    """Items numbered `ids`; id 0 is an unwritten slot."""
    ids = jnp.asarray(ids, jnp.int32)
    maps = jnp.broadcast_to(ids[:, None, None], (ids.size, 2, 2)).astype(jnp.uint16)
    return {"id": ids, "map": maps}


def filled_ring(ids) -> ring.ReplayState:
    state = empty()
    for i in ids:
        state = add(state, items([i]), jnp.array([True]))
    return state


ERRORS = [0.0, -0.25, 0.5, -2.0, 8.0, np.nan, np.inf, -np.inf]


class RingModel(RuleBasedStateMachine):
    """Claim: after any sequence of adds and errors, the ring holds what a list of slots would, with
    the priorities (abs(error) + epsilon)^alpha; draws are of filled slots, their weights
    (n P)^-beta over the batch's largest."""

    def __init__(self):
        super().__init__()
        self.state = empty()
        self.ids, self.priority = np.zeros(CAPACITY, int), np.zeros(CAPACITY)
        self.head = self.stored = self.last_id = 0

    @property
    def size(self):
        return min(self.stored, CAPACITY)

    @rule(valid=st.lists(st.booleans(), min_size=NUM, max_size=NUM))
    def add(self, valid):
        ids = self.last_id + 1 + np.arange(NUM)
        self.last_id += NUM
        self.state = add(self.state, items(ids), jnp.array(valid))
        largest = self.priority.max() if self.size else 1.0
        for i in ids[np.array(valid)]:
            self.ids[self.head], self.priority[self.head] = i, largest
            self.head, self.stored = (self.head + 1) % CAPACITY, self.stored + 1

    @rule(
        slots=st.lists(st.integers(0, CAPACITY - 1), min_size=BATCH, max_size=BATCH),
        errors=st.lists(st.sampled_from(ERRORS), min_size=BATCH, max_size=BATCH),
    )
    def set_errors(self, slots, errors):
        if self.size == 0:
            return
        slots = [slot % self.size for slot in slots]
        arrays = jnp.array(slots), jnp.array(errors, jnp.float32)
        self.state = set_errors(self.state, *arrays, PRIORITISED)
        finite = [(abs(e) + 0.05) ** 0.7 for e in errors if np.isfinite(e)]
        largest = max([*self.priority[slots], *finite])
        new = [(abs(e) + 0.05) ** 0.7 if np.isfinite(e) else largest for e in errors]
        for slot in set(slots):
            self.priority[slot] = max(p for s, p in zip(slots, new, strict=True) if s == slot)

    @rule(seed=st.integers(0, 2**31 - 1), progress=st.sampled_from([0.0, 0.25, 1.0]))
    def sample(self, seed, progress):
        if self.size == 0:
            return
        slots, weights = sample(jax.random.key(seed), self.state, jnp.float32(progress), BATCH)
        assert set(np.asarray(slots)) <= set(range(self.size))
        probability = self.priority[np.asarray(slots)] / self.priority.sum()
        expected = (self.size * probability) ** -(0.4 + 0.6 * progress)
        assert_allclose(weights, expected / expected.max(), rtol=1e-5)

    @invariant()
    def same(self):
        assert (int(self.state.head), int(self.state.size)) == (self.head, self.size)
        assert_array_equal(self.state.items["id"], self.ids)
        assert_array_equal(self.state.items["map"][:, 1, 0], self.ids)
        assert_allclose(self.state.priority, self.priority, rtol=1e-5)


class TestRingModel(RingModel.TestCase):
    settings = settings(max_examples=40, stateful_step_count=20, deadline=None)


@pytest.mark.slow
class TestRingModelLong(RingModel.TestCase):
    settings = settings(max_examples=10_000, stateful_step_count=8, deadline=None)


def test_errors_that_are_not_numbers():
    """Claim: NaN and infinity count as the largest that the slots of the batch have or had; huge
    errors are cut off, so that sums are finite: the ring never holds anything else."""
    state = set_errors(filled_ring([1, 2, 3]), jnp.array([0, 1, 2]), jnp.array([0.5, 4.0, 0.1]))
    for slots, errors, expected in (
        ([1, 2], [jnp.nan, 0.2], [0.5, 4.0, 0.2]),
        ([1, 2], [-jnp.inf, 6.0], [0.5, 6.0, 6.0]),
        ([0, 2], [0.2, jnp.nan], [0.2, 4.0, 0.5]),
        ([0, 2], [jnp.nan, jnp.nan], [0.5, 4.0, 0.5]),
        ([1, 0], [3e38, jnp.nan], [1e28, 1e28, 0.1]),
    ):
        updated = set_errors(state, jnp.array(slots), jnp.array(errors))
        assert_allclose(updated.priority[:3], expected)


def test_gather_returns_the_items_of_its_slots():
    """Claim: slots may repeat, and every leaf comes from the same slot."""
    batch = gather(filled_ring([1, 2, 3]), jnp.array([2, 0, 2]))
    assert batch["id"].tolist() == [3, 1, 3]
    assert batch["map"][:, 0, 0].tolist() == [3, 1, 3]


def test_too_many_items_at_once():
    """Claim: as many items as slots fill the ring; more are an error that names the setting."""
    full = ring.add(empty(), items(range(1, 8)), jnp.ones(7, bool))
    assert_array_equal(full.items["id"], range(1, 8))
    with pytest.raises(ValueError, match=r"replay\.capacity"):
        ring.add(empty(), items(range(1, 9)), jnp.ones(8, bool))


def test_donated_ring_is_not_copied():
    """Claim: with the state donated, a compiled loop of adds and updates copies no ring."""
    example = {"id": jnp.int32(0), "map": jnp.zeros((64, 64), jnp.uint16)}
    state = ring.init(PLAIN.init(512), example)
    new = {"id": jnp.arange(1, 9), "map": jnp.ones((8, 64, 64), jnp.uint16)}

    def step(state, i):
        state = ring.add(state, new, jnp.arange(8) != i)
        slots = (jnp.arange(4) * i) % state.size
        errors = ring.gather(state, slots)["id"].astype(jnp.float32)
        return ring.set_priorities(state, slots, errors), None

    run = jax.jit(lambda s: jax.lax.scan(step, s, jnp.arange(4))[0], donate_argnums=0)
    memory, replay_bytes = run.lower(state).compile().memory_analysis(), state.items["map"].nbytes
    assert memory.alias_size_in_bytes >= replay_bytes
    assert memory.temp_size_in_bytes < replay_bytes / 2
