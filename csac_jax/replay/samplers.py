"""Samplers of replayed transitions: uniform (CSAC), prioritised (CSAC-PER), by rank (CSAC-beta), or
of opposite outcomes (VPG); Algorithm 1 lines 15-16.
"""

import abc
import dataclasses
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from csac_jax.config import BetaReplay, OppositeReplay, PrioritisedReplay, UniformReplay
from csac_jax.replay import ring
from csac_jax.replay.ring import ReplayState

_TRIES = 8  # candidates for a gamma variate, accepted with 0.95 each: none in 1 of 10^10 draws
SORTED = 2**16  # slots of the largest ring whose ranks are exact (ours)
CANDIDATES = 2**12  # of a larger ring (ours); a power of 2, times which a float32 is exact
RADIX = 8  # nodes summed into one; few enough to be added one by one
BELOW_ONE = 1.0 - 2.0**-23  # largest uniform draw; times any float32 sum it stays below that sum


class Sample(NamedTuple):
    """Drawn transitions."""

    slots: jax.Array  # [B] int32, with repetition
    weights: jax.Array  # [B] float32, of the losses; at most 1


class Sampler(abc.ABC):
    """Sampling rule for the ring. Frozen and pure: its memory is `ReplayState.priority`."""

    @abc.abstractmethod
    def sample(self, key: jax.Array, state: ReplayState, progress: jax.Array, num: int) -> Sample:
        """Draws `num` transitions, after the share `progress` [] of all updates."""

    def init(self, capacity: int) -> jax.Array:
        """Returns priorities [C] of an empty ring; by default 0."""
        return jnp.zeros(capacity, jnp.float32)

    def update(self, state: ReplayState, slots: jax.Array, errors: jax.Array) -> ReplayState:
        """Updates the ring by TD errors [B] of `slots` [B]; by default stores abs(error)."""
        return ring.set_priorities(state, slots, jnp.abs(errors).astype(jnp.float32))

    def replace_hyperparams(self, cfg: Any) -> "Sampler":
        """Returns the sampler of a section of traced numbers; by default itself."""
        return self


def proportional_slots(key: jax.Array, masses: jax.Array, num: int) -> jax.Array:
    """Draws [num] slots with P(i) = m_i / sum m; Schaul et al. 2016, eq. 1 with m = p^alpha.

    Each draw descends a pyramid of sums, built for every batch: unlike a sum tree it cannot drift.
    The lower half has a uniform number of its own: one float32 has 2^23 values, too few for 2^17
    slots. Draws are independent, not stratified as in sec. B.2.1. `masses` [C] are 0 where nothing
    is stored: such slots are never drawn, unless all masses are 0.
    """
    node = jnp.zeros(num, jnp.int32)
    rows = jnp.arange(RADIX, dtype=jnp.int32)[:, None]
    for half, uniform in zip(_pyramid(masses), jax.random.uniform(key, (2, num)), strict=True):
        for level in half:
            stride = level.shape[0] // RADIX
            children = level.at[node[None] + stride * rows].get(mode="promise_in_bounds")
            child, uniform = _pick(children, uniform)
            node = node + stride * child
    return jnp.minimum(node, masses.shape[0] - 1)


def _pyramid(masses: jax.Array) -> tuple[list[jax.Array], list[jax.Array]]:
    """Sums `masses` [C], padded with 0, to levels [RADIX n]: their upper and lower half, top first.

    Children of node j < n are j, j + n, j + 2 n ...: sums over the first axis vectorise.
    """
    levels: list[jax.Array] = []
    while not levels or levels[0].shape[0] > RADIX:
        levels.insert(0, jnp.pad(masses, (0, -masses.shape[0] % RADIX)))
        masses = jnp.sum(levels[0].reshape(RADIX, -1), axis=0)
    middle = (len(levels) + 1) // 2
    return levels[:middle], levels[middle:]


