"""Families of packed arrangements: each is an ordered list of roles and their places.

Each role takes a random free slot of its kinds. The shipped cases are held out by construction. The
cases `row`, `pinwheel` and `hole` pack two arches together, which no family does; `ridge` packs two
prisms alone, to which every family adds a third block. R = the 5 roles, N = block slots.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import MESH_KINDS, SlotKind
from csac_jax.errors import SceneError

ROLES = 5  # of every family
STACKED_GAP = 0.008  # m, widest gap that a block may bridge
MOUTH_GAP = (0.001, 0.005)  # m, least and widest gap between an arch and the block in its mouth
STACK_OFFSET = 0.003  # m, how far off the middle a stacked block may lie
ROW_OFFSET = 0.008  # m, how far off the line a block in a row may lie


class Role(NamedTuple):
    """What a block of a family may be."""

    kinds: tuple[SlotKind, ...]
    long: bool = False  # a box is a cuboid or a plank
    on_side: float = 0.0  # probability of a quarter turn about the long axis, of a box or an arch


class Placed(NamedTuple):
    """Where the blocks of a family go, before the arrangement is rotated and shifted as a whole."""

    xy: jax.Array  # [R, 2] m
    crosswise: jax.Array  # [R] bool, rotated by a quarter turn about z
    target: jax.Array  # [] int32, role of the block that is hardest to reach
    floor: jax.Array | float = 0.0  # [R] m, height of the surface that carries the block


class Family(NamedTuple):
    """A way of packing. The kinds of a role contain those of each role before it, or none."""

    roles: tuple[Role, Role, Role, Role, Role]
    needed: int  # the first so many roles make the arrangement; the others may be left out
    # From draws, half extents [R, 3] m as the blocks lie, used [R] bool and gap [] m:
    place: Callable[["Draws", jax.Array, jax.Array, jax.Array], Placed]
    # Half sizes [R, 3] m of blocks that fit, from those drawn:
    resize: Callable[[jax.Array], jax.Array] = lambda half: half


class Draws(NamedTuple):
    """The randomness of a packing, uniform; the same draws serve every family."""

    preference: jax.Array  # [N] 0..1, slots with more are taken first
    optional: jax.Array  # [] 0..1, how many optional roles are used
    gap: jax.Array  # [] 0..1
    on_side: jax.Array  # [R] 0..1
    order: jax.Array  # [R] 0..1, along a line
    crosswise: jax.Array  # [R] bool
    jitter: jax.Array  # [R, 2] -1..1
    mirrored: jax.Array  # [] bool


def available(slots: tuple[SlotKind, ...]) -> dict[str, Family]:
    """The families that these slots allow. Raises SceneError where they allow none."""
    possible = {name: family for name, family in FAMILIES.items() if _is_possible(family, slots)}
    if not possible:
        raise SceneError("scene.slots: too few for an arrangement; three boxes are enough")
    return possible


def _is_possible(family: Family, slots: tuple[SlotKind, ...]) -> bool:
    """Whether every needed role finds a slot. Roles of fewer kinds are first: greedy is exact."""
    free = list(slots)
    for role in family.roles[: family.needed]:
        fitting = [kind for kind in free if kind in role.kinds]
        if not fitting:
            return False
        free.remove(fitting[0])
    return True


def draw(key: jax.Array, num_slots: int) -> Draws:
    """All draws of a packing, by one call of the generator: each call is slow to compile."""
    noise = jax.random.uniform(key, (num_slots + 3 + 5 * ROLES,))
    preference, (optional, gap, mirrored), roles = jnp.split(noise, [num_slots, num_slots + 3])
    roles = roles.reshape(5, ROLES)
    return Draws(
        preference=preference,
        optional=optional,
        gap=gap,
        on_side=roles[0],
        order=roles[1],
        crosswise=roles[2] < 0.5,
        jitter=2.0 * roles[3:].T - 1.0,
        mirrored=mirrored < 0.5,
    )


def _half_xy(half: jax.Array, crosswise: jax.Array) -> jax.Array:
    """Half extents [R, 2] m along x and y; crosswise [R] bool."""
    return jnp.where(crosswise[:, None], half[:, 1::-1], half[:, :2])


def _line(
    noise: jax.Array, width: jax.Array, used: jax.Array, gap: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Centres [R] m about 0 of blocks along a line, and the number of the middle one [].

    Args: noise [R] orders the blocks; width [R] m, half widths.
    """
    index = np.arange(ROLES)
    # Equal noise, in one scene of a million, goes by number.
    is_tie = (noise[None] == noise[:, None]) & (index[None] < index[:, None])
    before = used[None] & ((noise[None] < noise[:, None]) | is_tie)  # [i, j]: j comes before i
    step = jnp.where(used, 2.0 * width + gap, 0.0)
    start = jnp.sum(jnp.where(before, step[None], 0.0), axis=1)
    is_middle = used & (jnp.sum(before, axis=1) == jnp.sum(used) // 2)
    return start + 0.5 * (step - jnp.sum(step)), jnp.argmax(is_middle).astype(jnp.int32)


def _place_row(draws: Draws, half: jax.Array, used: jax.Array, gap: jax.Array) -> Placed:
    """Long side to long side, a little off the line."""
    y, middle = _line(draws.order, half[:, 1], used, gap)
    x = ROW_OFFSET * draws.jitter[:, 0]
    return Placed(jnp.stack([x, y], axis=1), jnp.zeros_like(used), middle)


def _place_ring(draws: Draws, half: jax.Array, used: jax.Array, gap: jax.Array) -> Placed:
    """Four blocks enclose the last: each ends at the side of the next, like a pinwheel's arms."""
    quarter = np.arange(5)
    crosswise = quarter % 2 == 1  # never the fifth, which is in the middle
    # Half extents of the middle block, in the frame of each arm.
    inner = _half_xy(jnp.broadcast_to(half[4], half.shape), crosswise)
    arm = jnp.stack([half[:, 0] - inner[:, 0], inner[:, 1] + gap + half[:, 1]], axis=1)
    angle = 0.5 * np.pi * quarter
    cos, sin = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)
    x, y = cos * arm[:, 0] - sin * arm[:, 1], sin * arm[:, 0] + cos * arm[:, 1]
    mirrored = jnp.where(draws.mirrored, -1.0, 1.0)
    around = jnp.stack([mirrored * x, y], axis=1)
    return Placed(around.at[4].set(0.0), jnp.asarray(crosswise), jnp.int32(4))


