"""Families of ordered arrangements: each an ordered list of roles, and the places of their blocks.

Each role takes a random free slot of its kinds. The shipped cases are held out by construction. No
family packs two arches together, as `row`, `pinwheel` and `hole` do. Two packed prisms, as in
`ridge`, always have a third block at their side. R = the 5 roles, N = block slots.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import MESH_KINDS, SlotKind

ROLES = 5  # of every family
STACKED_GAP = 0.008  # m, widest gap that a block may bridge
IN_HOLE = (0.001, 0.005)  # m, least and widest room about a block in another
ASKEW = 0.003  # m, how far off the middle a stacked block may lie
OUT_OF_LINE = 0.008  # m, likewise along the sides of blocks in a row


class Role(NamedTuple):
    """What a block of a family may be."""

    kinds: tuple[SlotKind, ...]
    long: bool = False  # a box is a cuboid or a plank
    on_side: float = 0.0  # probability that a box or arch is tipped by 90 deg about its long axis


class Placed(NamedTuple):
    """Where the blocks of a family go, before the arrangement as a whole is rotated and shifted."""

    centre: jax.Array  # [R, 3] m, z that of what the block stands on
    rotated: jax.Array  # [R] bool, by 90 deg about z
    target: jax.Array  # [] int32, role of the block that is hardest to get at


class Family(NamedTuple):
    """A way of packing. A role's kinds contain those of each earlier role, or none of them."""

    roles: tuple[Role, Role, Role, Role, Role]
    least: int  # number of first roles that the arrangement needs
    place: Callable[["Draws", jax.Array, jax.Array, jax.Array], Placed]
    """From draws, half extents [R, 3] m as the blocks lie, used [R] bool and gap [] m."""
    resize: Callable[[jax.Array], jax.Array] = lambda half: half
    """Half sizes [R, 3] m of blocks that fit, from those drawn."""


class Draws(NamedTuple):
    """The randomness of a packing, uniform, for any family."""

    preference: jax.Array  # [N] 0..1, slots with a higher one are taken first
    more: jax.Array  # [] 0..1, share of the roles that may be left out
    gap: jax.Array  # [] 0..1
    lying: jax.Array  # [R] 0..1
    order: jax.Array  # [R] 0..1, along a line
    rotated: jax.Array  # [R] bool
    jitter: jax.Array  # [R, 2] -1..1
    mirrored: jax.Array  # [] bool


def available(slots: tuple[SlotKind, ...]) -> dict[str, Family]:
    """The families that these slots allow. Raises ValueError where they allow none."""
    possible = {name: family for name, family in FAMILIES.items() if _is_possible(family, slots)}
    if not possible:
        raise ValueError("scene.slots: too few for an arrangement; three boxes are enough")
    return possible


def _is_possible(family: Family, slots: tuple[SlotKind, ...]) -> bool:
    """Whether every needed role finds a slot. Roles with fewer kinds choose first: any choice of
    theirs will do."""
    free = list(slots)
    for role in family.roles[: family.least]:
        fitting = [kind for kind in free if kind in role.kinds]
        if not fitting:
            return False
        free.remove(fitting[0])
    return True


def draw(key: jax.Array, num_slots: int) -> Draws:
    """All draws of a packing, from one call of the generator: each call takes long to compile."""
    noise = jax.random.uniform(key, (num_slots + 3 + 5 * ROLES,))
    preference, one, roles = jnp.split(noise, [num_slots, num_slots + 3])
    roles = roles.reshape(5, ROLES)
    return Draws(
        preference=preference,
        more=one[0],
        gap=one[1],
        lying=roles[0],
        order=roles[1],
        rotated=roles[2] < 0.5,
        jitter=2.0 * roles[3:].T - 1.0,
        mirrored=one[2] < 0.5,
    )


# Where the blocks of a family go. `feet` [R, 3] m are half extents as the blocks lie.


