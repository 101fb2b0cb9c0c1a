"""Augmentation of transitions: the eight symmetries of the square workspace, shifts by whole cells,
turns.

Symmetries, shifts and quarter turns are exact, cell by cell. Any other turn is exact in place and
yaw of the action; the maps are turned to the nearest cell, so that what a cell shows lies up to
half a cell a side beside it. In each of them the light stays where it is: sloping faces keep their
brightness.
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
from csac_jax.vision.heightmap import PackedObservation

CLEAR = (
    0.05  # m from a side that what stands must keep where the border is shown and that side is none
)


def turn_over(
    transition: Transition, mirror_x: jax.Array, mirror_y: jax.Array, swap: jax.Array
) -> Transition:
    """The transition seen with x mirrored, then y mirrored, then x and y swapped, where the flags
    [] bool say so."""

    def view(field: jax.Array) -> jax.Array:  # rows are y, columns x
        field = jnp.where(mirror_x, field[:, ::-1], field)
        field = jnp.where(mirror_y, field[::-1], field)
        return jnp.where(swap, jnp.swapaxes(field, 0, 1), field)

    x, y, yaw = transition.action.pose
    x, yaw = jnp.where(mirror_x, -x, x), jnp.where(mirror_x, np.float32(np.pi) - yaw, yaw)
    y, yaw = jnp.where(mirror_y, -y, y), jnp.where(mirror_y, -yaw, yaw)
    x, y, yaw = (
        jnp.where(swap, y, x),
        jnp.where(swap, x, y),
        jnp.where(swap, np.float32(0.5 * np.pi) - yaw, yaw),
    )
    pose = jnp.stack([x, y, geometry.wrap_angle(yaw)])
    return transition.replace(
        obs=jax.tree.map(view, transition.obs),
        next_obs=jax.tree.map(view, transition.next_obs),
        action=transition.action.replace(pose=pose),
    )


def randomly(key: jax.Array, transition: Transition) -> Transition:
    """The transition under one of the eight symmetries, each equally likely."""
    return turn_over(transition, *jax.random.bernoulli(key, shape=(3,)))


def move(cfg: Config, transition: Transition, yaw: jax.Array, cells: jax.Array) -> Transition:
    """The transition turned about the workspace centre by `yaw` [] rad, then shifted by `cells` [2]
    int32 (row, col).

    As it was where that would cut something off: something higher than BARE in either map, the
    place of the action, or the end of a push, which the workspace must not have cut off before
    either. What comes in from beside the workspace is bare table; or, where the net is shown the
    border, beyond it: the border moves along. Sides that the move pushes out of sight are where it
    is not: what stands keeps CLEAR of them.
    """
    pose = transition.action.pose
    step = cells[::-1].astype(jnp.float32) * cfg.heightmap.cell  # x, y
    xy = geometry.rotate2d(yaw, pose[:2]) + step
    turned = jnp.append(xy, geometry.wrap_angle(pose[2] + yaw))
    whole = _reaches(cfg, transition.action.primitive, pose) & _reaches(
        cfg, transition.action.primitive, turned
    )
    for obs in (transition.obs, transition.next_obs):
        whole &= _stays(cfg, heightmap.unpack(obs).height, yaw, step)
    moved = transition.replace(
        obs=_moved_map(cfg, transition.obs, yaw, cells),
        next_obs=_moved_map(cfg, transition.next_obs, yaw, cells),
        action=transition.action.replace(pose=turned),
    )
    return jax.tree.map(lambda new, old: jnp.where(whole, new, old), moved, transition)


def _reaches(cfg: Config, primitive: jax.Array, pose: jax.Array) -> jax.Array:
    """Whether an action at a pose [3] runs its full length above the workspace, [] bool."""
    length = jnp.where(primitive == Primitive.PUSH, cfg.sim.push_length, 0.0)
    end = pose[:2] + length * jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
    return jnp.all(jnp.maximum(jnp.abs(pose[:2]), jnp.abs(end)) <= 0.5 * cfg.heightmap.extent)


def _stays(cfg: Config, height: jax.Array, yaw: jax.Array, step: jax.Array) -> jax.Array:
    """Whether all that stands on the map [H, W] m stays above the workspace, turned and shifted by
    `step` [2] m."""
    place = geometry.rotate2d(yaw, geometry.cell_centres(cfg.heightmap)) + step[None, None]
    half = 0.5 * cfg.heightmap.extent
    low, high = jnp.full(2, half), jnp.full(2, half)  # room towards -x, -y and +x, +y
    if cfg.net.border:
        turned = jnp.broadcast_to(yaw != 0.0, (2,))
        low = jnp.where((step < 0.0) | turned, half - CLEAR, half)
        high = jnp.where((step > 0.0) | turned, half - CLEAR, half)
    stays = jnp.all((-place <= low[None, None]) & (place <= high[None, None]), axis=-1)
    return jnp.all((height <= BARE) | stays)


def _moved_map(
    cfg: Config, obs: PackedObservation, yaw: jax.Array, cells: jax.Array
) -> PackedObservation:
    """Maps turned and then shifted, from the nearest cell; what comes in from beside looks like the
    lowest cell."""
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

    return PackedObservation(
        colour=take(obs.colour),
        height=jnp.where(
            inside, take(obs.height), jnp.uint16(heightmap.BEYOND_COUNT if cfg.net.border else 0)
        ),
        target=jnp.where(inside, take(obs.target), jnp.all(obs.target)),
    )


def vary(key: jax.Array, cfg: Config, transition: Transition) -> Transition:
    """The transition as the learner is shown it: augmented as the config says."""
    learn, key_move = cfg.learn, jax.random.fold_in(key, 1)
    if learn.augment:
        transition = randomly(key, transition)
    if learn.augment_shift == 0 and learn.augment_turn == 0.0:
        return transition
    key_yaw, key_cells = jax.random.split(key_move)
    yaw = learn.augment_turn * jax.random.uniform(key_yaw, (), minval=-1.0)
    cells = jax.random.randint(key_cells, (2,), -learn.augment_shift, learn.augment_shift + 1)
    return move(cfg, transition, yaw, cells)
