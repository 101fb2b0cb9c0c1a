"""Exact values that estimates are compared with."""

import jax
import jax.numpy as jnp


def exact_softmax(q_map: jax.Array, beta: jax.Array | float, valid: jax.Array) -> jax.Array:
    """softmax_beta [] over the `valid` [...] bool cells of `q_map` [...], one at least."""
    top = jnp.max(jnp.where(valid, q_map, -jnp.inf))
    below = jnp.where(valid, q_map - top, 0.0)
    weight = jnp.where(valid, jnp.exp(beta * below), 0.0)
    return top + jnp.sum(weight * below) / jnp.sum(weight)
