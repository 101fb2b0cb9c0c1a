"""The cross-entropy method: the best continuous action of one state, Algorithm 1 lines 8-13."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.agent import box
from csac_jax.config import CEMConfig

Score = Callable[[jax.Array], jax.Array]
Wraps = jax.Array | np.ndarray  # [A] bool, dimensions in which -1 and 1 are the same point


class CEMResult(NamedTuple):
    """The best sample of all rounds."""

    action: jax.Array  # [A] in the box [-1, 1]
    value: jax.Array  # [] its score; -inf if no score was a number


class _Search(NamedTuple):
    mean: jax.Array  # [A]
    std: jax.Array  # [A]
    best: CEMResult


def maximise(
    key: jax.Array, cfg: CEMConfig, score: Score, mean: jax.Array, start: jax.Array, wraps: Wraps
) -> CEMResult:
    """Maximises `score` ([A] -> []) in the box [-1, 1]^A; for one state, vmap over states.

    mu' = mean(elites), sigma' = max(std(elites), std_min), elites = best K of J samples, lines
    8-12; numbers as QT-Opt, arXiv:1806.10293. Deviations from line 13: the result is the best
    sample of all rounds, not the last mean, and the caller adds noise. NaN ranks last, where
    `top_k` would rank it first. Samples of value -inf are never elites.

    Args: mean [A] the actor's proposal; start [P0, A] samples of the first round, P0 <= J, may be
    0: the others are Gaussian.
    """
    search = _init(cfg, mean, wraps)
    search = _update(cfg, score, search, _first_samples(key, cfg, mean, start, wraps), wraps)

    def iterate(search: _Search, i: jax.Array) -> tuple[_Search, None]:
        actions = _sample(key, search, i, cfg.candidates, wraps)
        return _update(cfg, score, search, actions, wraps), None

    search, _ = jax.lax.scan(iterate, search, jnp.arange(1, cfg.rounds))
    return search.best


def last_round(
    key: jax.Array, cfg: CEMConfig, score: Score, mean: jax.Array, start: jax.Array, wraps: Wraps
) -> jax.Array:
    """The samples [J, A] of the last round of `maximise` with the same arguments; for pictures."""
    actions, search = _first_samples(key, cfg, mean, start, wraps), _init(cfg, mean, wraps)
    for i in range(1, cfg.rounds):
        search = _update(cfg, score, search, actions, wraps)
        actions = _sample(key, search, i, cfg.candidates, wraps)
    return actions


def _init(cfg: CEMConfig, mean: jax.Array, wraps: Wraps) -> _Search:
    centre = box.project(mean, wraps)
    nothing = CEMResult(centre, jnp.full((), -jnp.inf, mean.dtype))
    return _Search(centre, jnp.full_like(mean, cfg.std), nothing)


def _first_samples(
    key: jax.Array, cfg: CEMConfig, mean: jax.Array, start: jax.Array, wraps: Wraps
) -> jax.Array:
    """The samples [J, A] of the first round: `start`, filled up with Gaussian ones."""
    num_start = start.shape[0]
    if num_start > cfg.candidates:
        raise ValueError(
            f"cem.candidates: {cfg.candidates} samples cannot hold {num_start} starting points; "
            "raise it"
        )
    drawn = _sample(key, _init(cfg, mean, wraps), 0, cfg.candidates - num_start, wraps)
    return jnp.concatenate([box.project(start, wraps), drawn])


def _sample(
    key: jax.Array, search: _Search, i: jax.Array | int, num: int, wraps: Wraps
) -> jax.Array:
    """Gaussian samples [num, A] of round i."""
    noise = jax.random.normal(
        jax.random.fold_in(key, i), (num, *search.mean.shape), search.mean.dtype
    )
    return box.project(search.mean[None] + search.std[None] * noise, wraps)


def _update(
    cfg: CEMConfig, score: Score, search: _Search, actions: jax.Array, wraps: Wraps
) -> _Search:
    """The search after a round of `actions` [J, A]; unchanged if none of them has a value."""
    values = jax.vmap(score)(actions)  # [J]
    elite_values, elite = jax.lax.top_k(jnp.where(jnp.isnan(values), -jnp.inf, values), cfg.elites)
    elites = actions[elite]  # [K, A], best first
    mean, std = fit(cfg, elites, elite_values > -jnp.inf, wraps)
    any_valid = elite_values[0] > -jnp.inf
    better = elite_values[0] > search.best.value
    best = CEMResult(
        jnp.where(better, elites[0], search.best.action),
        jnp.where(better, elite_values[0], search.best.value),
    )
    return _Search(
        jnp.where(any_valid, mean, search.mean), jnp.where(any_valid, std, search.std), best
    )


STD_ESTIMATORS: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    # abs(a_k - mu) [K, A], number of elites [] -> [A]
    "std": lambda deviation, count: jnp.sqrt(jnp.sum(deviation**2, axis=0) / count),
    "mad": lambda deviation, count: jnp.sum(deviation, axis=0) / jnp.maximum(count - 1.0, 1.0),
}


def fit(
    cfg: CEMConfig, elites: jax.Array, valid: jax.Array, wraps: Wraps
) -> tuple[jax.Array, jax.Array]:
    """Mean [A] and std [A] of the `valid` [K] elites [K, A], Algorithm 1 line 12.

    std: sqrt(1 / K sum (a_k - mu)^2), or the paper's `mad`: 1 / (K - 1) sum |a_k - mu|; at least
    `std_min`. Dimensions that wrap are measured from the first elite, the short way round: elites
    on both sides of the seam have their mean at the seam.
    """
    weight = valid.astype(elites.dtype)[:, None]  # [K, 1]
    count = jnp.maximum(jnp.sum(weight), 1.0)
    offset = elites - elites[:1]
    offset = jnp.where(jnp.broadcast_to(wraps, offset.shape), box.wrap(offset), offset)  # [K, A]
    mean_offset = jnp.sum(weight * offset, axis=0) / count
    deviation = weight * jnp.abs(offset - mean_offset[None])
    std = STD_ESTIMATORS[cfg.std_estimator](deviation, count)
    return box.project(elites[0] + mean_offset, wraps), jnp.maximum(std, cfg.std_min)
