"""The eight symmetries of the square workspace, as augmentation of transitions: exact, nothing is interpolated."""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.agent.learner import Transition


def turn_over(transition: Transition, mirror_x: jax.Array, mirror_y: jax.Array, swap: jax.Array) -> Transition:
    """The transition seen with x mirrored, then y mirrored, then x and y swapped, where the flags [] bool say so."""

    def view(field: jax.Array) -> jax.Array:  # rows are y, columns x
        field = jnp.where(mirror_x, field[:, ::-1], field)
        field = jnp.where(mirror_y, field[::-1], field)
        return jnp.where(swap, jnp.swapaxes(field, 0, 1), field)

    x, y, yaw = transition.action.pose
    x, yaw = jnp.where(mirror_x, -x, x), jnp.where(mirror_x, np.float32(np.pi) - yaw, yaw)
    y, yaw = jnp.where(mirror_y, -y, y), jnp.where(mirror_y, -yaw, yaw)
    x, y, yaw = jnp.where(swap, y, x), jnp.where(swap, x, y), jnp.where(swap, np.float32(0.5 * np.pi) - yaw, yaw)
    pose = jnp.stack([x, y, geometry.wrap_angle(yaw)])
    return transition.replace(
        obs=jax.tree.map(view, transition.obs),
        next_obs=jax.tree.map(view, transition.next_obs),
        action=transition.action.replace(pose=pose),
    )


def randomly(key: jax.Array, transition: Transition) -> Transition:
    """The transition under one of the eight symmetries, each equally likely."""
    return turn_over(transition, *jax.random.bernoulli(key, shape=(3,)))
