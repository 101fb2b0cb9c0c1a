"""The cross-entropy method: the best continuous action of one state, CSAC Algorithm 1 lines
8-13."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.agent import box
from csac_jax.config import CEMConfig

Score = Callable[[jax.Array], jax.Array]


class CEMResult(NamedTuple):
    """The best sample that was ever seen."""

    action: jax.Array  # [A] in the box [-1, 1]
    value: jax.Array  # [] its score; -inf if no score was a number


class _Search(NamedTuple):
    mean: jax.Array  # [A]
    std: jax.Array  # [A]
    best: CEMResult


def maximise(
    key: jax.Array,
    cfg: CEMConfig,
    score: Score,
    mean: jax.Array,
    start: jax.Array,
    wraps: jax.Array | np.ndarray,
) -> CEMResult:
    """Maximises `score` ([A] -> []) in the box [-1, 1]^A; for one state, vmap over states.

    mu' = mean(elites), sigma' = max(spread(elites), std_min), elites = best K of J samples;
    Algorithm 1 lines 8-12, numbers as QT-Opt, arXiv:1806.10293. The first round's samples are
    `start` and, up to J, Gaussian ones about `mean`. Unlike line 13, the best sample ever seen is
    the result, not the last mean, and noise is left to the caller. NaN ranks last, where `top_k`
    would rank it first; samples of value -inf are never elites.

    Args: mean [A] the actor's proposal; start [P0, A] further starting points, P0 <= J, may be 0;
    wraps [A] bool, True for the dimensions in which -1 and 1 are the same point.
    """
    search = _refit(
        cfg, score, _begin(cfg, mean, wraps), _first(key, cfg, mean, start, wraps), wraps
    )

    def iterate(search: _Search, i: jax.Array) -> tuple[_Search, None]:
        return _refit(
            cfg, score, search, _gaussian(key, search, i, cfg.candidates, wraps), wraps
        ), None

    search, _ = jax.lax.scan(iterate, search, jnp.arange(1, cfg.rounds))
    return search.best


def last_round(
    key: jax.Array,
    cfg: CEMConfig,
    score: Score,
    mean: jax.Array,
    start: jax.Array,
    wraps: jax.Array | np.ndarray,
) -> jax.Array:
    """The samples [J, A] that the last round of `maximise` tries when called with the same: to be
    looked at."""
    actions, search = _first(key, cfg, mean, start, wraps), _begin(cfg, mean, wraps)
    for i in range(1, cfg.rounds):
        search = _refit(cfg, score, search, actions, wraps)
        actions = _gaussian(key, search, i, cfg.candidates, wraps)
    return actions


def _begin(cfg: CEMConfig, mean: jax.Array, wraps: jax.Array | np.ndarray) -> _Search:
    """The search before its first round."""
    centre = box.project(mean, wraps)
    return _Search(
        centre, jnp.full_like(mean, cfg.std), CEMResult(centre, jnp.full((), -jnp.inf, mean.dtype))
    )


def _first(
    key: jax.Array, cfg: CEMConfig, mean: jax.Array, start: jax.Array, wraps: jax.Array | np.ndarray
) -> jax.Array:
    """The samples [J, A] of the first round: `start`, filled up with Gaussian ones."""
    num_start = start.shape[0]
    if num_start > cfg.candidates:
        raise ValueError(
            f"cem.candidates: {cfg.candidates} samples cannot hold {num_start} starting points; raise it"
        )
    drawn = _gaussian(key, _begin(cfg, mean, wraps), 0, cfg.candidates - num_start, wraps)
    return jnp.concatenate([box.project(start, wraps), drawn])


def _gaussian(
    key: jax.Array, search: _Search, i: jax.Array | int, num: int, wraps: jax.Array | np.ndarray
) -> jax.Array:
    """Samples [num, A] of round i about the search's mean."""
    noise = jax.random.normal(
        jax.random.fold_in(key, i), (num, *search.mean.shape), search.mean.dtype
    )
    return box.project(search.mean[None] + search.std[None] * noise, wraps)


def _refit(
    cfg: CEMConfig, score: Score, search: _Search, actions: jax.Array, wraps: jax.Array | np.ndarray
) -> _Search:
    """The search after a round that tried `actions` [J, A]; it stays where it is if none of them
    has a value."""
    values = jax.vmap(score)(actions)  # [J]
    elite_values, elite = jax.lax.top_k(jnp.where(jnp.isnan(values), -jnp.inf, values), cfg.elites)
    elites = actions[elite]  # [K, A], best first
    mean, std = fit(cfg, elites, elite_values > -jnp.inf, wraps)
    found = elite_values[0] > -jnp.inf
    better = elite_values[0] > search.best.value
    best = CEMResult(
        jnp.where(better, elites[0], search.best.action),
        jnp.where(better, elite_values[0], search.best.value),
    )
    return _Search(jnp.where(found, mean, search.mean), jnp.where(found, std, search.std), best)


def fit(
    cfg: CEMConfig, elites: jax.Array, valid: jax.Array, wraps: jax.Array | np.ndarray
) -> tuple[jax.Array, jax.Array]:
    """Mean [A] and spread [A] of the `valid` [K] elites [K, A], Algorithm 1 line 12.

    spread `std`: sqrt(1 / K sum (a_k - mu)^2); `mad`, the paper's: 1 / (K - 1) sum |a_k - mu|;
    never below `std_min`. Dimensions that wrap are measured from the first elite, the short way
    round: elites on both sides of the seam have their mean at the seam, not half a turn away.
    """
    weight = valid.astype(elites.dtype)[:, None]  # [K, 1]
    count = jnp.maximum(jnp.sum(weight), 1.0)
    offset = elites - elites[:1]
    offset = jnp.where(jnp.broadcast_to(wraps, offset.shape), box.wrap(offset), offset)  # [K, A]
    shift = jnp.sum(weight * offset, axis=0) / count
    deviation = weight * jnp.abs(offset - shift[None])
    if cfg.std_estimator == "std":
        spread = jnp.sqrt(jnp.sum(deviation**2, axis=0) / count)
    elif cfg.std_estimator == "mad":
        spread = jnp.sum(deviation, axis=0) / jnp.maximum(count - 1.0, 1.0)
    else:
        raise ValueError(f"cem.std_estimator: {cfg.std_estimator!r} is neither 'std' nor 'mad'")
    return box.project(elites[0] + shift, wraps), jnp.maximum(spread, cfg.std_min)
