"""The ring of transitions: R1 of CSAC Algorithm 1 line 14. R2, its ranked view, is the sampler's."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax.config import ReplayConfig


@struct.dataclass
class ReplayState:
    """Ring of transitions. C = capacity. Slot `(head - 1) % C` is the newest."""

    items: Any  # pytree, leaves [C, ...]
    head: jax.Array  # [] int32, next slot written
    size: jax.Array  # [] int32, filled slots, <= C
    error: jax.Array  # [C] float32, last abs TD error, finite; any value beyond `size`


def init(cfg: ReplayConfig, example_item: Any) -> ReplayState:
    """An empty ring for items of the types and shapes of `example_item`; errors start at 1."""
    items = jax.tree.map(lambda leaf: jnp.zeros((cfg.capacity, *leaf.shape), leaf.dtype), example_item)
    return ReplayState(items, jnp.int32(0), jnp.int32(0), jnp.ones(cfg.capacity, jnp.float32))


def add(state: ReplayState, items: Any, valid: jax.Array) -> ReplayState:
    """Stores the `valid` [E] bool ones of `items` (leaves [E, ...], E <= C) in consecutive slots, in their order.

    The oldest give way. New items take the largest error stored, so that none is ranked above them. A scatter to slots
    that are all different, never a copy of the ring: with the state donated, XLA writes in place.
    """
    capacity, num = state.error.shape[0], valid.shape[0]
    if num > capacity:
        raise ValueError(f"replay.capacity: {capacity} slots cannot take {num} transitions at once; raise it")
    position = jnp.cumsum(valid, dtype=jnp.int32)  # [E], 1 for the first valid item
    count = position[-1]
    outside = capacity + jnp.arange(num, dtype=jnp.int32)  # dropped
    slots = jnp.where(valid, (state.head + position - 1) % capacity, outside)

    def write(ring: jax.Array, new: jax.Array) -> jax.Array:
        return ring.at[slots].set(new, mode="drop", unique_indices=True)

    return ReplayState(
        items=jax.tree.map(write, state.items, items),
        head=(state.head + count) % capacity,
        size=jnp.minimum(state.size + count, capacity),
        error=write(state.error, jnp.full(num, largest_error(state))),
    )


def gather(state: ReplayState, slots: jax.Array) -> Any:
    """Items in `slots` [B] int32, leaves [B, ...]."""
    return jax.tree.map(lambda ring: ring.at[slots].get(mode="clip"), state.items)


def largest_error(state: ReplayState) -> jax.Array:
    """Largest abs TD error stored, [] float32; 1 in an empty ring."""
    filled = jnp.arange(state.error.shape[0]) < state.size
    return jnp.where(state.size > 0, jnp.max(jnp.where(filled, state.error, 0.0)), 1.0)


def set_errors(state: ReplayState, slots: jax.Array, errors: jax.Array) -> ReplayState:
    """Replaces the errors of `slots` [B] int32 by the sizes of `errors` [B], signed TD errors.

    A slot that occurs twice keeps the larger one: two order-free scatters, `min` to 0 and `max`, as the order of
    conflicting `set`s is undefined. An error that is not finite counts as the largest one known, as a new item's does:
    the transition is looked at again, and no NaN gets into the ranking.
    """
    size = jnp.abs(errors).astype(jnp.float32)
    finite = jnp.isfinite(size)
    largest = jnp.maximum(largest_error(state), jnp.max(jnp.where(finite, size, 0.0)))
    cleared = state.error.at[slots].min(0.0, mode="drop")
    return dataclasses.replace(state, error=cleared.at[slots].max(jnp.where(finite, size, largest), mode="drop"))
