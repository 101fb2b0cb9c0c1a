"""Speed of the replay, as JSON: `csac-jax bench replay [--smallest N] [--largest N]`, capacities
2^SMALLEST (12) to 2^LARGEST (20).

One step draws 64 transitions from a full ring with their weights, gathers them and replaces their
priorities. The samplers of this package stand beside flashbax's prioritised item buffer, with the
same items and exponents, and `beta_sorted`, which sorts a ring of any size. Each is a compiled loop
of steps, its state donated; calls of all take turns, so that what else the machine does hits all
alike, and the median is reported. An item is 21 numbers: the loops time the sampling, not the
copying of images.
"""

import itertools
import statistics
from collections.abc import Callable
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp

from csac_jax.cli import failures
from csac_jax.config import BetaReplay, PrioritisedReplay, ReplayConfig, UniformReplay
from csac_jax.errors import SettingsError
from csac_jax.replay import ring, samplers
from experiments.bench._options import emit, read
from experiments.bench._timing import seconds

BATCH = 64
REPEATS = 31
STEPS = 25  # in one call: short, so that most calls are not interrupted
SORTED = 2**15  # items that one call of a sampler that sorts the ring sorts at least
ITEM = {
    "obs": jnp.zeros(16),
    "action": jnp.zeros(3),
    "reward": jnp.zeros(()),
    "terminated": jnp.zeros((), bool),
}

Step = Callable[[Any, jax.Array], Any]


def _new_errors(slots: jax.Array, items: Any, weights: jax.Array) -> jax.Array:
    """Computes errors [B] that need everything that was drawn, in place of a learner."""
    noise = jnp.sin(slots.astype(jnp.float32)) + 0.5 * jnp.cos(3.0 * slots.astype(jnp.float32))
    return noise + 0.0 * (weights + items["reward"] + jnp.sum(items["obs"], axis=-1))


def _ours(cfg: ReplayConfig) -> tuple[Any, Step]:
    sampler, capacity = samplers.make(cfg), cfg.capacity
    state = ring.init(sampler.init(capacity), ITEM).replace(size=jnp.int32(capacity))
    errors = jnp.exp(jax.random.normal(jax.random.key(0), (capacity,)))
    state = sampler.update(state, jnp.arange(capacity), errors)

    def step(state: ring.ReplayState, key: jax.Array) -> ring.ReplayState:
        slots, weights = sampler.sample(key, state, jnp.float32(0.5), BATCH)
        errors = _new_errors(slots, ring.gather(state, slots), weights)
        return sampler.update(state, slots, errors)

    return state, step


def _flashbax(capacity: int) -> tuple[Any, Step]:
    """Makes flashbax's buffer and its step, with weights and the floor."""
    import flashbax

    cfg = PrioritisedReplay()
    exponent = 0.5 * sum(cfg.is_beta)
    buffer = flashbax.make_prioritised_item_buffer(
        max_length=capacity,
        min_length=1,
        sample_batch_size=BATCH,
        add_batches=True,
        priority_exponent=cfg.alpha,
        device=jax.default_backend(),
    )
    items = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), ITEM)
    state = buffer.add(buffer.init(ITEM), items)
    errors = jnp.exp(jax.random.normal(jax.random.key(0), (capacity,)))
    state = buffer.set_priorities(state, jnp.arange(capacity), errors + cfg.per_epsilon)

    def step(state: Any, key: jax.Array) -> Any:
        drawn = buffer.sample(state, key)
        weights = (capacity * drawn.probabilities) ** -exponent
        errors = _new_errors(drawn.indices, drawn.experience, weights / jnp.max(weights))
        return buffer.set_priorities(state, drawn.indices, jnp.abs(errors) + cfg.per_epsilon)

    return state, step


def _loop(state: Any, step: Step, steps: int) -> Callable[[], Any]:
    """Returns a function that runs `steps` more steps."""

    def loop(state: Any, key: jax.Array) -> Any:
        return jax.lax.scan(
            lambda s, i: (step(s, jax.random.fold_in(key, i)), None), state, jnp.arange(steps)
        )[0]

    compiled = jax.jit(loop, donate_argnums=0)
    current, numbers = jax.tree.map(jnp.copy, state), itertools.count()

    def call() -> Any:
        nonlocal current
        current = compiled(current, jax.random.key(next(numbers)))
        return current

    return call


def measure(capacity: int) -> dict[str, Any]:
    """Measures median seconds per step for one capacity."""
    sorting = max(SORTED // capacity, 1)
    steps = dict.fromkeys(("uniform", "prioritised", "beta", "flashbax"), STEPS)
    steps |= {"beta_sorted": sorting}
    if capacity <= samplers.SORTED:
        steps["beta"] = sorting
    loops = {
        "uniform": _ours(UniformReplay(capacity=capacity)),
        "prioritised": _ours(PrioritisedReplay(capacity=capacity)),
        "beta": _ours(BetaReplay(capacity=capacity)),
        "flashbax": _flashbax(capacity),
    }
    calls = {name: _loop(*loop, steps[name]) for name, loop in loops.items()}
    calls["beta_sorted"] = _loop(*loops["beta"], sorting)
    with mock.patch.object(samplers, "SORTED", capacity):  # read as the program is traced
        jax.block_until_ready(calls["beta_sorted"]())
    times = seconds(calls, REPEATS)
    median = {name: statistics.median(values) / steps[name] for name, values in times.items()}
    return {
        "capacity": capacity,
        "median_seconds": median,
        "least_seconds": {name: min(values) / steps[name] for name, values in times.items()},
        "flashbax_over_prioritised": median["flashbax"] / median["prioritised"],
    }


def main(arguments: list[str]) -> None:
    """Prints the result. Raises SettingsError for rings that are smaller than a batch."""
    exponents = read("replay", arguments, smallest=12, largest=20)
    smallest, largest = exponents.values()
    if not BATCH <= 2**smallest <= 2**largest <= 2**24:
        raise SettingsError("bench replay: exponents must lie in 6 .. 24, the smaller first")
    failures.check_extra("bench replay", "flashbax", "bench")
    result = {
        "batch": BATCH,
        "item": {name: f"{leaf.dtype}{list(leaf.shape)}" for name, leaf in ITEM.items()},
        "repeats": REPEATS,
        "capacities": [measure(2**exponent) for exponent in range(smallest, largest + 1)],
    }
    emit(result)
