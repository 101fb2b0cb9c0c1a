"""Samplers of the second study that the package does not have; each is a part of one's own.

`csac_jax.train(cfg, sampler=TruncatedGeometric())` trains with one.
"""

import dataclasses

import jax
import jax.numpy as jnp

import csac_jax as csac
from csac_jax.replay import samplers
from csac_jax.replay.ring import ReplayState


@dataclasses.dataclass(frozen=True)
class TruncatedGeometric(csac.Sampler):
    """P(age = k) ~ q^k for the ages k = 0 .. n - 1 of the n stored transitions, newest first.

    Named in arXiv:2605.10236. The scale is ours: q^n = 1 / `ratio`, so that the newest transition
    is drawn `ratio` times as often as the oldest, however many there are.
    """

    ratio: float = 10.0

    def sample(
        self, key: jax.Array, state: ReplayState, progress: jax.Array, num: int
    ) -> csac.Sample:
        """Inverts the distribution function: 1 - q^(k + 1) over 1 - q^n."""
        size = jnp.maximum(state.size, 1).astype(jnp.float32)
        uniform = jax.random.uniform(key, (num,))
        share = -jnp.log1p(-uniform * (1.0 - 1.0 / self.ratio)) / jnp.log(self.ratio)
        age = jnp.clip((share * size).astype(jnp.int32), 0, jnp.maximum(state.size - 1, 0))
        slots = (state.head - 1 - age) % state.priority.shape[0]
        return csac.Sample(slots.astype(jnp.int32), jnp.ones(num))


@dataclasses.dataclass(frozen=True)
class ReaPER(csac.Sampler):
    """P(i) ~ abs(d_i)^alpha R_i^omega, weighted as in PER; arXiv:2506.18482.

    R_t = 1 - sum_{i > t} abs(d_i) / sum_i abs(d_i), over the TD errors d of the episode: a target
    is reliable where little error follows. For an episode that goes on, the sum over it is the
    largest of any. alpha and omega are those of its authors' code.

    The ring does not say where an episode was cut off. Two transitions are of one episode if the
    second one's height map is what the first one led to.
    """

    scenes: int = 1  # transitions that a step adds
    actions: int = 5  # of the longest episode
    alpha: float = 0.3
    omega: float = 0.3
    exponent: tuple[float, float] = (0.4, 1.0)  # of the weights, from, to (Schaul et al. 2016)

    def sample(
        self, key: jax.Array, state: ReplayState, progress: jax.Array, num: int
    ) -> csac.Sample:
        errors, filled = state.priority, jnp.arange(state.priority.shape[0]) < state.size
        trust = reliability(errors, filled, *links(state, self.scenes), self.actions)
        floor = jnp.finfo(jnp.float32).tiny
        masses = jnp.where(filled, jnp.maximum(errors**self.alpha * trust**self.omega, floor), 0.0)
        slots = samplers.proportional_slots(key, masses, num)
        start, end = self.exponent
        exponent = start + (end - start) * jnp.clip(progress, 0.0, 1.0)
        drawn = jnp.maximum(masses[slots], floor)
        return csac.Sample(slots, (jnp.min(drawn) / drawn) ** exponent)


def links(state: ReplayState, scenes: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Finds for each slot [C] the slot of the scene's next transition, if that is of the same
    episode [C] bool, and if there is none yet [C] bool."""
    capacity, items = state.priority.shape[0], state.items
    slots = jnp.arange(capacity)
    after = (slots + scenes) % capacity
    is_newest = (state.head - 1 - slots) % capacity < scenes
    maps = items.next_obs.height, items.obs.height[after]
    same = jnp.all((maps[0] == maps[1]).reshape(capacity, -1), axis=1)
    return after, same & ~is_newest & ~items.terminated, is_newest & ~items.terminated


def reliability(
    errors: jax.Array,
    filled: jax.Array,
    after: jax.Array,
    goes_on: jax.Array,
    is_open: jax.Array,
    actions: int,
) -> jax.Array:
    """Computes R [C] of transitions in episodes of at most `actions`; see `ReaPER`."""
    errors = jnp.where(filled, errors, 0.0)
    until, unfinished = errors, is_open
    came_from = jnp.zeros_like(after).at[after].set(jnp.arange(after.shape[0]), unique_indices=True)
    for _ in range(actions - 1):
        until = errors + jnp.where(goes_on[came_from], until[came_from], 0.0)
    total = until  # of the whole episode, after the loop
    for _ in range(actions - 1):
        total = jnp.where(goes_on, total[after], until)
        unfinished = jnp.where(goes_on, unfinished[after], is_open)
    largest = jnp.max(jnp.where(filled, total, 0.0))
    whole = jnp.where(unfinished, largest, total)
    return jnp.where(whole > 0.0, until / jnp.where(whole > 0.0, whole, 1.0), 1.0)
