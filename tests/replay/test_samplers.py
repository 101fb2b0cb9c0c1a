"""Drawn transitions against the laws by SciPy."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import special, stats

from csac_jax.config import BetaReplay, OppositeReplay, PrioritisedReplay, UniformReplay
from csac_jax.replay import ring, samplers
from csac_jax.replay.samplers import Sampler
from experiments import samplers as samplers_of_study
from experiments.samplers import ReaPER, TruncatedGeometric
from tests.sections import with_constants

NUM = 20_000
CAPACITY = 1000
P = 1e-3  # tests of fit: keys are fixed, so that one passes always or never

beta_slots = jax.jit(samplers.beta_slots, static_argnums=5)
proportional_slots = jax.jit(samplers.proportional_slots, static_argnums=2)
sample = jax.jit(lambda key, sampler, *args: sampler.sample(key, *args), static_argnums=(1, 4))

SAMPLERS = {
    "uniform": samplers.make(UniformReplay()),
    "prioritised": samplers.make(PrioritisedReplay()),
    "beta": samplers.make(BetaReplay()),
}


def prioritised(**constants) -> samplers.Prioritised:
    return samplers.Prioritised(with_constants(PrioritisedReplay(), **constants))


def stored(sampler: Sampler, errors, size: int | None = None) -> ring.ReplayState:
    """A ring with a slot for each of these errors, the first `size` of which are filled."""
    errors = jnp.asarray(errors, jnp.float32)
    size = errors.size if size is None else size
    slots = jnp.arange(errors.size)
    state = ring.init(sampler.init(errors.size), jnp.int32(0))
    state = sampler.update(dataclasses.replace(state, size=jnp.int32(size)), slots, errors)
    return dataclasses.replace(state, priority=jnp.where(slots < size, state.priority, 0.0))


def drawn(sampler: Sampler, state: ring.ReplayState, num: int = NUM, progress=0.0, seed: int = 0):
    """Slots [num] and weights [num]."""
    slots, weights = sample(jax.random.key(seed), sampler, state, jnp.float32(progress), num)
    return np.asarray(slots), np.asarray(weights)


def beta_law(a: float, b: float, size: int) -> np.ndarray:
    """Probabilities [size] of the ranks."""
    return np.diff(special.betainc(a, b, np.linspace(0.0, 1.0, size + 1)))


def ranks(values: np.ndarray, slots: np.ndarray) -> np.ndarray:
    """Rank of each slot's value among all, 0 = largest."""
    order = np.argsort(-values)
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    return rank[slots]


