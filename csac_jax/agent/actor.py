"""The deterministic policy: one pose per primitive from dense logits, by a soft-argmax around the
highest of them.

A soft-argmax over the whole map would put the mean of two peaks between them. Around the highest
cell, over what falls off from it, it cannot, and its position still moves smoothly with the logits,
so that the critic's gradient can shift it.
"""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.agent import maps
from csac_jax.agent.maps import DenseMaps, Frames

SHARPNESS = 10.0  # logit per unit of Q: how the critic's own map enters the actor's
WINDOW = 2  # cells on each side of the highest one that the soft-argmax covers
_INWARD = WINDOW + np.array(
    [-1, -1, 0, 1, 1]
)  # for each row or column of the window: one step nearer to its middle


def logits(q: jax.Array, correction: jax.Array) -> jax.Array:
    """The actor's logits, any shape: the critic's map, without gradient, corrected by the actor's
    head.

    The deterministic policy gradient only ever moves a mode; the critic's map says where the modes
    are.
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
    hill = jnp.where(shown, state.logits[primitive][window], -jnp.inf)  # [5, 5]
    hill = jnp.minimum(
        hill, hill[_INWARD[:, None], _INWARD[None, :]]
    )  # no second peak counts, behind a dip
    weight = jax.nn.softmax(hill.reshape(-1))  # [25]
    xy = jnp.sum(weight[:, None] * jnp.asarray(frames.xy)[window].reshape(-1, 2), axis=0)

    step = 2.0 * np.pi / num
    yaws = jnp.asarray(frames.yaws)[k] + step * np.array([-1, 0, 1], np.float32)
    heights = _along_yaw(frames, state, primitive, xy, geometry.wrap_angle(yaws))
    turn = jnp.sum(jax.nn.softmax(heights) * np.array([-step, 0.0, step], np.float32))
    return jnp.append(xy, geometry.wrap_angle(jnp.asarray(frames.yaws)[k] + turn))


def _along_yaw(
    frames: Frames, state: DenseMaps, primitive: int, xy: jax.Array, yaws: jax.Array
) -> jax.Array:
    """Logits [3] at one place [2] m and three yaws [3], the middle one the best cell's; -inf where
    it is not valid.

    Between cells only the valid ones are mixed: sum w_i l_i / sum w_i, w_i the bilinear weight of a
    valid cell, 0 of any other. The middle one stands for all if none of the three is valid.
    """
    valid = state.valid[primitive]
    valid |= ~jnp.any(valid)
    grids = jnp.stack([jnp.where(valid, state.logits[primitive], 0.0), valid.astype(jnp.float32)])
    poses = jax.vmap(jnp.append, (None, 0))(xy, yaws)
    read = jax.vmap(jax.vmap(maps.read, (None, None, 0, None)), (None, None, None, 0))
    total, weight = read(frames, grids, jnp.arange(2), poses).T  # [3] each
    shown = jax.vmap(lambda pose: maps.is_valid(frames, valid[None], jnp.int32(0), pose))(poses)
    middle = np.array([False, True, False]) & ~jnp.any(shown)
    return jnp.where(shown | middle, total / jnp.where(shown, weight, 1.0), -jnp.inf)