def _pick(masses: jax.Array, uniform: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draws rows by the columns of `masses` [RADIX, num]; also returns the rest of `uniform`."""
    # Sequential sums never fall: no row without mass is picked. `cumsum` does not promise it.
    reached = list(itertools.accumulate(masses))  # RADIX of [num]
    goal = uniform * reached[-1]
    row, below, above = jnp.zeros(goal.shape, jnp.int32), jnp.zeros_like(goal), reached[-1]
    for sum_so_far in reached[:-1]:
        passed = sum_so_far <= goal
        row = row + passed.astype(jnp.int32)
        below = jnp.where(passed, sum_so_far, below)
    for sum_so_far in reached[-2::-1]:
        above = jnp.where(sum_so_far > goal, sum_so_far, above)
    left = (goal - below) / jnp.maximum(above - below, jnp.finfo(jnp.float32).tiny)
    return row, jnp.clip(left, 0.0, BELOW_ONE)


def beta_slots(
    key: jax.Array, values: jax.Array, size: jax.Array, a: ArrayLike, b: ArrayLike, num: int
) -> jax.Array:
    """Draws [num] slots whose rank by value follows Beta(a, b), rank 0 = largest; sec. 3.5, eq. 17.

    rank = floor(n x), x ~ Beta(a, b). Beta(1, 1) is uniform, Beta(1, 2) VPG's power law. Slots are
    the first `size` [] of `values` [C], slot 0 .. C - 1 if nothing is stored.
    """
    key_rank, key_ties = jax.random.split(key)
    order, count = _ranked(key_ties, values, size)
    rank = (_beta(key_rank, a, b, num) * count.astype(jnp.float32)).astype(jnp.int32)
    return order[jnp.clip(rank, 0, jnp.maximum(count - 1, 0))]


def _ranked(key: jax.Array, values: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sorts slots [C] by falling value, filled ones first; also returns their number [].

    Equal values share their ranks at random: by slot, the oldest would be preferred. Of a ring of
    more than SORTED slots, CANDIDATES random ones are sorted. That spreads a rank by up to n / (2
    sqrt(CANDIDATES)), and changes no decile's share by 0.001.
    """
    if values.shape[0] > SORTED:
        some = jax.random.randint(key, (CANDIDATES,), 0, jnp.maximum(size, 1), jnp.int32)
        order = jax.lax.sort((_descending(values[some]), some), num_keys=1)[1]
        return order, jnp.int32(CANDIDATES)
    slots = jnp.arange(values.shape[0], dtype=jnp.int32)
    ties = jax.random.bits(key, values.shape)
    filled_first = jnp.where(slots < size, _descending(values), jnp.inf)
    return jax.lax.sort((filled_first, ties, slots), num_keys=2)[2], size


def _descending(values: jax.Array) -> jax.Array:
    """Returns keys [C] that sort `values` [C] from the largest down, NaN first."""
    return -jnp.where(jnp.isnan(values), jnp.inf, values)


def opposite_slots(
    key: jax.Array, state: ReplayState, slots: jax.Array, a: ArrayLike, b: ArrayLike
) -> tuple[jax.Array, jax.Array]:
    """Draws for each of `slots` [B] one of its primitive and the opposite outcome, [B] bool if any.

    As VPG's `main.py`, "experience replay": good if its reward is positive; the rank by priority
    within the transitions that match follows Beta(a, b), rank 0 = largest.
    """
    key_rank, key_ties = jax.random.split(key)
    every = jnp.arange(state.priority.shape[0], dtype=jnp.int32)
    kind = 2 * state.items.action.primitive + (state.items.reward > 0.0).astype(jnp.int32)
    group = jnp.where(every < state.size, kind, jnp.int32(4))  # [C]
    ties = jax.random.bits(key_ties, every.shape)
    keys = (group, _descending(state.priority), ties, every)
    *_, order = jax.lax.sort(keys, num_keys=3)
    sizes = jnp.sum(group[None] == np.arange(5, dtype=np.int32)[:, None], axis=1, dtype=jnp.int32)
    wanted = jnp.bitwise_xor(group[slots], 1)  # [B]
    first, count = (jnp.cumsum(sizes) - sizes)[wanted], sizes[wanted]
    rank = (_beta(key_rank, a, b, len(slots)) * count.astype(jnp.float32)).astype(jnp.int32)
    has_match = count > 0
    matches = order[jnp.where(has_match, first + jnp.clip(rank, 0, count - 1), 0)]
    return jnp.where(has_match, matches, slots), has_match


def _beta(key: jax.Array, a: ArrayLike, b: ArrayLike, num: int) -> jax.Array:
    """Draws [num] from Beta(a, b), a and b positive, as X / (X + Y) of gamma variates.

    `jax.random.beta` draws until all are accepted: a GPU waits for the host at every turn.
    """
    shapes = jnp.stack([jnp.asarray(shape, jnp.float32) for shape in (a, b)])
    x, y = jax.vmap(_log_gamma, (0, 0, None))(jax.random.split(key), shapes, num)
    return jnp.exp(x - jnp.logaddexp(x, y))


def _log_gamma(key: jax.Array, shape: ArrayLike, num: int) -> jax.Array:
    """Draws logarithms [num] from Gamma(shape, 1); Marsaglia and Tsang 2000, ACM TOMS 26, 363."""
    key_normal, key_uniform, key_small = jax.random.split(key, 3)
    shape = jnp.asarray(shape, jnp.float32)
    d = jnp.where(shape < 1.0, shape + 1.0, shape) - 1.0 / 3.0
    normal = jax.random.normal(key_normal, (_TRIES, num))
    v = (1.0 + normal / jnp.sqrt(9.0 * d)) ** 3
    log_v = jnp.log(jnp.maximum(v, jnp.finfo(jnp.float32).tiny))
    log_uniform = jnp.log1p(-jax.random.uniform(key_uniform, (_TRIES, num)))
    accepted = (v > 0.0) & (log_uniform < 0.5 * normal**2 + d * (1.0 - v + log_v))
    first = jnp.take_along_axis(log_v, jnp.argmax(accepted, axis=0)[None], axis=0)[0]
    small = jnp.log1p(-jax.random.uniform(key_small, (num,))) / shape
    return jnp.log(d) + first + jnp.where(shape < 1.0, small, 0.0)


def beta_schedule(cfg: BetaReplay, progress: jax.Array) -> list[jax.Array]:
    """Interpolates a and b of the Beta law, each [], at the share `progress` of all updates."""
    knots = jnp.asarray([0.0, cfg.middle_at, 1.0], jnp.float32)
    laws = zip(cfg.start, cfg.middle, cfg.end, strict=True)
    return [jnp.interp(progress, knots, jnp.asarray(law, jnp.float32)) for law in laws]


@dataclasses.dataclass(frozen=True)
class _Configured(Sampler):
    cfg: Any
    scenes: int = 1  # transitions that a step adds

    def replace_hyperparams(self, cfg: Any) -> Sampler:
        return dataclasses.replace(self, cfg=cfg)


class Uniform(_Configured):
    """Sampler to which all transitions are equally likely."""

    def sample(self, key: jax.Array, state: ReplayState, progress: jax.Array, num: int) -> Sample:
        slots = jax.random.randint(key, (num,), 0, jnp.maximum(state.size, 1), jnp.int32)
        return Sample(slots, jnp.ones(num))


class Prioritised(_Configured):
    """P(i) ~ (abs(TD error) + epsilon)^alpha, w_i = (n P(i))^-beta / max_j w_j; Schaul et al. 2016.

    n and sum m cancel: w_i = (min_j m_j / m_i)^beta, with the batch's minimum, as the ring's would
    make all steps small.
    """

    def sample(self, key: jax.Array, state: ReplayState, progress: jax.Array, num: int) -> Sample:
        slots = proportional_slots(key, state.priority, num)
        start, end = self.cfg.is_beta
        exponent = start + (end - start) * jnp.clip(progress, 0.0, 1.0)
        masses = jnp.maximum(state.priority[slots], jnp.finfo(jnp.float32).tiny)  # 0 if empty
        return Sample(slots, (jnp.min(masses) / masses) ** exponent)

    def update(self, state: ReplayState, slots: jax.Array, errors: jax.Array) -> ReplayState:
        """Stores the power itself: at every draw it would be taken of the whole ring."""
        masses = (jnp.abs(errors).astype(jnp.float32) + self.cfg.per_epsilon) ** self.cfg.alpha
        return ring.set_priorities(state, slots, masses)


class Beta(_Configured):
    """rank / n ~ Beta(a, b), rank 0 the largest abs(TD error); CSAC sec. 3.5."""

    def sample(self, key: jax.Array, state: ReplayState, progress: jax.Array, num: int) -> Sample:
        a, b = beta_schedule(self.cfg, progress)
        return Sample(beta_slots(key, state.priority, state.size, a, b, num), jnp.ones(num))


class Opposite(_Configured):
    """Half of a batch is new, the other half of opposite outcomes, of weight 0 without one; VPG.

    The first half is spread over the newest transitions, at least those of one step.
    """

    def sample(self, key: jax.Array, state: ReplayState, progress: jax.Array, num: int) -> Sample:
        key_new, key_opposite = jax.random.split(key)
        num_new = num - num // 2
        among = max(self.scenes, num_new)
        part = jnp.arange(num_new, dtype=jnp.float32) + jax.random.uniform(key_new, (num_new,))
        age = jnp.minimum(jnp.floor(part * (among / num_new)).astype(jnp.int32), among - 1)
        age = jnp.clip(age, 0, jnp.maximum(state.size - 1, 0))
        new = (state.head - 1 - age) % state.priority.shape[0]
        opposite, has_match = opposite_slots(key_opposite, state, new[: num // 2], *self.cfg.law)
        weights = jnp.append(jnp.ones(num_new), has_match.astype(jnp.float32))
        return Sample(jnp.append(new, opposite), weights)


BUILDERS: dict[Any, type[_Configured]] = {
    UniformReplay: Uniform,
    PrioritisedReplay: Prioritised,
    BetaReplay: Beta,
    OppositeReplay: Opposite,
}


def make(cfg: Any, scenes: int = 1) -> Sampler:
    """Builds the sampler of a replay section, if a step adds a transition of each of `scenes`."""
    return BUILDERS[type(cfg)](cfg, scenes)
