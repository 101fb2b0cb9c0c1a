"""Families of packed arrangements: each is an ordered list of roles and their places.

Each role takes a random free slot of its kinds. The shipped cases are held out by construction:
no family is a row, a ridge, a ring or a nest, or packs two arches, as `row`, `pinwheel` and `hole`
do, or two prisms, as `ridge`. R = the 5 roles, N = block slots.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from csac_jax.config import MESH_KINDS, SlotKind
from csac_jax.errors import SceneError

ROLES = 5  # of every family
STACKED_GAP = 0.008  # m, widest gap that a block may bridge
STACK_OFFSET = 0.003  # m, how far off the middle a stacked block may lie
SUPPORT = 0.015  # m, how far a bridge's deck reaches onto its piers
WIDE_GAP = 0.040  # m
# Of stairs: metres farther along per metre sideways, for touching blocks and for a gap of WIDE_GAP.
SLANTS = (0.7, 1.0)
FAN_ANGLES = (np.deg2rad(50.0), np.deg2rad(70.0))  # between the ribs of a fan, likewise
WEDGE_ANGLE = np.deg2rad(40.0)  # between an arm of a wedge and its middle


class Role(NamedTuple):
    """The blocks that may take one place of a family."""

    kinds: tuple[SlotKind, ...]
    long: bool = False  # a box is a cuboid or a plank
    on_side: float = 0.0  # probability of a quarter turn about the long axis, of a box or an arch


class Placed(NamedTuple):
    """Places of a family's blocks, before the arrangement is rotated and shifted as a whole."""

    xy: Array  # [R, 2] m
    crosswise: Array  # [R] bool, rotated by a quarter turn about z
    target: Array  # [] int32, role of the block that is hardest to reach
    floor: Array | float = 0.0  # [R] m, height of the surface that carries the block
    yaw: Array | float = 0.0  # [R] rad, in addition to the quarter turn


class Family(NamedTuple):
    """A way of packing. The kinds of a role contain those of each role before it, or none."""

    roles: tuple[Role, Role, Role, Role, Role]
    needed: int  # the first so many roles make the arrangement; the others may be left out
    # From draws, half extents [R, 3] m as the blocks lie, used [R] bool and gap [] m:
    place: Callable[["Draws", Array, Array, Array], Placed]
    # Half sizes [R, 3] m of blocks that fit, from those drawn:
    resize: Callable[[Array], Array] = lambda half: half


class Draws(NamedTuple):
    """The randomness of a packing, uniform; the same draws serve every family."""

    preference: Array  # [N] 0..1, slots with more are taken first
    optional: Array  # [] 0..1, how many optional roles are used
    gap: Array  # [] 0..1
    on_side: Array  # [R] 0..1
    order: Array  # [R] 0..1, along a line
    crosswise: Array  # [R] bool
    jitter: Array  # [R, 2] -1..1


def available(slots: tuple[SlotKind, ...]) -> dict[str, Family]:
    """Selects the families that these slots allow. Raises SceneError if there are none."""
    possible = {name: family for name, family in FAMILIES.items() if _is_possible(family, slots)}
    if not possible:
        raise SceneError("scene.slots: too few for an arrangement; three boxes are enough")
    return possible


def _is_possible(family: Family, slots: tuple[SlotKind, ...]) -> bool:
    free = list(slots)
    for role in family.roles[: family.needed]:  # roles of fewer kinds are first: greedy is exact
        fitting = [kind for kind in free if kind in role.kinds]
        if not fitting:
            return False
        free.remove(fitting[0])
    return True


def draw(key: Array, num_slots: int) -> Draws:
    """Draws all noise of a packing in one call of the generator: each call is slow to compile."""
    noise = jax.random.uniform(key, (num_slots + 2 + 5 * ROLES,))
    preference, (optional, gap), roles = jnp.split(noise, [num_slots, num_slots + 2])
    on_side, order, crosswise, *jitter = roles.reshape(5, ROLES)
    offsets = 2.0 * jnp.stack(jitter, axis=1) - 1.0
    return Draws(preference, optional, gap, on_side, order, crosswise < 0.5, offsets)


def _half_xy(half: Array, crosswise: Array) -> Array:
    return jnp.where(crosswise[:, None], half[:, 1::-1], half[:, :2])


