"""Which transitions are replayed: uniform (CSAC) or by rank of TD error (CSAC-beta), Algorithm 1 lines 15-16."""

import jax
import jax.numpy as jnp

from csac_jax.config import ReplayConfig
from csac_jax.replay.ring import ReplayState


def uniform_slots(key: jax.Array, size: jax.Array, num: int) -> jax.Array:
    """Slots [num] int32, uniform below `size` [], with repetition; slot 0 if nothing is stored."""
    return jax.random.randint(key, (num,), 0, jnp.maximum(size, 1), jnp.int32)


def beta_slots(
    key: jax.Array, errors: jax.Array, size: jax.Array, a: jax.Array | float, b: jax.Array | float, num: int
) -> jax.Array:
    """Slots whose TD-error rank follows Beta(a, b): rank 0 = largest |error|; CSAC sec. 3.5, eq. 17.

    rank = floor(n x), x ~ Beta(a, b). Beta(1, 1) is uniform, Beta(1, 2) VPG's power law. Equal errors share their
    ranks at random: by slot, the oldest would be preferred. NaN is ranked first. Slots are sorted by size of error with
    those not filled last, whatever their values.

    Args: errors [C], any value beyond `size`; size [] filled slots.
    Returns: [num] int32 slots, with repetition, all filled; slot 0 .. C - 1 if nothing is stored.
    """
    key_rank, key_ties = jax.random.split(key)
    slots = jnp.arange(errors.shape[0], dtype=jnp.int32)
    descending = -jnp.where(jnp.isnan(errors), jnp.inf, jnp.abs(errors))
    ties = jax.random.bits(key_ties, errors.shape)
    _, _, order = jax.lax.sort((jnp.where(slots < size, descending, jnp.inf), ties, slots), num_keys=2)
    rank = (jax.random.beta(key_rank, a, b, (num,)) * size.astype(jnp.float32)).astype(jnp.int32)
    return order[jnp.clip(rank, 0, jnp.maximum(size - 1, 0))]


def beta_schedule(cfg: ReplayConfig, progress: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(a, b) of the Beta law, each [], after the share `progress` [] of all updates; CSAC secs. 3.5 and 4.3.

    Linear from `beta_start` to (1, 1) at `beta_uniform_at`, and on to `beta_end` at 1; constant outside 0 .. 1.
    """
    knots = jnp.asarray([0.0, cfg.beta_uniform_at, 1.0], jnp.float32)
    a, b = (
        jnp.interp(progress, knots, jnp.asarray([start, 1.0, end], jnp.float32))
        for start, end in zip(cfg.beta_start, cfg.beta_end, strict=True)
    )
    return a, b


def sample(key: jax.Array, cfg: ReplayConfig, state: ReplayState, progress: jax.Array, num: int) -> jax.Array:
    """Slots [num] int32 to learn from, by `cfg.sampler`, after the share `progress` [] of all updates."""
    if cfg.sampler == "uniform":
        return uniform_slots(key, state.size, num)
    if cfg.sampler == "beta":
        a, b = beta_schedule(cfg, progress)
        return beta_slots(key, state.error, state.size, a, b, num)
    raise ValueError(f"replay.sampler: {cfg.sampler!r} is neither 'uniform' nor 'beta'")
