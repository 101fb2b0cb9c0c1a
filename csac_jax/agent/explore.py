"""Exploration: action noise, sometimes a random primitive, sometimes a random place."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from csac_jax.agent import box
from csac_jax.config import ExploreConfig


class Greedy(NamedTuple):
    """Greedy decision of the policy. P = primitives."""

    primitive: jax.Array  # [] int32, Primitive
    poses: jax.Array  # [P, 3] in the box, the best pose of each primitive
    values: jax.Array  # [P] Q of the poses


def probability(start: float, end: float, decay: float, actions: jax.Array) -> jax.Array:
    """Returns max(end, start decay^actions) [], `actions` [] int32; VPG: 0.5, 0.1, 0.9998."""
    return jnp.maximum(end, start * jnp.power(decay, actions.astype(jnp.float32)))


def action_noise(key: jax.Array, cfg: ExploreConfig, action: jax.Array) -> jax.Array:
    """Adds clip(N(0, delta), -c, c) to `action` [3] in the box, line 13; c = 3 delta (ours)."""
    bound = 3.0 * cfg.noise_std
    noise = cfg.noise_std * jax.random.normal(key, action.shape, action.dtype)
    return box.project(action + jnp.clip(noise, -bound, bound))


def choose(
    key: jax.Array, cfg: ExploreConfig, actions_taken: jax.Array, greedy: Greedy, places: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Chooses a primitive [] int32 and a normalised pose [3], after `actions_taken` [].

    With a decaying probability the primitive is random, a push with `push_fraction` (VPG). With
    another one the pose is that of random `places` [P, 3], else the primitive's greedy one + noise.
    """
    key_explore, key_push, key_place, key_noise = jax.random.split(key, 4)
    epsilon = probability(*cfg.epsilon_primitive, cfg.epsilon_decay, actions_taken)
    primitive_is_random = jax.random.bernoulli(key_explore, epsilon)
    random_primitive = jnp.where(jax.random.bernoulli(key_push, cfg.push_fraction), 0, 1)
    primitive = jnp.where(primitive_is_random, random_primitive, greedy.primitive).astype(jnp.int32)
    epsilon_place = probability(*cfg.epsilon_place, cfg.epsilon_decay, actions_taken)
    place_is_random = jax.random.bernoulli(key_place, epsilon_place)
    noisy = action_noise(key_noise, cfg, greedy.poses[primitive])
    return primitive, jnp.where(place_is_random, places[primitive], noisy)


def random_cell(key: jax.Array, valid: jax.Array) -> jax.Array:
    """Draws an index [] int32, uniform over True entries of `valid` [n]; 0 without one."""
    count = jnp.cumsum(valid, dtype=jnp.int32)  # [n]; ties of n noises would favour low indices
    rank = jax.random.randint(key, (), 0, jnp.maximum(count[-1], 1))
    return jnp.argmax(count > rank).astype(jnp.int32)
