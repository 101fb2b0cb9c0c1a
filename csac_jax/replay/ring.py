"""The ring of transitions: R1 of CSAC Algorithm 1 line 14. R2, its ranked view, is a sampler's."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax.errors import SettingsError

LARGEST = 1e28  # larger priorities are cut off here, so that the sum over any ring is finite


@struct.dataclass
class ReplayState:
    """Ring of transitions. C = capacity. Slot `(head - 1) % C` is the newest."""

    items: Any  # pytree, leaves [C, ...]
    head: jax.Array  # [] int32, next slot written
    size: jax.Array  # [] int32, filled slots, <= C
    priority: jax.Array  # [C] float32, the sampler's; of the built-in ones 0 beyond `size`


def init(priority: jax.Array, example_item: Any) -> ReplayState:
    """Creates an empty ring of `priority` [C] slots, for items like `example_item`."""
    rows = priority.shape
    items = jax.tree.map(lambda leaf: jnp.zeros((*rows, *leaf.shape), leaf.dtype), example_item)
    return ReplayState(items, jnp.int32(0), jnp.int32(0), priority)


def bytes_needed(capacity: int, example_item: Any) -> int:
    """Returns the memory of a ring of `capacity` items like `example_item` or its shapes."""
    item = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(example_item))
    return capacity * (item + jnp.dtype(jnp.float32).itemsize)  # and its priority


def add(state: ReplayState, items: Any, valid: jax.Array) -> ReplayState:
    """Stores the `valid` [E] bool ones of `items`, leaves [E, ...], over the oldest.

    New items take the largest stored priority, 1 in an empty ring. A scatter to slots that are all
    different: with the state donated, XLA writes in place.
    """
    capacity, num = state.priority.shape[0], valid.shape[0]
    if num > capacity:
        raise SettingsError(f"replay.capacity: must be at least {num}, the transitions of a step")
    position = jnp.cumsum(valid, dtype=jnp.int32)  # [E], 1 for the first valid item
    count = position[-1]
    outside = capacity + jnp.arange(num, dtype=jnp.int32)  # dropped
    slots = jnp.where(valid, (state.head + position - 1) % capacity, outside)
    largest = jnp.where(state.size > 0, jnp.max(state.priority), 1.0)

    def write(ring: jax.Array, new: jax.Array) -> jax.Array:
        return ring.at[slots].set(new, mode="drop", unique_indices=True)

    return ReplayState(
        items=jax.tree.map(write, state.items, items),
        head=(state.head + count) % capacity,
        size=jnp.minimum(state.size + count, capacity),
        priority=write(state.priority, jnp.full(num, largest)),
    )


def gather(state: ReplayState, slots: jax.Array) -> Any:
    """Returns the items in `slots` [B] int32, leaves [B, ...]."""
    return jax.tree.map(lambda ring: ring.at[slots].get(mode="clip"), state.items)


def set_priorities(state: ReplayState, slots: jax.Array, priorities: jax.Array) -> ReplayState:
    """Replaces the priorities of `slots` [B] int32, all filled, by `priorities` [B], at least 0.

    A slot that occurs twice keeps the larger one: by `min` and `max`, as the order of `set`s is
    undefined. A non-finite one counts as the largest that these slots have or had.
    """
    finite = jnp.isfinite(priorities)
    known = jnp.where(finite, jnp.minimum(priorities, LARGEST), 0.0)
    largest = jnp.max(jnp.maximum(known, state.priority.at[slots].get(mode="clip")))
    new = jnp.where(finite, known, largest)
    cleared = state.priority.at[slots].min(0.0, mode="drop")
    return state.replace(priority=cleared.at[slots].max(new, mode="drop"))