def _place_wall(draws: Draws, half: jax.Array, used: jax.Array, gap: jax.Array) -> Placed:
    """The first two end to end; the others side by side along their faces, which are flush."""
    is_wall = np.arange(used.shape[0]) < 2
    crosswise = draws.crosswise & ~is_wall
    half_xy = _half_xy(half, crosswise)
    x, middle = _line(draws.order, half_xy[:, 0], used & ~is_wall, gap)
    side = np.where(np.arange(used.shape[0]) == 0, -1.0, 1.0).astype(np.float32)
    x = jnp.where(is_wall, side * (half_xy[:, 0] + 0.5 * gap), x)
    y = jnp.where(is_wall, -half_xy[:, 1], gap + half_xy[:, 1])
    return Placed(jnp.stack([x, y], axis=1), crosswise, middle)


def _place_nest(draws: Draws, half: jax.Array, used: jax.Array, gap: jax.Array) -> Placed:
    """An arch on its side, its mouth towards +y; a block in it, one before it, two at its ends."""
    arch, inner, lid = half[0], half[1], half[2]
    # The mouth is half as deep as the arch is high.
    y_inner = jnp.minimum(gap, MOUTH_GAP[1]) + inner[1]
    front = jnp.maximum(y_inner + inner[1], jnp.max(half[np.array([0, 3, 4]), 1]))
    zero = jnp.zeros_like(gap)
    x_ends = arch[0] + gap + half[3:, 0]
    x = jnp.stack([zero, zero, ROW_OFFSET * draws.jitter[2, 0], x_ends[0], -x_ends[1]])
    y = jnp.stack([zero, y_inner, front + gap + lid[1], zero, zero])
    return Placed(jnp.stack([x, y], axis=1), jnp.zeros_like(used), jnp.int32(1))


