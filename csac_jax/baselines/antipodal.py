"""Antipodal grasps from the edges of a height map: a geometric baseline without networks.

For every place and yaw, the map is read along the closing direction. Between the open fingers lies
what is higher than the tips will be; its outermost edges are where the fingers meet it. A grasp is
good where both edges are square to the fingers, and both fingers come down on free ground.

K = yaws over half a turn, S = cells along a side of the rotated maps, D = cells from the middle of
the hand to the far side of a finger.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax import grippers
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.grippers import Gripper
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


class Profile(NamedTuple):
    """Surface on one side of the middle of the hand, [K, S, S] each."""

    edge: jax.Array  # m, farthest that is above the tips; 0 where nothing is
    filled: jax.Array  # m, of the way there that is above the tips
    tilt: jax.Array  # rad, of the edge against the pad
    free: jax.Array  # bool, the finger comes down on free ground


def grasp(
    key: jax.Array,
    cfg: Config,
    height: jax.Array,
    wanted: jax.Array,
    failures: jax.Array,
    weights: Weights,
) -> Action:
    """Returns the best antipodal grasp of a height map, within the robot's reach.

    Args: height [H, W] m; wanted [H, W] bool, where the middle of the hand may be; failures [],
    actions in a row that lifted nothing.
    """
    yaws = np.arange(YAWS) * np.pi / YAWS
    places = _places(cfg, yaws)  # [K, S, S, 2] m
    maps = _sampled(cfg, height, places)
    score = _scores(cfg, grippers.load(cfg.sim.gripper), maps, weights)
    inside = (np.abs(places) < 0.5 * cfg.heightmap.extent).all(axis=-1)
    there = _sampled(cfg, wanted.astype(jnp.float32), places) > 0.5
    noise = weights.noise * failures.astype(jnp.float32)
    score += noise * jax.random.uniform(key, score.shape)
    allowed = jnp.where(there & inside, score, -jnp.inf)
    values, cells = jax.lax.top_k(allowed.reshape(-1), CANDIDATES)
    xy = jnp.asarray(places, jnp.float32).reshape(-1, 2)[cells]
    yaw = jnp.asarray(yaws, jnp.float32)[cells // maps[0].size]
    kind = jnp.int32(Primitive.GRASP)
    reached = jax.vmap(functools.partial(reachable, cfg.sim, cfg.heightmap, kind))(xy, yaw)
    best = jnp.argmax(jnp.where(reached, values, -jnp.inf))
    return Action(primitive=kind, pose=jnp.append(xy[best], yaw[best]))


def _places(cfg: Config, yaws: np.ndarray) -> np.ndarray:
    """Returns the cells of the rotated maps [K, S, S, 2] m; columns run along the yaw."""
    side = int(np.ceil(np.sqrt(2.0) * cfg.heightmap.size))
    along = (np.arange(side) - 0.5 * (side - 1)) * cfg.heightmap.cell
    across, ahead = np.meshgrid(along, along, indexing="ij")
    cos, sin = np.cos(yaws)[:, None, None], np.sin(yaws)[:, None, None]
    return np.stack([cos * ahead - sin * across, sin * ahead + cos * across], axis=-1)


def _sampled(cfg: Config, values: jax.Array, places: np.ndarray) -> jax.Array:
    """Samples a map [H, W] at places [K, S, S, 2] m, 0 outside of it; [K, S, S]."""
    cells = places / cfg.heightmap.cell + 0.5 * (cfg.heightmap.size - 1)
    row_col = [jnp.asarray(cells[..., axis], jnp.float32) for axis in (1, 0)]
    return jax.scipy.ndimage.map_coordinates(values, row_col, order=1)


def _scores(cfg: Config, gripper: Gripper, maps: jax.Array, weights: Weights) -> jax.Array:
    """Scores the grasp above each cell, [K, S, S]; very low where a finger collides."""
    cell = cfg.heightmap.cell
    reach = round(0.5 * gripper.finger[1] / cell)  # rows that a finger covers on either side
    top = _window(_window(maps, -1, reach), -2, reach)
    depth = grasp_depth(cfg.sim, gripper)
    tip = jnp.maximum(top - depth, lowest(cfg.sim, gripper))
    hand = Hand(gripper, cell, reach, tip, jnp.maximum(top - tip, 1e-4))
    sides = [_profile(hand, maps, way) for way in (1, -1)]
    width = sides[0].edge + sides[1].edge
    between = [_covered(hand, _shifted(maps, -2, row)) for row in range(-reach, reach + 1)]
    held = sum(between[1:], between[0]) / len(between)
    good = weights.grip * held * jnp.minimum(top - tip, depth)
    bad = weights.tilt * (sides[0].tilt + sides[1].tilt) + weights.width * width
    bad += weights.offset * jnp.abs(sides[0].filled - sides[1].filled)
    bad += weights.middle * _aside(hand, maps)
    fits = (width < gripper.opening[1] - cell) & (top > jnp.maximum(tip, BARE))
    possible = sides[0].free & sides[1].free & fits
    return good - bad - jnp.where(possible, 0.0, 1e3)


class Hand(NamedTuple):
    """Hand above every cell."""

    gripper: Gripper
    cell: float  # m
    reach: int  # rows that a finger covers on either side
    tip: jax.Array  # [K, S, S] m, how high the tips are
    below: jax.Array  # [K, S, S] m, the same below the surface, above 0

    @property
    def inner(self) -> int:
        """Returns the cells from the middle to an open finger."""
        return int(self.gripper.half[1] / self.cell)


def _covered(hand: Hand, maps: jax.Array) -> jax.Array:
    """Returns the share of the cell above the tips [K, S, S]: edges lie between cells."""
    return jnp.clip((maps - hand.tip) / hand.below, 0.0, 1.0)


def _profile(hand: Hand, maps: jax.Array, way: int) -> Profile:
    """Measures the side that one finger meets, `way` 1 ahead or -1 behind."""
    gripper, cell = hand.gripper, hand.cell
    room = gripper.footprint[0] + 0.5 * cell
    under = gripper.half[1] + 0.5 * gripper.finger[0]  # m, middle of the finger
    rows = [_shifted(maps, -2, row) for row in (-hand.reach, hand.reach)]
    wide, edge = _window(maps, -2, hand.reach), jnp.zeros_like(maps)
    filled = 0.5 * cell * _covered(hand, wide)
    ends = [0.5 * cell * _covered(hand, row) for row in rows]
    for number in range(1, hand.inner + 1):
        beyond = _shifted(wide, -1, way * number)
        edge = jnp.where(beyond > hand.tip, (number + 0.5) * cell, edge)
        filled += cell * _covered(hand, beyond)
        ends = [
            end + cell * _covered(hand, _shifted(row, -1, way * number))
            for end, row in zip(ends, rows, strict=True)
        ]
    free = jnp.ones(maps.shape, bool)
    for number in range(int((under - room) / cell), int((under + room) / cell) + 1):
        free &= _shifted(wide, -1, way * number) < hand.tip
    tilt = jnp.arctan2(jnp.abs(ends[1] - ends[0]), 2.0 * hand.reach * cell)
    return Profile(edge, filled, tilt, free)


def _aside(hand: Hand, maps: jax.Array) -> jax.Array:
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


def _shifted(maps: jax.Array, axis: int, cells: int) -> jax.Array:
    """Shifts by `cells` along `axis`: each takes the value ahead. Maps are 0 at their rims."""
    return jnp.roll(maps, -cells, axis)


def _window(maps: jax.Array, axis: int, reach: int) -> jax.Array:
    """Returns the highest value within `reach` cells along `axis`."""
    shifted = [_shifted(maps, axis, cells) for cells in range(-reach, reach + 1)]
    return jnp.max(jnp.stack(shifted), axis=0)