def _flat(feet: jax.Array, rotated: jax.Array) -> jax.Array:
    """Half extents [R, 2] m along x and y, of blocks at 90 deg where `rotated` [R]."""
    return jnp.where(rotated[:, None], feet[:, 1::-1], feet[:, :2])


def _line(
    noise: jax.Array, width: jax.Array, used: jax.Array, gap: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Blocks of half widths `width` [R] m along a line, ordered by `noise` [R].

    Returns: centres [R] m about 0, and the index of the middle block.
    """
    index = np.arange(ROLES)
    earlier = index[None] < index[:, None]
    is_tie = (noise[None] == noise[:, None]) & earlier  # one scene in a million has one
    before = used[None] & ((noise[None] < noise[:, None]) | is_tie)  # [i, j]: j comes before i
    step = jnp.where(used, 2.0 * width + gap, 0.0)
    start = jnp.sum(jnp.where(before, step[None], 0.0), axis=1)
    is_middle = used & (jnp.sum(before, axis=1) == jnp.sum(used) // 2)
    return start + 0.5 * (step - jnp.sum(step)), jnp.argmax(is_middle).astype(jnp.int32)


def _place_row(draws: Draws, feet: jax.Array, used: jax.Array, gap: jax.Array) -> Placed:
    """Long side to long side, not quite in line."""
    y, middle = _line(draws.order, feet[:, 1], used, gap)
    centre = jnp.stack([OUT_OF_LINE * draws.jitter[:, 0], y, jnp.zeros_like(y)], axis=1)
    return Placed(centre, jnp.zeros_like(used), middle)


def _place_ring(draws: Draws, feet: jax.Array, used: jax.Array, gap: jax.Array) -> Placed:
    """The last block enclosed by the four others as by the arms of a pinwheel."""
    quarter = np.arange(ROLES)
    rotated = quarter % 2 == 1  # the fifth, in the middle, is not
    # [5, 2] the block in the middle, in the frame of each arm
    inner = jnp.where(rotated[:, None], feet[4, 1::-1][None], feet[4, :2][None])
    arm = jnp.stack([feet[:, 0] - inner[:, 0], inner[:, 1] + gap + feet[:, 1]], axis=1)
    angle = 0.5 * np.pi * quarter
    cos, sin = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)
    x, y = cos * arm[:, 0] - sin * arm[:, 1], sin * arm[:, 0] + cos * arm[:, 1]
    mirrored = jnp.where(draws.mirrored, -1.0, 1.0)
    around = jnp.stack([mirrored * x, y, jnp.zeros_like(x)], axis=1)
    return Placed(around.at[4].set(0.0), jnp.asarray(rotated), jnp.int32(4))


def _place_wall(draws: Draws, feet: jax.Array, used: jax.Array, gap: jax.Array) -> Placed:
    """The first two end to end with flush faces, the others side by side along these."""
    role = np.arange(ROLES)
    is_wall = role < 2
    rotated = draws.rotated & ~is_wall
    flat = _flat(feet, rotated)
    x, middle = _line(draws.order, flat[:, 0], used & ~is_wall, gap)
    side = np.where(role == 0, -1.0, 1.0).astype(np.float32)
    end_to_end = side * (flat[:, 0] + 0.5 * gap)
    x, y = jnp.where(is_wall, end_to_end, x), jnp.where(is_wall, -flat[:, 1], gap + flat[:, 1])
    return Placed(jnp.stack([x, y, jnp.zeros_like(y)], axis=1), rotated, middle)


def _place_nest(draws: Draws, feet: jax.Array, used: jax.Array, gap: jax.Array) -> Placed:
    """An arch on its side, open to +y; a block in its opening; a lid; two at the arch's ends."""
    arch, inner, lid = feet[0], feet[1], feet[2]
    # The opening is half as deep as the arch is high.
    y_inner = jnp.minimum(gap, IN_HOLE[1]) + inner[1]
    front = jnp.maximum(y_inner + inner[1], jnp.max(feet[np.array([0, 3, 4]), 1]))
    zero = jnp.zeros_like(gap)
    x_ends = arch[0] + gap + feet[3:, 0]
    x = jnp.stack([zero, zero, OUT_OF_LINE * draws.jitter[2, 0], x_ends[0], -x_ends[1]])
    y = jnp.stack([zero, y_inner, front + gap + lid[1], zero, zero])
    return Placed(jnp.stack([x, y, jnp.zeros_like(x)], axis=1), jnp.zeros_like(used), jnp.int32(1))


def _resize_nest(half: jax.Array) -> jax.Array:
    """An arch wide enough for the block in its opening, which is half as wide as the arch."""
    return half.at[0].multiply(jnp.maximum(1.0, 2.0 * (half[1, 0] + IN_HOLE[0]) / half[0, 0]))


def _place_pile(draws: Draws, feet: jax.Array, used: jax.Array, gap: jax.Array) -> Placed:
    """Two like blocks side by side, one across both, one on top of that, one at their ends."""
    rotated = draws.rotated & ~np.array([True, True, False, False, False])
    flat, near = _flat(feet, rotated), jnp.minimum(gap, STACKED_GAP)
    zero = jnp.zeros_like(gap)
    aside = flat[0, 1] + 0.5 * near
    stacked_end = jnp.maximum(flat[2, 0], flat[3, 0]) + ASKEW
    end = jnp.maximum(flat[0, 0], stacked_end)
    floor = jnp.stack([zero, zero, 2.0 * feet[0, 2], 2.0 * (feet[0, 2] + feet[2, 2]), zero])
    x = jnp.stack([zero, zero, zero, zero, end + gap + flat[4, 0]])
    y = jnp.stack([-aside, aside, zero, zero, zero])
    stacked = np.array([0.0, 0.0, 1.0, 1.0, 0.0], np.float32)[:, None]
    xy = jnp.stack([x, y], axis=1) + stacked * ASKEW * draws.jitter
    return Placed(jnp.concatenate([xy, floor[:, None]], axis=1), rotated, jnp.int32(0))


def _resize_pile(half: jax.Array) -> jax.Array:
    """The second of the two lowest blocks like the first, so that the one across lies flat."""
    return half.at[1].set(half[0])


_NOT_ARCH: tuple[SlotKind, ...] = ("box", *MESH_KINDS)
_ANY: tuple[SlotKind, ...] = ("arch", *_NOT_ARCH)
_NO_ARCH, _BOX, _PRISM = Role(_NOT_ARCH, on_side=0.3), Role(("box",)), Role(("prism",))
_BASE, _BRICK = Role(("box",), long=True), Role(("box",), long=True, on_side=0.5)
_ARM = Role(("box", "prism"), long=True, on_side=1.0)
FAMILIES = {
    "row": Family((_NO_ARCH, _NO_ARCH, Role(_ANY, on_side=0.3), _NO_ARCH, _NO_ARCH), 3, _place_row),
    "ridge": Family((_PRISM, _PRISM, Role(_ANY, on_side=0.3), _NO_ARCH, _NO_ARCH), 3, _place_row),
    "ring": Family((_ARM, _ARM, _ARM, _ARM, Role(_NOT_ARCH)), 5, _place_ring),
    "wall": Family((_BRICK, _BRICK, _NO_ARCH, _NO_ARCH, Role(_ANY)), 3, _place_wall),
    "nest": Family(
        (Role(("arch",), on_side=1.0), Role(("cylinder",)), _BRICK, _NO_ARCH, _NO_ARCH),
        3,
        _place_nest,
        _resize_nest,
    ),
    "pile": Family((_BASE, _BASE, _BOX, Role(_NOT_ARCH), Role(_ANY)), 3, _place_pile, _resize_pile),
}