def _resize_nest(half: jax.Array) -> jax.Array:
    """An arch whose mouth, half as wide as the arch, holds the inner block."""
    return half.at[0].multiply(jnp.maximum(1.0, 2.0 * (half[1, 0] + MOUTH_GAP[0]) / half[0, 0]))


def _place_pile(draws: Draws, half: jax.Array, used: jax.Array, gap: jax.Array) -> Placed:
    """Two like blocks side by side, one across both, one on top of that, one at their ends."""
    crosswise = draws.crosswise & ~np.array([True, True, False, False, False])
    half_xy, base_gap = _half_xy(half, crosswise), jnp.minimum(gap, STACKED_GAP)
    zero = jnp.zeros_like(gap)
    aside = half_xy[0, 1] + 0.5 * base_gap
    # What is stacked may reach farther than the base.
    end = jnp.maximum(half_xy[0, 0], jnp.maximum(half_xy[2, 0], half_xy[3, 0]) + STACK_OFFSET)
    floor = jnp.stack([zero, zero, 2.0 * half[0, 2], 2.0 * (half[0, 2] + half[2, 2]), zero])
    x = jnp.stack([zero, zero, zero, zero, end + gap + half_xy[4, 0]])
    y = jnp.stack([-aside, aside, zero, zero, zero])
    stacked = np.array([0.0, 0.0, 1.0, 1.0, 0.0], np.float32)[:, None]
    xy = jnp.stack([x, y], axis=1) + stacked * STACK_OFFSET * draws.jitter
    return Placed(xy, crosswise, jnp.int32(0), floor)


def _resize_pile(half: jax.Array) -> jax.Array:
    """The second base block like the first, so that what lies across them lies flat."""
    return half.at[1].set(half[0])


_NOT_ARCH: tuple[SlotKind, ...] = ("box", *MESH_KINDS)
_ANY: tuple[SlotKind, ...] = ("arch", *_NOT_ARCH)
_NO_ARCH, _BOX, _PRISM = Role(_NOT_ARCH, on_side=0.3), Role(("box",)), Role(("prism",))
_BASE, _BRICK = Role(("box",), long=True), Role(("box",), long=True, on_side=0.5)
_ARM = Role(("box", "prism"), long=True, on_side=1.0)
_TUNNEL, _ROUND = Role(("arch",), on_side=1.0), Role(("cylinder",))
FAMILIES = {
    "row": Family((_NO_ARCH, _NO_ARCH, Role(_ANY, on_side=0.3), _NO_ARCH, _NO_ARCH), 3, _place_row),
    "ridge": Family((_PRISM, _PRISM, Role(_ANY, on_side=0.3), _NO_ARCH, _NO_ARCH), 3, _place_row),
    "ring": Family((_ARM, _ARM, _ARM, _ARM, Role(_NOT_ARCH)), 5, _place_ring),
    "wall": Family((_BRICK, _BRICK, _NO_ARCH, _NO_ARCH, Role(_ANY)), 3, _place_wall),
    "nest": Family((_TUNNEL, _ROUND, _BRICK, _NO_ARCH, _NO_ARCH), 3, _place_nest, _resize_nest),
    "pile": Family((_BASE, _BASE, _BOX, Role(_NOT_ARCH), Role(_ANY)), 3, _place_pile, _resize_pile),
}
