"""The actor: a pose per primitive by a soft-argmax around its highest logit, and its update."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from csac_jax import geometry
from csac_jax.agent import maps, values
from csac_jax.agent.actor_critic import ActorCritic, LearnerState
from csac_jax.nets import networks
from csac_jax.vision.heightmap import Observation

_WINDOW = np.arange(-2, 3)  # cells around the highest; of the whole map it lies between two peaks
_INWARD = 2 + np.array([-1, -1, 0, 1, 1])  # of each row: the next one towards the middle


def pose(frames: maps.Frames, state: maps.DenseMaps, primitive: int) -> jax.Array:
    """Returns mu(s), the pose [3] (x m, y m, yaw rad) of one primitive; differentiable."""
    side, num = frames.side, frames.yaws.shape[0]
    best = maps.best_cells(state.logits[primitive], state.valid[primitive], 1)[0]
    k, row, col = jnp.unravel_index(best, (num, side, side))
    rows, cols = jnp.clip(row + _WINDOW, 0, side - 1), jnp.clip(col + _WINDOW, 0, side - 1)
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
    frames: maps.Frames, state: maps.DenseMaps, primitive: int, xy: jax.Array, yaws: jax.Array
) -> jax.Array:
    """Interpolates logits [3] at a place [2] m and three yaws [3]; -inf where it is not valid.

    Only valid cells are mixed: sum w_i l_i / sum w_i. If none is valid, the middle yaw counts.
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


def update(
    learner: ActorCritic, state: LearnerState, obs: Observation
) -> tuple[LearnerState, jax.Array]:
    """Updates theta^mu up the critic, Algorithm 1 lines 22-23; also returns the loss [], -J.

    grad J = mean grad_a Q(s, a)|_{a = mu(s)} grad mu(s), through the interpolated map. Without an
    actor nothing changes and the loss is 0.
    """
    if not learner.cfg.learn.actor:
        return state, jnp.zeros(())
    frames, chosen = learner.frames, maps.allowed_primitives(learner.cfg.policy)
    q, features = jax.lax.stop_gradient(values.critic_maps(learner, state.online.critic, obs))

    def value(_: jax.Array, single: maps.DenseMaps) -> jax.Array:
        return maps.read(frames, single.q, jnp.int32(0), pose(frames, single, 0))

    def loss(learned: Any) -> tuple[jax.Array, Any]:
        variables = {**state.online.actor, **learned}
        correction, statistics = networks.train(frames.networks.head, variables, features)
        batch_maps = values.unfold_maps(learner, obs, q, correction)
        per_state = functools.partial(maps.map_primitives, value, chosen=chosen)
        return -jnp.mean(jax.vmap(per_state)(batch_maps)), statistics

    before = networks.learned(state.online.actor)
    (actor_loss, statistics), gradient = jax.value_and_grad(loss, has_aux=True)(before)
    step, optimiser = learner.actor_optimiser.update(gradient, state.actor_optimiser)
    online = state.online.replace(actor={**optax.apply_updates(before, step), **statistics})
    return state.replace(online=online, actor_optimiser=optimiser), actor_loss
