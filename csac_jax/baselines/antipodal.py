"""Antipodal grasps from the edges of a height map: a geometric baseline without networks.

A grasp is good where the outermost edges between the fingers, higher than the tips will be, are
square to the fingers, and both fingers come down on free ground. With `sim.opening fit` the edges
are those of what is at the middle, and the ground is that beside it.

K = yaws over half a turn, S = cells along a side of the rotated maps, D = cells from the middle of
the hand to the far side of a finger.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from csac_jax import grippers
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.grippers import Gripper
from csac_jax.robot.fit import ROOM
from csac_jax.robot.primitives import Action, grasp_depth, lowest, reachable
from csac_jax.sim.outcome import BARE

YAWS = 16  # over half a turn: the hand is symmetric
CANDIDATES = 1024  # best grasps, of which the best within reach is chosen


@struct.dataclass
class Weights:
    """Costs of a grasp's flaws, ours; the noise only helps where two failures do not end the
    episode."""

    tilt: float = 2.0  # of an edge against the pad, per rad
    offset: float = 10.0  # of the held part's middle from the hand's, along the closing, per m
    middle: float = 10.0  # the same across, where the hand would turn what it lifts
    width: float = 2.5  # per m
    grip: float = 20.0  # gain per m that the tips reach below what lies between the pads
    noise: float = 0.5  # random, per failure: another grasp is tried


def grasp(
    key: Array, cfg: Config, height: Array, wanted: Array, failures: Array, weights: Weights
) -> Action:
    """Returns the best antipodal grasp of a map `height` [H, W] m, within the robot's reach.

    Args: wanted [H, W] bool, where the hand may be; failures [], actions that lifted nothing.
    """
    yaws = np.arange(YAWS) * np.pi / YAWS
    places = _places(cfg, yaws)  # [K, S, S, 2] m
    maps = _sampled(cfg, height, places)
    score = _scores(cfg, grippers.load(cfg.sim.gripper), maps, weights)
    side = cfg.scene.tray or cfg.heightmap.extent
    inside = (np.abs(places) < 0.5 * side).all(axis=-1)
    there = _sampled(cfg, wanted.astype(jnp.float32), places) > 0.5
    noise = weights.noise * failures.astype(jnp.float32)
    score += noise * jax.random.uniform(key, score.shape)
    allowed = jnp.where(there & inside, score, -jnp.inf)
    values, cells = jax.lax.top_k(allowed.reshape(-1), CANDIDATES)
    xy = jnp.asarray(places, jnp.float32).reshape(-1, 2)[cells]
    yaw = jnp.asarray(yaws, jnp.float32)[cells // maps[0].size]
    reached = jax.vmap(functools.partial(reachable, cfg.sim, cfg.heightmap))(xy, yaw)
    best = jnp.argmax(jnp.where(reached[:, Primitive.GRASP], values, -jnp.inf))
    return Action(primitive=jnp.int32(Primitive.GRASP), pose=jnp.append(xy[best], yaw[best]))


def _places(cfg: Config, yaws: np.ndarray) -> np.ndarray:
    """Returns the cells of the rotated maps [K, S, S, 2] m; columns run along the yaw."""
    side = int(np.ceil(np.sqrt(2.0) * cfg.heightmap.size))
    along = (np.arange(side) - 0.5 * (side - 1)) * cfg.heightmap.cell
    across, ahead = np.meshgrid(along, along, indexing="ij")
    cos, sin = np.cos(yaws)[:, None, None], np.sin(yaws)[:, None, None]
    return np.stack([cos * ahead - sin * across, sin * ahead + cos * across], axis=-1)


def _sampled(cfg: Config, values: Array, places: np.ndarray) -> Array:
    """Samples a map [H, W] at places [K, S, S, 2] m, 0 outside of it."""
    cells = places / cfg.heightmap.cell + 0.5 * (cfg.heightmap.size - 1)
    row_col = [jnp.asarray(cells[..., axis], jnp.float32) for axis in (1, 0)]
    return jax.scipy.ndimage.map_coordinates(values, row_col, order=1)


def _scores(cfg: Config, gripper: Gripper, maps: Array, weights: Weights) -> Array:
    """Scores the grasp above each cell, [K, S, S]; very low where a finger collides."""
    cell = cfg.heightmap.cell
    reach = round(0.5 * gripper.finger[1] / cell)  # rows that a finger covers on either side
    top = _window(_window(maps, -1, reach), -2, reach)
    depth = grasp_depth(cfg.sim, gripper)
    tip = jnp.maximum(top - depth, lowest(cfg.sim, gripper))
    inner = int(gripper.half[1] / cell)
    fit = cfg.sim.opening == "fit"
    hand = Hand(gripper, cell, reach, tip, jnp.maximum(top - tip, 1e-4), inner, fit)
    edges, filled, tilts, free = zip(*(_profile(hand, maps, way) for way in (1, -1)), strict=True)
    width = sum(edges)
    between = [_covered(hand, _shifted(maps, -2, row)) for row in range(-reach, reach + 1)]
    held = sum(between[1:], between[0]) / len(between)
    good = weights.grip * held * jnp.minimum(top - tip, depth)
    bad = weights.tilt * sum(tilts) + weights.width * width
    bad += weights.offset * jnp.abs(filled[0] - filled[1])
    bad += weights.middle * _aside(hand, maps)
    fits = (width < gripper.opening[1] - cell) & (top > jnp.maximum(tip, BARE))
    return good - bad - jnp.where(free[0] & free[1] & fits, 0.0, 1e3)


class Hand(NamedTuple):
    """Hand above every cell."""

    gripper: Gripper
    cell: float  # m
    reach: int  # rows that a finger covers on either side
    tip: Array  # [K, S, S] m, how high the tips are
    below: Array  # [K, S, S] m, the same below the surface, above 0
    inner: int  # cells from the middle to an open finger
    fit: bool  # it opens about what is at the middle


def _covered(hand: Hand, maps: Array) -> Array:
    """Returns the share of the cell above the tips [K, S, S]: edges lie between cells."""
    return jnp.clip((maps - hand.tip) / hand.below, 0.0, 1.0)


def _profile(hand: Hand, maps: Array, way: int) -> tuple[Array, Array, Array, Array]:
    """Measures the surface that one finger meets, `way` 1 ahead or -1 behind, [K, S, S] each.

    Returns: m to the farthest cell above the tips, 0 if there is none; m of the way there that are
    above the tips; rad of that edge against the pad; bool, the finger comes down on free ground.
    """
    gripper, cell = hand.gripper, hand.cell
    room = gripper.footprint[0] + 0.5 * cell
    under = gripper.half[1] + 0.5 * gripper.finger[0]  # m, middle of the finger
    rows = [_shifted(maps, -2, row) for row in (-hand.reach, hand.reach)]
    wide, edge = _window(maps, -2, hand.reach), jnp.zeros_like(maps)
    gap, own = jnp.zeros_like(maps), jnp.ones(maps.shape, bool)
    filled = 0.5 * cell * _covered(hand, wide)
    ends = [0.5 * cell * _covered(hand, row) for row in rows]
    for number in range(1, hand.inner + 1):
        beyond = _shifted(wide, -1, way * number)
        if hand.fit:
            own &= (beyond < hand.tip) | (gap < 1.5 * cell)  # a gap of a cell is none
            gap = jnp.where(own, jnp.where(beyond < hand.tip, gap + cell, 0.0), gap)
        edge = jnp.where(own & (beyond > hand.tip), (number + 0.5) * cell, edge)
        filled += cell * _covered(hand, jnp.where(own, beyond, 0.0))
        ends = [
            end + cell * _covered(hand, jnp.where(own, _shifted(row, -1, way * number), 0.0))
            for end, row in zip(ends, rows, strict=True)
        ]
    free = jnp.ones(maps.shape, bool)
    for number in range(int((under - room) / cell), int((under + room) / cell) + 1):
        free &= _shifted(wide, -1, way * number) < hand.tip
    if hand.fit:
        free = (free & own) | (gap >= ROOM + gripper.finger[0])
    tilt = jnp.arctan2(jnp.abs(ends[1] - ends[0]), 2.0 * hand.reach * cell)
    return edge, filled, tilt, free


def _aside(hand: Hand, maps: Array) -> Array:
    """Measures the offset of the held part's middle across the closing [K, S, S] m."""
    lengths = []
    for way in (1, -1):
        connected = _covered(hand, maps)
        length = 0.5 * hand.cell * connected
        for number in range(1, hand.inner + 1):
            connected = connected * _covered(hand, _shifted(maps, -2, way * number))
            length += hand.cell * connected
        lengths.append(length)
    return 0.5 * jnp.abs(lengths[0] - lengths[1])


def _shifted(maps: Array, axis: int, cells: int) -> Array:
    return jnp.roll(maps, -cells, axis)  # each takes the value ahead; maps are 0 at their rims


def _window(maps: Array, axis: int, reach: int) -> Array:
    shifted = [_shifted(maps, axis, cells) for cells in range(-reach, reach + 1)]
    return jnp.max(jnp.stack(shifted), axis=0)
