"""The cross-entropy method: the best pose of one state, Algorithm 1 lines 8-13."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from csac_jax.agent import box
from csac_jax.config import CEMConfig

Score = Callable[[jax.Array], jax.Array]  # of a point of the box [3] -> []


class CEMResult(NamedTuple):
    """Best sample of all rounds, in the box."""

    action: jax.Array  # [3]
    value: jax.Array  # [] its score; -inf if no score was a number
    candidates: jax.Array  # [J, 3] samples of the last round, for pictures


class _Search(NamedTuple):
    mean: jax.Array  # [3], as std
    std: jax.Array
    best: CEMResult


def maximise(
    key: jax.Array, cfg: CEMConfig, score: Score, mean: jax.Array, start: jax.Array
) -> CEMResult:
    """Maximises `score` in the box for one state; vmap over states.

    mu' = mean(elites), sigma' = max(std(elites), std_min), elites = best K of J samples, lines
    8-12; numbers as QT-Opt, arXiv:1806.10293. Deviations from line 13: the result is the best
    sample of all rounds, and the caller adds noise. NaN and -inf are never elites. `mean` [3] is
    the actor's proposal, `start` [P0, 3] the first samples of the first round.
    """
    centre = box.project(mean)
    nothing = CEMResult(centre, jnp.full((), -jnp.inf, mean.dtype), centre[None])
    search = _Search(centre, jnp.full_like(mean, cfg.std), nothing)
    drawn = _sample(key, search, 0, cfg.candidates - len(start))
    search = _update(cfg, score, search, jnp.concatenate([box.project(start), drawn]))

    def iterate(search: _Search, i: jax.Array) -> tuple[_Search, None]:
        return _update(cfg, score, search, _sample(key, search, i, cfg.candidates)), None

    search, _ = jax.lax.scan(iterate, search, jnp.arange(1, cfg.rounds))
    return search.best


def _sample(key: jax.Array, search: _Search, i: jax.Array | int, num: int) -> jax.Array:
    """Draws Gaussian samples [num, 3] of round i."""
    noise = jax.random.normal(jax.random.fold_in(key, i), (num, 3), search.mean.dtype)
    return box.project(search.mean[None] + search.std[None] * noise)


def _update(cfg: CEMConfig, score: Score, search: _Search, actions: jax.Array) -> _Search:
    """Updates the search with `actions` [J, 3]; unchanged if none of them has a value."""
    values = jax.vmap(score)(actions)  # [J]
    elite_values, elite = jax.lax.top_k(jnp.where(jnp.isnan(values), -jnp.inf, values), cfg.elites)
    elites = actions[elite]  # [K, 3], best first
    mean, std = fit(cfg, elites, elite_values > -jnp.inf)
    any_valid, better = elite_values[0] > -jnp.inf, elite_values[0] > search.best.value
    action = jnp.where(better, elites[0], search.best.action)
    value = jnp.where(better, elite_values[0], search.best.value)
    mean, std = jnp.where(any_valid, mean, search.mean), jnp.where(any_valid, std, search.std)
    return _Search(mean, std, CEMResult(action, value, actions))


def fit(cfg: CEMConfig, elites: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Fits mean [3] and std [3] of the `valid` [K] elites [K, 3], Algorithm 1 line 12.

    std: sqrt(1 / K sum (a_k - mu)^2), where line 12 has 1 / (K - 1) sum |a_k - mu|. Yaw is measured
    from the first elite, the short way round.
    """
    weight = valid.astype(elites.dtype)[:, None]  # [K, 1]
    count = jnp.maximum(jnp.sum(weight), 1.0)
    offset = box.wrap_yaw(elites - elites[:1])  # [K, 3]
    mean_offset = jnp.sum(weight * offset, axis=0) / count
    deviation = weight * (offset - mean_offset[None])
    std = jnp.sqrt(jnp.sum(deviation**2, axis=0) / count)
    return box.project(elites[0] + mean_offset), jnp.maximum(std, cfg.std_min)
