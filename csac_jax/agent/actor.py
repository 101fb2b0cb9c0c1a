"""The deterministic policy: one pose per primitive from dense logits, by a soft-argmax around the highest of them.

A soft-argmax over the whole map would put the mean of two peaks between them; around the highest cell it cannot, and
its position still moves smoothly with the logits, so that the critic's gradient can shift it.
"""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.agent import maps
from csac_jax.agent.maps import DenseMaps, Frames

SHARPNESS = 10.0  # logit per unit of Q: how the critic's own map enters the actor's
WINDOW = 2  # cells on each side of the highest one that the soft-argmax covers


def logits(q: jax.Array, correction: jax.Array) -> jax.Array:
    """The actor's logits, any shape: the critic's map, without gradient, corrected by the actor's head.

    The deterministic policy gradient only ever moves a mode; the critic's map says where the modes are.
    """
    return jax.lax.stop_gradient(q) * SHARPNESS + correction


def pose(frames: Frames, state: DenseMaps, primitive: int) -> jax.Array:
    """mu(s): pose [3] (x m, y m, yaw rad) of one primitive, differentiable in the logits."""
    side, num = frames.side, frames.yaws.shape[0]
    best = maps.best_cells(state.logits[primitive], state.valid[primitive], 1)[0]
    k, row, col = jnp.unravel_index(best, (num, side, side))
    around = np.arange(-WINDOW, WINDOW + 1)
    rows, cols = jnp.clip(row + around, 0, side - 1), jnp.clip(col + around, 0, side - 1)
    window = (k, rows[:, None], cols[None, :])
    shown = state.valid[primitive][window]
    shown |= ~jnp.any(shown)
    weight = jax.nn.softmax(jnp.where(shown, state.logits[primitive][window], -jnp.inf).reshape(-1))  # [25]
    xy = jnp.sum(weight[:, None] * jnp.asarray(frames.xy)[window].reshape(-1, 2), axis=0)

    step = 2.0 * np.pi / num
    yaws = jnp.asarray(frames.yaws)[k] + step * np.array([-1, 0, 1], np.float32)
    read = jax.vmap(lambda yaw: maps.read(frames, state.logits, jnp.int32(primitive), jnp.append(xy, yaw)))
    turn = jnp.sum(jax.nn.softmax(read(geometry.wrap_angle(yaws))) * np.array([-step, 0.0, step], np.float32))
    return jnp.append(xy, geometry.wrap_angle(jnp.asarray(frames.yaws)[k] + turn))
