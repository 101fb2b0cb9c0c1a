"""Exploration: action noise, sometimes a random primitive, sometimes a random place."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from csac_jax.agent import box
from csac_jax.config import ExploreConfig


class Greedy(NamedTuple):
    """What the policy would do. P = primitives."""

    primitive: jax.Array  # [] int32, Primitive
    poses: jax.Array  # [P, 3] normalised (x, y, yaw), the best pose of each primitive
    values: jax.Array  # [P] Q of the poses


def probability(start: float, end: float, decay: float, actions: jax.Array) -> jax.Array:
    """max(end, start decay^actions) [], `actions` [] int32 taken so far; VPG: 0.5, 0.1, 0.9998."""
    return jnp.maximum(end, start * jnp.power(decay, actions.astype(jnp.float32)))


def action_noise(key: jax.Array, cfg: ExploreConfig, action: jax.Array) -> jax.Array:
    """`action` [3] in the box + clip(N(0, delta), -c, c), line 13; c = 3 delta (ours)."""
    bound = 3.0 * cfg.noise_std
    noise = cfg.noise_std * jax.random.normal(key, action.shape, action.dtype)
    return box.project(action + jnp.clip(noise, -bound, bound))


def choose(
    key: jax.Array, cfg: ExploreConfig, actions_taken: jax.Array, greedy: Greedy, places: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Primitive [] int32 and normalised pose [3] to try, after `actions_taken` [] by the whole run.

    With a decaying probability the primitive is random, a push with `push_fraction` (VPG). With
    another one the pose is that primitive's of `places` [P, 3], which are random. Else it is that
    primitive's greedy pose plus noise: a forced primitive still acts where it is best.
    """
    key_explore, key_push, key_place, key_noise = jax.random.split(key, 4)
    epsilon = probability(*cfg.epsilon_primitive, cfg.decay, actions_taken)
    primitive_is_random = jax.random.bernoulli(key_explore, epsilon)
    random_primitive = jnp.where(jax.random.bernoulli(key_push, cfg.push_fraction), 0, 1)
    primitive = jnp.where(primitive_is_random, random_primitive, greedy.primitive).astype(jnp.int32)
    epsilon_place = probability(*cfg.epsilon_place, cfg.decay, actions_taken)
    place_is_random = jax.random.bernoulli(key_place, epsilon_place)
    noisy = action_noise(key_noise, cfg, greedy.poses[primitive])
    return primitive, jnp.where(place_is_random, places[primitive], noisy)


def random_cell(key: jax.Array, valid: jax.Array) -> jax.Array:
    """Index [] int32, uniform over the True entries of `valid` [n]; 0 if there is none.

    A random rank among the valid ones: ties of n noises would favour low indices.
    """
    count = jnp.cumsum(valid, dtype=jnp.int32)  # [n]
    rank = jax.random.randint(key, (), 0, jnp.maximum(count[-1], 1))
    return jnp.argmax(count > rank).astype(jnp.int32)
