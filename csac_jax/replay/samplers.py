"""Which transitions are replayed: uniform (CSAC), prioritised (CSAC-PER), by rank (CSAC-beta).

Algorithm 1 lines 15-16. A sampler of your own is any object with the methods of `Sampler`.
"""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from csac_jax.config import BetaReplay, PrioritisedReplay, UniformReplay
from csac_jax.replay import ring
from csac_jax.replay.ring import ReplayState

_TRIES = 8  # candidates for a gamma variate: none of them is accepted in 1 of 10^10 draws
RADIX = 8  # nodes summed into one; few enough to be added one by one
BELOW_ONE = (
    1.0 - 2.0**-23
)  # largest value of a uniform draw; times any float32 sum it stays below that sum


class Sample(NamedTuple):
    """What to learn from."""

    slots: jax.Array  # [B] int32, with repetition
    weights: jax.Array  # [B] float32, of the losses; at most 1


class Sampler(Protocol):
    """Draws transitions from the ring; frozen and pure, its memory is `ReplayState.priority`."""

    def init(self, capacity: int) -> jax.Array:
        """Priorities [C] of an empty ring."""

    class _Errors:
    """A sampler whose priorities are abs(TD error)."""

    def init(self, capacity: int) -> jax.Array:
        return jnp.zeros(capacity, jnp.float32)

    def update(self, state: ReplayState, slots: jax.Array, errors: jax.Array) -> ReplayState:
        return ring.set_priorities(state, slots, jnp.abs(errors).astype(jnp.float32))


@dataclasses.dataclass(frozen=True)
class Uniform(_Errors):
    """All transitions are equally likely."""

    cfg: UniformReplay

    def sample(self, key: jax.Array, state: ReplayState, progress: jax.Array, num: int) -> Sample:
        return Sample(uniform_slots(key, state.size, num), jnp.ones(num))


@dataclasses.dataclass(frozen=True)
class Prioritised(_Errors):
    """P(i) ~ (abs(TD error) + epsilon)^alpha; Schaul et al. 2016, sec. 3.3, proportional variant."""

    cfg: PrioritisedReplay

    def sample(self, key: jax.Array, state: ReplayState, progress: jax.Array, num: int) -> Sample:
        slots = proportional_slots(key, state.priority, num)
        return Sample(slots, weights(state.priority[slots], weight_exponent(self.cfg, progress)))

    def update(self, state: ReplayState, slots: jax.Array, errors: jax.Array) -> ReplayState:
        """Stores the power itself: at every draw it would be taken of the whole ring."""
        size = jnp.abs(errors).astype(jnp.float32)
        masses = (size + self.cfg.per_epsilon) ** self.cfg.alpha
        return ring.set_priorities(state, slots, masses)


@dataclasses.dataclass(frozen=True)
class Beta(_Errors):
    """rank / n ~ Beta(a, b), rank 0 the largest abs(TD error) or reward; CSAC sec. 3.5."""

    cfg: BetaReplay

    def sample(self, key: jax.Array, state: ReplayState, progress: jax.Array, num: int) -> Sample:
        a, b = beta_schedule(self.cfg, progress)
        values = state.priority if self.cfg.rank_by == "error" else state.items.reward
        return Sample(beta_slots(key, values, state.size, a, b, num), jnp.ones(num))


BUILDERS: dict[type, Callable[[Any], Sampler]] = {
    UniformReplay: Uniform,
    PrioritisedReplay: Prioritised,
    BetaReplay: Beta,
}


def make(cfg: Any) -> Sampler:
    """The sampler of a replay section."""
    return BUILDERS[type(cfg)](cfg)