def _line(noise: Array, width: Array, used: Array, gap: Array) -> tuple[Array, Array]:
    """Computes centres [R] m about 0 of blocks along a line, and the number of the middle one [].

    Args: noise [R] orders the blocks; width [R] m, half widths.
    """
    index = np.arange(ROLES)
    # Ties of noise, in one scene of a million, are broken by number.
    is_tie = (noise[None] == noise[:, None]) & (index[None] < index[:, None])
    before = used[None] & ((noise[None] < noise[:, None]) | is_tie)  # [i, j]: j comes before i
    step = jnp.where(used, 2.0 * width + gap, 0.0)
    start = jnp.sum(jnp.where(before, step[None], 0.0), axis=1)
    is_middle = used & (jnp.sum(before, axis=1) == jnp.sum(used) // 2)
    return start + 0.5 * (step - jnp.sum(step)), jnp.argmax(is_middle).astype(jnp.int32)


def _by_gap(ends: tuple[float, float], gap: Array) -> Array:
    touching, wide = (np.float32(end) for end in ends)
    return touching + (wide - touching) * gap / np.float32(WIDE_GAP)


def _place_wall(draws: Draws, half: Array, used: Array, gap: Array) -> Placed:
    """Places two like bricks end to end, a block across their joint, one along each face."""
    crosswise = draws.crosswise & _is_role(3, 4)
    half_xy, joint = _half_xy(half, crosswise), jnp.minimum(gap, STACKED_GAP)
    face = jnp.maximum(half[0, 1], half[2, 1] + STACK_OFFSET) + gap
    zero = jnp.zeros_like(gap)
    end = half[0, 0] + 0.5 * joint
    x = jnp.stack([-end, end, zero, zero, zero])
    y = jnp.stack([zero, zero, zero, face + half_xy[3, 1], -face - half_xy[4, 1]])
    return _stacked(x, y, crosswise, draws, {2: 2.0 * half[0, 2]}, target=0)


def _place_stairs(draws: Draws, half: Array, used: Array, gap: Array) -> Placed:
    """Places two flights of stairs: each block begins farther along than its inner neighbour."""
    y, middle = _line(draws.order, half[:, 1], used, gap)
    slant = _by_gap(SLANTS, gap)
    return Placed(jnp.stack([slant * jnp.abs(y), y], axis=1), jnp.zeros_like(used), middle)


def _place_fan(draws: Draws, half: Array, used: Array, gap: Array) -> Placed:
    """Places the ribs of a fan: each points away from one place, as near as neighbours allow."""
    between = _by_gap(FAN_ANGLES, gap)
    sin, cos = jnp.sin(0.5 * between), jnp.cos(0.5 * between)
    away = (0.5 * gap + half[:, 1] * cos) / sin + half[:, 0]
    number = jnp.sum(used)
    rib = np.arange(ROLES, dtype=np.float32)
    angle = between * (rib - 0.5 * (number.astype(jnp.float32) - 1.0))
    xy = away[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    middle = ((number - 1) // 2).astype(jnp.int32)
    return Placed(xy, jnp.zeros_like(used), middle, yaw=jnp.asarray(angle))


def _place_bridge(draws: Draws, half: Array, used: Array, gap: Array) -> Placed:
    """Places two like piers, a deck from one to the other, a block along each side."""
    crosswise = _is_role(0, 1)
    half_xy, zero = _half_xy(half, crosswise), jnp.zeros_like(gap)
    pier = half[2, 0] - SUPPORT + half_xy[0, 0]
    side = jnp.maximum(half_xy[0, 1], half[2, 1] + STACK_OFFSET) + gap
    x = jnp.stack([-pier, pier, zero, zero, zero])
    y = jnp.stack([zero, zero, zero, side + half_xy[3, 1], -side - half_xy[4, 1]])
    return _stacked(x, y, crosswise, draws, {2: 2.0 * half[0, 2]}, target=2)


def _place_tower(draws: Draws, half: Array, used: Array, gap: Array) -> Placed:
    """Places three blocks on one another, crosswise in turn, and one at either end."""
    crosswise = _is_role(1)
    half_xy, zero = _half_xy(half, crosswise), jnp.zeros_like(gap)
    end = jnp.max(half_xy[:3, 0]) + STACK_OFFSET + gap  # what is on top may reach farther
    x = jnp.stack([zero, zero, zero, end + half_xy[3, 0], -end - half_xy[4, 0]])
    floors = {1: 2.0 * half[0, 2], 2: 2.0 * (half[0, 2] + half[1, 2])}
    return _stacked(x, jnp.zeros_like(x), crosswise, draws, floors, target=1)


def _place_wedge(draws: Draws, half: Array, used: Array, gap: Array) -> Placed:
    """Places two blocks in a V, one between them, one behind the tip, one along the outside."""
    sin, cos = np.float32(np.sin(WEDGE_ANGLE)), np.float32(np.cos(WEDGE_ANGLE))
    along, out = np.array([cos, sin]), np.array([-sin, cos])
    mirror = np.array([1.0, -1.0], np.float32)

    def arm(role: int, beyond: Array) -> Array:
        return (0.5 * gap / sin + half[role, 0]) * along + (beyond + half[role, 1]) * out

    zero = jnp.zeros_like(gap)
    inside = (gap + half[2, 1] * cos) / sin + half[2, 0]
    tip = 0.5 * gap / sin * cos - 2.0 * sin * jnp.max(half[:2, 1])  # where the outsides begin
    between = jnp.stack([inside, zero])
    behind = jnp.stack([jnp.minimum(tip, 0.0) - gap - half[3, 0], zero])
    outside = arm(4, 2.0 * half[0, 1] + gap)
    xy = jnp.stack([arm(0, zero), mirror * arm(1, zero), between, behind, outside])
    yaw = np.array([1.0, -1.0, 0.0, 0.0, 1.0], np.float32) * np.float32(WEDGE_ANGLE)
    return Placed(xy, jnp.zeros_like(used), jnp.int32(2), yaw=jnp.asarray(yaw))


def _place_corner(draws: Draws, half: Array, used: Array, gap: Array) -> Placed:
    """Places two blocks in an L, one in its corner, one beyond that along either leg."""
    crosswise = _is_role(1)
    leg, high = _half_xy(half, crosswise)[1], jnp.maximum(half[2, 1], half[3, 1])
    beyond = 2.0 * half[2, 0] + gap + half[3, 0], 2.0 * (gap + high) + half[4, 1]
    x = jnp.stack([half[0, 0], -gap - leg[0], half[2, 0], beyond[0], half[4, 0]])
    y = jnp.stack([-half[0, 1], leg[1], gap + half[2, 1], gap + half[3, 1], beyond[1]])
    return Placed(jnp.stack([x, y], axis=1), crosswise, jnp.int32(2))


def _place_bin(draws: Draws, half: Array, used: Array, gap: Array) -> Placed:
    """Places a back and two sides, open in front, a block inside, and one behind the back."""
    crosswise = _is_role(1, 2)
    half_xy, zero = _half_xy(half, crosswise), jnp.zeros_like(gap)
    side = half[3, 0] + gap + half_xy[1:3, 0]
    x = jnp.stack([zero, side[0], -side[1], zero, zero])
    back = -2.0 * half[0, 1] - gap - half[4, 1]
    y = jnp.stack([-half[0, 1], half_xy[1, 1], half_xy[2, 1], gap + half[3, 1], back])
    return Placed(jnp.stack([x, y], axis=1), crosswise, jnp.int32(3))


def _is_role(*numbers: int) -> Array:
    return jnp.asarray(np.isin(np.arange(ROLES), numbers))


def _stacked(
    x: Array, y: Array, crosswise: Array, draws: Draws, floors: dict[int, Array], target: int
) -> Placed:
    """Places blocks at x, y [R] m; those on a floor [] m above the table get a random offset."""
    floor = jnp.stack([floors.get(role, jnp.zeros_like(x[0])) for role in range(ROLES)])
    offset = jnp.where(_is_role(*floors)[:, None], STACK_OFFSET * draws.jitter, 0.0)
    return Placed(jnp.stack([x, y], axis=1) + offset, crosswise, jnp.int32(target), floor)


def _second_like_first(half: Array) -> Array:
    return half.at[1].set(half[0])  # so that a block across both lies flat


_NO_PRISM: tuple[SlotKind, ...] = ("box", "half_cylinder", "cylinder")
_NOT_ARCH: tuple[SlotKind, ...] = ("box", *MESH_KINDS)
_BOX, _LONG = Role(("box",)), Role(("box",), long=True)
_BRICK, _ROUND = Role(("box",), long=True, on_side=0.5), Role(_NO_PRISM)
_SOLID, _ANY = Role(_NOT_ARCH), Role(("arch", *_NOT_ARCH), on_side=0.3)
FAMILIES = {
    "wall": Family((_LONG, _LONG, _SOLID, _ROUND, _ROUND), 3, _place_wall, _second_like_first),
    "stairs": Family((_BRICK, _BRICK, _ANY, _ROUND, _ROUND), 3, _place_stairs),
    "fan": Family((_LONG, _LONG, Role(_ANY.kinds), _ROUND, _ROUND), 3, _place_fan),
    "bridge": Family((_BOX, _BOX, _LONG, _ROUND, _SOLID), 3, _place_bridge, _second_like_first),
    "tower": Family((_LONG, _BOX, _SOLID, _ROUND, _ROUND), 3, _place_tower),
    "wedge": Family((_BRICK, _BRICK, _SOLID, _ROUND, _ROUND), 3, _place_wedge),
    "corner": Family((_BRICK, _BRICK, _ANY, _ROUND, _ROUND), 3, _place_corner),
    "bin": Family((_BRICK, _BRICK, _BRICK, _SOLID, _ROUND), 4, _place_bin),
}