def assert_fits(cells: np.ndarray, probability: np.ndarray) -> None:
    """Checks cells by chi-square over groups of 20 expected, and by Kolmogorov in their order."""
    expected = probability / probability.sum() * cells.size
    count = np.bincount(cells, minlength=expected.size)
    assert np.all(count[expected == 0.0] == 0)
    group = np.minimum(np.cumsum(expected) // 20.0, cells.size // 20 - 1).astype(int)
    group = np.unique(group, return_inverse=True)[1]
    grouped, wanted = (np.bincount(group, weights) for weights in (count, expected))
    assert stats.chisquare(grouped, wanted).pvalue > P
    spread = cells + np.random.default_rng(0).uniform(size=cells.size)  # evenly within its cell
    edges = np.concatenate([[0.0], np.cumsum(expected)]) / cells.size
    assert stats.kstest(spread, lambda x: np.interp(x, np.arange(edges.size), edges)).pvalue > P


@pytest.mark.parametrize(
    ("a", "b"), [(1.0, 1.0), (0.5, 0.5), (1.0, 2.0), (1.0, 12.0), (2.0, 5.0), (12.0, 1.0)]
)
@pytest.mark.parametrize("size", [CAPACITY, 400])
def test_ranks_follow_the_beta_law(a, b, size):
    """Claim: rank / n ~ Beta(a, b), rank 0 the largest value, in a full or partly filled ring."""
    values = np.random.default_rng(0).normal(size=CAPACITY).astype(np.float32)
    values[size:] *= 100.0  # garbage
    slots = np.asarray(beta_slots(jax.random.key(0), jnp.array(values), jnp.int32(size), a, b, NUM))
    assert slots.min() >= 0
    assert slots.max() < size
    assert_fits(ranks(values[:size], slots), beta_law(a, b, size))


LARGE = samplers.SORTED + 8000  # capacity of a ring that is not sorted


def drawn_from_large(values: np.ndarray, size: int, a: float, b: float) -> np.ndarray:
    draw = lambda key: samplers.beta_slots(key, jnp.array(values), jnp.int32(size), a, b, 64)  # noqa: E731
    keys = jax.random.split(jax.random.key(0), 400)
    return np.asarray(jax.jit(jax.vmap(draw))(keys)).ravel()


@pytest.mark.parametrize(("a", "b"), [(0.5, 0.5), (1.0, 12.0)])
def test_large_rings_follow_the_beta_law(a, b):
    """Claim: the ranks drawn from a ring that is not sorted follow the law to 0.01 a decile, and
    only filled slots are drawn; slots of equal values are drawn alike."""
    size = LARGE - 3000
    values = np.random.default_rng(0).permutation(LARGE).astype(np.float32)
    values[size:] = LARGE
    slots = drawn_from_large(values, size, a, b)
    assert slots.max() < size
    share = np.bincount((ranks(values[:size], slots) * 10) // size, minlength=10) / slots.size
    assert_allclose(share, beta_law(a, b, 10), atol=0.01)
    equal = drawn_from_large(np.ones(LARGE, np.float32), LARGE, a, b)
    assert stats.kstest(equal / LARGE, "uniform").pvalue > P


def test_one_transition_is_drawn():
    """Claim: the only filled slot of a ring is drawn, also by a law whose draws round to 1."""
    for capacity in (8, LARGE):
        slots = beta_slots(jax.random.key(0), jnp.ones(capacity), jnp.int32(1), 1.0, 0.01, NUM)
        assert not np.any(slots)


def test_drawing_has_no_open_loop():
    """Claim: no sampler has a loop of unknown length, for which a GPU waits for the host."""
    for sampler in SAMPLERS.values():
        draw = lambda key, s=sampler: s.sample(key, stored(s, np.zeros(9)), 0.5, 64)  # noqa: E731
        text = str(jax.make_jaxpr(draw)(jax.random.key(0)))
        assert "random_bits" in text
        assert "while" not in text
        assert "random_gamma" not in text  # of a loop inside


LAWS = {
    "normal": lambda rng: rng.normal(size=CAPACITY),
    "twelve decades": lambda rng: 10.0 ** rng.uniform(-6.0, 6.0, CAPACITY),
    "one giant": lambda rng: np.where(np.arange(CAPACITY) == 617, 1e3, rng.uniform(size=CAPACITY)),
}


@pytest.mark.parametrize(
    ("law", "alpha", "size"),
    [
        ("normal", 0.0, CAPACITY),
        ("normal", 0.6, 400),
        ("twelve decades", 1.0, CAPACITY),
        ("one giant", 0.6, CAPACITY),
    ],
)
def test_prioritised_draws_follow_the_priorities(law, alpha, size):
    """Claim: P(i) = p_i^alpha / sum p^alpha with p = abs(TD error) + epsilon."""
    own = prioritised(alpha=alpha, per_epsilon=1e-6)
    errors = LAWS[law](np.random.default_rng(0)).astype(np.float32)
    slots, _ = drawn(own, stored(own, errors, size))
    assert slots.max() < size
    assert_fits(slots, (np.abs(errors[:size].astype(float)) + 1e-6) ** alpha)


@pytest.mark.parametrize("size", [2, 7, 64, 999])
def test_uniform_slots_are_uniform(size):
    """Claim: the uniform sampler draws each filled slot equally often, no other."""
    slots, _ = drawn(SAMPLERS["uniform"], stored(SAMPLERS["uniform"], jnp.ones(CAPACITY), size))
    assert slots.min() >= 0
    assert slots.max() < size
    assert_fits(slots, np.ones(size))


@pytest.mark.parametrize("capacity", [2, 9, 64, 1000])
def test_every_capacity_has_its_pyramid(capacity):
    """Claim: whatever the capacity, P(i) = m_i / sum m, also where many m_i are 0 and the others
    span six decades; without mass, slots are still slots."""
    masses = np.arange(1, capacity + 1)
    draw = lambda masses: np.asarray(proportional_slots(jax.random.key(1), masses, NUM))  # noqa: E731
    assert_fits(draw(jnp.asarray(masses, jnp.float32)), masses)
    sparse = np.where(masses % 3 > 0, 10.0 ** (masses % 7 - 3), 0.0)
    assert_fits(draw(jnp.asarray(sparse, jnp.float32)), sparse)
    nothing = draw(jnp.zeros(capacity))
    assert np.all((nothing >= 0) & (nothing < capacity))


def test_large_rings_are_drawn_evenly():
    """Claim: neighbours in a ring of 2^17 equal priorities, 2^-17 of the whole each, are drawn
    alike to 0.1 %: no slot pays for the 2^23 steps of a float32 uniform. By all 2^23 of them in the
    lower half of the way."""
    masses = jnp.ones(2**17)
    _, lower = samplers._pyramid(masses)
    below = 8 ** len(lower)  # slots that the second uniform number decides between
    assert below <= 8**3
    count = np.bincount(np.arange(2**23) * below >> 23)
    assert_allclose(count / count.mean(), 1.0, atol=1e-3)


@dataclasses.dataclass
class Action:
    primitive: jax.Array


@dataclasses.dataclass
class Tried:
    """Stored transitions, as far as the sampler of opposites reads them."""

    action: Action
    reward: jax.Array


def tried(primitive, reward, errors, size: int, head: int = 0) -> ring.ReplayState:
    """A ring of these transitions, all leaves [C], `head` the slot written next."""
    state = stored(samplers.make(OppositeReplay()), errors, size)
    items = Tried(Action(jnp.asarray(primitive, jnp.int32)), jnp.asarray(reward, jnp.float32))
    return dataclasses.replace(state, items=items, head=jnp.int32(head))


@pytest.mark.parametrize("kind", [0, 3])
def test_opposites_follow_vpgs_law(kind):
    """Claim: against a transition VPG draws one of the same primitive and the opposite outcome, by
    Beta(1, 2) over the ranks of those that fit, in a ring that is partly filled."""
    rng = np.random.default_rng(0)
    primitive, good = rng.integers(2, size=CAPACITY), rng.integers(2, size=CAPACITY)
    errors = rng.normal(size=CAPACITY).astype(np.float32)
    state = tried(primitive, 0.5 * good, errors, 700)
    newest = np.flatnonzero((2 * primitive + good == kind)[:700])[0]
    state = dataclasses.replace(state, head=jnp.int32(newest + 1))
    sampler = samplers.make(OppositeReplay())
    slots, weights = sampler.sample(jax.random.key(0), state, jnp.float32(0.0), 2)
    assert slots[0] == newest
    new = jnp.full(NUM, newest, jnp.int32)
    slots, has_match = samplers.opposite_slots(jax.random.key(1), state, new, 1.0, 2.0)
    assert np.all(has_match)
    assert_array_equal(weights, 1.0)
    fitting = np.flatnonzero(2 * primitive[:700] + good[:700] == (kind ^ 1))
    assert np.isin(slots, fitting).all()
    place = np.searchsorted(fitting, slots)
    assert_fits(ranks(np.abs(errors[fitting]), place), beta_law(1.0, 2.0, fitting.size))


@pytest.mark.parametrize(
    ("scenes", "num", "ages"),
    [(1, 2, [{0}]), (1, 6, [{0}, {1}, {2}]), (8, 4, [set(range(4)), set(range(4, 8))])],
)
def test_half_of_vpgs_batch_is_new(scenes, num, ages):
    """Claim: the first half of a batch is one transition of each equal part of the newest, which
    are those of a step or more; a batch of two has the newest itself."""
    sampler = samplers.make(OppositeReplay(), scenes)
    state = tried(np.ones(40), np.arange(40) % 2, np.ones(40), 40, head=5)
    keys = jax.random.split(jax.random.key(0), 200)
    draw = jax.vmap(lambda key: sampler.sample(key, state, jnp.float32(0.0), num).slots)
    slots = np.asarray(jax.jit(draw)(keys))
    for drawn, wanted in zip(slots.T, ages, strict=False):
        assert set((4 - drawn) % 40) == wanted
    half = num // 2
    assert np.all((slots[:, :half] + slots[:, half:]) % 2 == 1)


def test_without_an_opposite_only_the_new_counts():
    """Claim: without an opposite outcome, the draw against it has no weight; of a ring of three, or
    of one, only what is stored is drawn."""
    sampler = samplers.make(OppositeReplay())
    for size, new in ((3, [2, 1]), (1, [0, 0])):
        state = tried([1, 0, 1, 1, 1], [0.0, 0.5, 0.0, 1.0, 1.0], np.ones(5), size, head=size)
        slots, weights = sampler.sample(jax.random.key(0), state, jnp.float32(0.0), 4)
        assert_array_equal(slots, [*new, *new])
        assert_array_equal(weights, [1.0, 1.0, 0.0, 0.0])


def test_nan_is_ranked_first():
    """Claim: values that are NaN are ranked first and never let an unfilled slot in."""
    values = jnp.array([1.0, jnp.nan, 3.0, jnp.nan, 9.0, jnp.nan])
    slots = np.asarray(beta_slots(jax.random.key(0), values, jnp.int32(4), 1.0, 2.0, NUM))
    count = np.bincount(slots, minlength=6)
    assert count[4:].sum() == 0
    assert min(count[1], count[3]) > count[2] > count[0] > 0
    slots = np.asarray(beta_slots(jax.random.key(0), values, jnp.int32(4), 12.0, 1.0, NUM))
    assert slots.max() < 4


@pytest.mark.parametrize("sampler", SAMPLERS.values(), ids=SAMPLERS)
@pytest.mark.parametrize("size", [0, 1, 8])
@pytest.mark.parametrize("progress", [0.0, 1.0])
def test_slots_are_always_inside(sampler, size, progress):
    """Claim: slots are filled ones, at any fill; in an empty ring they are at least slots."""
    slots, weights = drawn(sampler, stored(sampler, jnp.ones(8), size), 500, progress)
    assert (slots.dtype, weights.dtype) == (np.int32, np.float32)
    assert slots.min() >= 0
    assert slots.max() < (size or 8)
    assert_array_equal(weights, np.ones(500))
    seldom = isinstance(sampler, samplers.Beta) and progress == 1.0  # Beta(1, 12)
    assert size == 0 or seldom or np.unique(slots).size == size


@pytest.mark.parametrize(
    ("progress", "expected"),
    [(-1.0, (0.5, 0.5)), (0.0, (0.5, 0.5)), (0.2, (0.75, 0.75)), (0.4, (1.0, 1.0)),
     (0.7, (1.0, 6.5)), (1.0, (1.0, 12.0)), (2.0, (1.0, 12.0))],
)  # fmt: skip
def test_schedule_by_hand(progress, expected):
    """Claim: (a, b) goes from (0.5, 0.5) to (1, 1) at 40 % and on to (1, 12), and stays there."""
    assert_allclose(
        samplers.beta_schedule(BetaReplay(), jnp.float32(progress)), expected, rtol=1e-5
    )


def test_sampler_follows_the_schedule():
    """Claim: the share of the worst tenth falls from 20.5 % over 10 % to none as training goes
    on."""
    sampler = SAMPLERS["beta"]
    for progress, share in ((0.0, 0.205), (0.4, 0.10), (1.0, 0.0)):
        slots, _ = drawn(sampler, stored(sampler, jnp.arange(CAPACITY, 0, -1)), progress=progress)
        assert_allclose(np.mean(slots >= 0.9 * CAPACITY), share, atol=0.012)


class Maps(NamedTuple):
    """An observation of one cell."""

    height: jax.Array


class Step(NamedTuple):
    """A transition, as far as `ReaPER` reads it."""

    obs: Maps
    next_obs: Maps
    terminated: jax.Array


@pytest.mark.parametrize(("added", "capacity"), [(30, 50), (83, 50)])
def test_ages_are_truncated_geometric(added: int, capacity: int):
    """Claim: of n stored transitions the one of age k is drawn by q^k, the newest `ratio` times as
    often as one of age n."""
    state = ring.init(jnp.zeros(capacity), jnp.int32(0))
    for number in range(added):
        state = ring.add(state, jnp.array([number]), jnp.array([True]))
    slots, weights = drawn(TruncatedGeometric(ratio=8.0), state)
    ages = added - 1 - np.asarray(state.items)[slots]
    stored = min(added, capacity)
    assert_fits(ages, 8.0 ** (-np.arange(stored) / stored))
    assert_array_equal(weights, 1.0)


def _episodes(rng: np.random.Generator, steps: int, scenes: int):
    """Plays `scenes` side by side. Returns steps of `Step`, leaves [scenes], and each one's episode
    [steps, scenes] and how it ended: 0 not, 1 terminated, 2 cut off."""
    maps = 1 + rng.permutation(2 * steps * scenes).astype(np.int32).reshape(steps, scenes, 2)
    maps[-1, :, 1] = 0  # as in slots that are not written yet
    endings = rng.choice([0, 0, 1, 2], (steps, scenes))
    episode = np.cumsum(np.pad(endings > 0, ((1, 0), (0, 0)))[:-1], axis=0)
    played, before = [], -1 - np.arange(scenes, dtype=np.int32)
    for ending, (fresh, after) in zip(endings, np.moveaxis(maps, 2, 1), strict=True):
        played.append(Step(Maps(before[:, None]), Maps(after[:, None]), ending == 1))
        before = np.where(ending > 0, fresh, after)
    return played, episode, endings


@pytest.mark.parametrize(("steps", "capacity"), [(7, 24), (20, 26)])
def test_reliability_by_episodes(steps: int, capacity: int):
    """Claim: R is 1 less the share of the episode's errors that follow; of one that goes on, the
    errors up to it over the largest sum of any. Draws follow abs(error)^alpha R^omega."""
    scenes, rng = 3, np.random.default_rng(steps)
    played, episode, endings = _episodes(rng, steps, scenes)
    reaper = ReaPER(scenes=scenes, actions=steps)
    state = ring.init(reaper.init(capacity), jax.tree.map(lambda leaf: leaf[0], played[0]))
    for step in played:
        state = ring.add(state, jax.tree.map(jnp.asarray, step), jnp.ones(scenes, bool))
    stored = min(steps * scenes, capacity)
    numbers = np.arange(steps * scenes)[-stored:]  # in the order of time
    slots, errors = numbers % capacity, rng.uniform(0.1, 2.0, steps * scenes)
    state = reaper.update(state, jnp.asarray(slots), jnp.asarray(-errors[numbers]))
    time, scene = numbers // scenes, numbers % scenes
    together = (scene[:, None] == scene) & (episode[time, scene][:, None] == episode[time, scene])
    total = together @ errors[numbers]
    until = (together & (time <= time[:, None])) @ errors[numbers]
    last = np.array([time[row].max() for row in together])
    is_open = (last == steps - 1) & (endings[last, scene] != 1)
    expected = until / np.where(is_open, total.max(), total)
    filled = np.arange(capacity) < stored
    found = samplers_of_study.reliability(
        state.priority, filled, *samplers_of_study.links(state, scenes), steps
    )
    assert_allclose(np.asarray(found)[slots], expected, rtol=1e-5)
    masses = np.zeros(capacity)
    masses[slots] = errors[numbers] ** 0.3 * expected**0.3
    cells, weights = drawn(reaper, state, progress=0.5)
    assert_fits(cells, masses)
    assert_allclose(weights, (masses[cells].min() / masses[cells]) ** 0.7, rtol=1e-4)
