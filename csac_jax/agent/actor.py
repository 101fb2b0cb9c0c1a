"""The deterministic policy: one pose per primitive, a soft-argmax around the highest logit.

Over the whole map it would lie between two peaks. It moves smoothly with the logits.
"""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.agent import maps
from csac_jax.agent.maps import DenseMaps, Frames

SHARPNESS = 10.0  # logit per unit of Q: how the critic's own map enters the actor's
WINDOW = 2  # cells on each side of the highest one that the soft-argmax covers
_INWARD = WINDOW + np.array([-1, -1, 0, 1, 1])  # of each row: the next one towards the middle


def logits(q: jax.Array, correction: jax.Array) -> jax.Array:
    """The actor's logits, any shape: the critic's map, without gradient, plus the head's output.

    The policy gradient only moves a mode; the critic's map says where modes are.
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
    valid = state.valid[primitive][window]
    valid |= ~jnp.any(valid)
    peak = jnp.where(valid, state.logits[primitive][window], -jnp.inf)  # [5, 5]
    # A second peak behind a dip does not count.
    peak = jnp.minimum(peak, peak[_INWARD[:, None], _INWARD[None, :]])
    weight = jax.nn.softmax(peak.reshape(-1))  # [25]
    xy = jnp.sum(weight[:, None] * jnp.asarray(frames.xy)[window].reshape(-1, 2), axis=0)

    step = 2.0 * np.pi / num
    yaws = jnp.asarray(frames.yaws)[k] + step * np.array([-1, 0, 1], np.float32)
    yaw_logits = _along_yaw(frames, state, primitive, xy, geometry.wrap_angle(yaws))
    offset = jnp.sum(jax.nn.softmax(yaw_logits) * np.array([-step, 0.0, step], np.float32))
    return jnp.append(xy, geometry.wrap_angle(jnp.asarray(frames.yaws)[k] + offset))


def _along_yaw(
    frames: Frames, state: DenseMaps, primitive: int, xy: jax.Array, yaws: jax.Array
) -> jax.Array:
    """Logits [3] at one place [2] m and three yaws [3]; -inf where the place is not valid.

    Between cells only the valid ones are mixed: sum w_i l_i / sum w_i, w_i the bilinear weight of a
    valid cell, 0 of any other. If none of the three is valid, the middle one counts.
    """
    valid = state.valid[primitive]
    valid |= ~jnp.any(valid)
    grids = jnp.stack([jnp.where(valid, state.logits[primitive], 0.0), valid.astype(jnp.float32)])
    poses = jax.vmap(jnp.append, (None, 0))(xy, yaws)
    read = jax.vmap(jax.vmap(maps.read, (None, None, 0, None)), (None, None, None, 0))
    total, weight = read(frames, grids, jnp.arange(2), poses).T  # [3] each
    is_valid = jax.vmap(lambda pose: maps.is_valid(frames, valid[None], jnp.int32(0), pose))(poses)
    middle = np.array([False, True, False]) & ~jnp.any(is_valid)
    return jnp.where(is_valid | middle, total / jnp.where(is_valid, weight, 1.0), -jnp.inf)
