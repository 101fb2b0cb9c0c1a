"""Augmentation of transitions by symmetries of the workspace and shifts by whole cells.

Both are exact but for the light, which does not move along: sloping faces keep their brightness.
"""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.agent.learner import Transition
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.sim.outcome import BARE
from csac_jax.vision import heightmap


def apply_symmetry(
    transition: Transition, mirror_x: jax.Array, mirror_y: jax.Array, swap: jax.Array
) -> Transition:
    """Mirrors x, then y, then swaps x and y in a transition, by flags [] bool."""

    def view(field: jax.Array) -> jax.Array:  # rows are y, columns x
        if field.ndim < 2:  # no map
            return field
        field = jnp.where(mirror_x, field[:, ::-1], field)
        field = jnp.where(mirror_y, field[::-1], field)
        return jnp.where(swap, jnp.swapaxes(field, 0, 1), field)

    x, y, yaw = transition.action.pose
    x, yaw = jnp.where(mirror_x, -x, x), jnp.where(mirror_x, np.float32(np.pi) - yaw, yaw)
    y, yaw = jnp.where(mirror_y, -y, y), jnp.where(mirror_y, -yaw, yaw)
    x, y = jnp.where(swap, y, x), jnp.where(swap, x, y)
    yaw = jnp.where(swap, np.float32(0.5 * np.pi) - yaw, yaw)
    pose = jnp.stack([x, y, geometry.wrap_angle(yaw)])
    obs, next_obs = jax.tree.map(view, (transition.obs, transition.next_obs))
    action = transition.action.replace(pose=pose)
    return transition.replace(obs=obs, next_obs=next_obs, action=action)


def shift(cfg: Config, transition: Transition, cells: jax.Array) -> Transition:
    """Shifts a transition by `cells` [2] int32 (row, col); cells that come in are bare table.

    It stays unchanged where that would cut off a surface higher than BARE in either map, the place
    of the action or the end of a push; or where a push is already cut off.
    """
    pose, primitive = transition.action.pose, transition.action.primitive
    step = cells[::-1].astype(jnp.float32) * cfg.heightmap.cell  # x, y
    new_pose = jnp.append(pose[:2] + step, pose[2])
    fits = _reaches(cfg, primitive, pose) & _reaches(cfg, primitive, new_pose)
    place = geometry.cell_centres(cfg.heightmap) + step[None, None]
    stays = jnp.all(jnp.abs(place) <= 0.5 * cfg.heightmap.extent, axis=-1)
    for obs in (transition.obs, transition.next_obs):
        fits &= jnp.all((heightmap.unpack(obs).height <= BARE) | stays)
    moved = transition.replace(
        obs=_shift_maps(transition.obs, cells),
        next_obs=_shift_maps(transition.next_obs, cells),
        action=transition.action.replace(pose=new_pose),
    )
    return jax.tree.map(lambda new, old: jnp.where(fits, new, old), moved, transition)


def _reaches(cfg: Config, primitive: jax.Array, pose: jax.Array) -> jax.Array:
    """Checks that an action at a pose [3] runs its full length above the workspace, [] bool."""
    length = jnp.where(primitive == Primitive.PUSH, cfg.sim.push_length, 0.0)
    end = pose[:2] + length * jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
    return jnp.all(jnp.maximum(jnp.abs(pose[:2]), jnp.abs(end)) <= 0.5 * cfg.heightmap.extent)


def _shift_maps(obs: heightmap.PackedObservation, cells: jax.Array) -> heightmap.PackedObservation:
    """Shifts maps by `cells` [2] int32; cells that come in look like the lowest one."""
    size = obs.height.shape[0]
    row, col = (jnp.arange(size, dtype=jnp.int32) - count for count in cells)
    row, col = row[:, None], col[None]
    inside = (row >= 0) & (row < size) & (col >= 0) & (col < size)
    source = jnp.where(inside, row * size + col, jnp.argmin(obs.height).astype(jnp.int32))
    colour, height, target = (
        field.reshape(size * size, *field.shape[2:]).at[source].get(mode="promise_in_bounds")
        for field in (obs.colour, obs.height, obs.target)
    )
    height = jnp.where(inside, height, jnp.uint16(0))
    target = jnp.where(inside, target, jnp.all(obs.target))
    return heightmap.PackedObservation(colour, height, target, obs.fingers)


def augment(key: jax.Array, cfg: Config, transition: Transition) -> Transition:
    """Applies a random symmetry of the eight and a random shift, as the config says."""
    most = cfg.learn.augment_shift
    if cfg.learn.augment:
        transition = apply_symmetry(transition, *jax.random.bernoulli(key, shape=(3,)))
    if most == 0:
        return transition
    _, key_cells = jax.random.split(jax.random.fold_in(key, 1))
    return shift(cfg, transition, jax.random.randint(key_cells, (2,), -most, most + 1))
