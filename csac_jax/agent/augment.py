"""Augmentation of transitions: symmetries of the square workspace, shifts by cells, rotations.

Symmetries, shifts and quarter turns are exact, cell by cell. Any other rotation is exact for the
action; maps take the nearest cell, at most half a cell a side away. The light does not move along:
sloping faces keep their brightness.
"""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.agent.actor_critic import Transition
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.sim.outcome import BARE
from csac_jax.vision import heightmap
from csac_jax.vision.heightmap import PackedObservation

CLEARANCE = 0.05  # m, of blocks to a side that a shown border moves out of sight


def apply_symmetry(
    transition: Transition, mirror_x: jax.Array, mirror_y: jax.Array, swap: jax.Array
) -> Transition:
    """The transition with x mirrored, then y mirrored, then x and y swapped; flags [] bool."""

    def view(field: jax.Array) -> jax.Array:  # rows are y, columns x
        field = jnp.where(mirror_x, field[:, ::-1], field)
        field = jnp.where(mirror_y, field[::-1], field)
        return jnp.where(swap, jnp.swapaxes(field, 0, 1), field)

    x, y, yaw = transition.action.pose
    x, yaw = jnp.where(mirror_x, -x, x), jnp.where(mirror_x, np.float32(np.pi) - yaw, yaw)
    y, yaw = jnp.where(mirror_y, -y, y), jnp.where(mirror_y, -yaw, yaw)
    x, y = jnp.where(swap, y, x), jnp.where(swap, x, y)
    yaw = jnp.where(swap, np.float32(0.5 * np.pi) - yaw, yaw)
    pose = jnp.stack([x, y, geometry.wrap_angle(yaw)])
    return transition.replace(
        obs=jax.tree.map(view, transition.obs),
        next_obs=jax.tree.map(view, transition.next_obs),
        action=transition.action.replace(pose=pose),
    )


def random_symmetry(key: jax.Array, transition: Transition) -> Transition:
    """The transition under one of the eight symmetries, each equally likely."""
    return apply_symmetry(transition, *jax.random.bernoulli(key, shape=(3,)))


def shift_and_rotate(
    cfg: Config, transition: Transition, yaw: jax.Array, cells: jax.Array
) -> Transition:
    """The transition rotated by `yaw` [] rad about the workspace centre, then shifted.

    `cells` [2] int32 are (row, col). The transition stays as it is where that would cut something
    off: a surface higher than BARE in either map, the place of the action or the end of a push. It
    also stays if the workspace already cut off the push. Cells that come in are bare table; where
    the net is shown the border they lie beyond it, and the border moves along. A side that moves
    out of sight is still there: blocks keep CLEARANCE to it.
    """
    pose = transition.action.pose
    step = cells[::-1].astype(jnp.float32) * cfg.heightmap.cell  # x, y
    xy = geometry.rotate2d(yaw, pose[:2]) + step
    new_pose = jnp.append(xy, geometry.wrap_angle(pose[2] + yaw))
    primitive = transition.action.primitive
    fits = _reaches(cfg, primitive, pose) & _reaches(cfg, primitive, new_pose)
    for obs in (transition.obs, transition.next_obs):
        fits &= _stays(cfg, heightmap.unpack(obs).height, yaw, step)
    moved = transition.replace(
        obs=_move_maps(cfg, transition.obs, yaw, cells),
        next_obs=_move_maps(cfg, transition.next_obs, yaw, cells),
        action=transition.action.replace(pose=new_pose),
    )
    return jax.tree.map(lambda new, old: jnp.where(fits, new, old), moved, transition)


def _reaches(cfg: Config, primitive: jax.Array, pose: jax.Array) -> jax.Array:
    """Whether an action at a pose [3] runs its full length above the workspace, [] bool."""
    length = jnp.where(primitive == Primitive.PUSH, cfg.sim.push_length, 0.0)
    end = pose[:2] + length * jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
    return jnp.all(jnp.maximum(jnp.abs(pose[:2]), jnp.abs(end)) <= 0.5 * cfg.heightmap.extent)


def _stays(cfg: Config, height: jax.Array, yaw: jax.Array, step: jax.Array) -> jax.Array:
    """Whether all blocks of a map [H, W] m stay above the workspace, rotated, then shifted by
    `step` [2] m; [] bool."""
    place = geometry.rotate2d(yaw, geometry.cell_centres(cfg.heightmap)) + step[None, None]
    half = 0.5 * cfg.heightmap.extent
    low, high = jnp.full(2, half), jnp.full(2, half)  # m, room towards -x, -y and +x, +y
    if cfg.net.border:
        rotated = jnp.broadcast_to(yaw != 0.0, (2,))
        low = jnp.where((step < 0.0) | rotated, half - CLEARANCE, half)
        high = jnp.where((step > 0.0) | rotated, half - CLEARANCE, half)
    stays = jnp.all((-place <= low[None, None]) & (place <= high[None, None]), axis=-1)
    return jnp.all((height <= BARE) | stays)


def _move_maps(
    cfg: Config, obs: PackedObservation, yaw: jax.Array, cells: jax.Array
) -> PackedObservation:
    """Maps rotated, then shifted, from the nearest cell; cells that come in look like the lowest
    one."""
    size = obs.height.shape[0]
    along = jnp.arange(size, dtype=jnp.float32) + 0.5 - 0.5 * size  # cells from the centre
    y, x = (along - shift.astype(jnp.float32) for shift in cells)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    col = jnp.floor(cos * x[None] + sin * y[:, None] + 0.5 * size).astype(jnp.int32)
    row = jnp.floor(-sin * x[None] + cos * y[:, None] + 0.5 * size).astype(jnp.int32)
    inside = (row >= 0) & (row < size) & (col >= 0) & (col < size)
    source = jnp.where(inside, row * size + col, jnp.argmin(obs.height).astype(jnp.int32))

    def take(field: jax.Array) -> jax.Array:
        return field.reshape(size * size, *field.shape[2:]).at[source].get(mode="promise_in_bounds")

    beyond = jnp.uint16(heightmap.BEYOND_COUNT if cfg.net.border else 0)
    return PackedObservation(
        colour=take(obs.colour),
        height=jnp.where(inside, take(obs.height), beyond),
        target=jnp.where(inside, take(obs.target), jnp.all(obs.target)),
    )


def augment(key: jax.Array, cfg: Config, transition: Transition) -> Transition:
    """The transition augmented as the config says."""
    learn, key_move = cfg.learn, jax.random.fold_in(key, 1)
    if learn.augment:
        transition = random_symmetry(key, transition)
    if learn.augment_shift == 0 and learn.augment_turn == 0.0:
        return transition
    key_yaw, key_cells = jax.random.split(key_move)
    yaw = learn.augment_turn * jax.random.uniform(key_yaw, (), minval=-1.0)
    cells = jax.random.randint(key_cells, (2,), -learn.augment_shift, learn.augment_shift + 1)
    return shift_and_rotate(cfg, transition, yaw, cells)
