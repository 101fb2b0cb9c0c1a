"""Ordered arrangements drawn inside the compiled program: packed blocks and a few loose ones.

`families` says how blocks are packed. Here slots take sizes, are packed, placed on the table and
joined by loose blocks. N = block slots, R = roles of a family.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.config import MESH_KINDS, SceneConfig, SlotKind
from csac_jax.scene import blocks, families, layout
from csac_jax.scene.families import ROLES, Draws, Family, Role
from csac_jax.scene.layout import Scene

GAPS = (0.001, 0.030)  # m between packed neighbours: at level 1, and the widest at level 0
LOOSE_GAP = 0.015  # m, least distance of a loose block from any other
REACH = 0.205  # m, most that a packed block extends from the middle of the arrangement
_MARGIN = 0.001  # m kept free along the border of the square
_TRIES = 64  # random places tried for every loose block
_LOOSE = (1, 3)  # most loose blocks at level 0 and at level 1, if enough for `min_blocks`
_ON_SIDE = np.sqrt(np.array([0.5, 0.5, 0.0, 0.0], np.float32))  # 90 deg about x


class Blocks(NamedTuple):
    """Blocks as oriented boxes on or above the table."""

    centre: jax.Array  # [N, 3] m
    yaw: jax.Array  # [N] rad
    on_side: jax.Array  # [N] bool, tipped by 90 deg about x before the yaw
    half_size: jax.Array  # [N, 3] m, in the block's frame
    placed: jax.Array  # [N] bool, False where the rest means nothing


class Sizes(NamedTuple):
    """Half sizes drawn for the slots."""

    any: jax.Array  # [N, 3] m, of any shape of the slot's kind
    long: jax.Array  # [N, 3] m, of one of the kind's longest shapes


def arrange(key: jax.Array, cfg: SceneConfig, extent: float, level: jax.Array) -> Scene:
    """A random arrangement at rest inside the square of side `extent` m; callers vmap.

    A higher `level` [] in 0..1 packs more blocks, closes the gaps between them from at most 30 mm
    to 1 mm, and adds loose blocks. Sizes, densities and frictions vary as in the pool. The target
    is the block that the others enclose. Fewer than `cfg.min_blocks` are in play only where the
    square has no room left for loose blocks.

    Raises ValueError while tracing where the slots or the square are too small.
    """
    least = 2.0 * (REACH + _MARGIN)
    if extent < least:
        raise ValueError(
            "heightmap.extent: arrangements need a square of at least "
            f"{least:g} m, not {extent:g} m"
        )
    possible = families.available(cfg.slots).values()
    key_sizes, key_family, key_pack, key_place, key_loose, key_looks = jax.random.split(key, 6)
    sizes = _draw_sizes(key_sizes, cfg)
    draws = families.draw(key_pack, len(cfg.slots))
    each = [_pack(family, cfg.slots, draws, sizes, level) for family in possible]
    # A batch needs all families: no lax.switch.
    chosen = jax.random.randint(key_family, (), 0, len(each))
    packed, target = jax.tree.map(lambda *leaves: jnp.stack(leaves)[chosen], *each)
    border = 0.5 * extent - _MARGIN
    together = _add_loose(key_loose, cfg, border, level, _put_down(key_place, border, packed))
    return _scene(key_looks, cfg, together, target)


def _draw_sizes(key: jax.Array, cfg: SceneConfig) -> Sizes:
    """A shape of each slot's kind, larger or smaller; one size for all mesh blocks of a kind."""
    key_any, key_long, key_scale = jax.random.split(key, 3)
    choices = [blocks.half_size_choices(kind) for kind in cfg.slots]
    number = np.array([len(choice) for choice in choices])
    table = np.stack([np.resize(choice, (number.max(), 3)) for choice in choices])
    longest = [choice[choice[:, 0] == choice[:, 0].max()] for choice in choices]
    long = np.stack([np.resize(choice, (2, 3)) for choice in longest])  # [N, 2, 3]
    num = len(cfg.slots)
    scale = 1.0 + blocks.size_jitter(cfg) * jax.random.uniform(
        key_scale, (num,), jnp.float32, -1.0, 1.0
    )
    shared = blocks.size_leader(cfg.slots)

    def choose(table: np.ndarray, index: jax.Array) -> jax.Array:
        return jnp.asarray(table)[np.arange(num), index] * scale[shared][:, None]

    return Sizes(
        any=choose(table, jax.random.randint(key_any, (num,), 0, jnp.asarray(number, jnp.int32))),
        long=choose(long, jax.random.randint(key_long, (num,), 0, 2)),
    )


# Packing.


def _pack(
    family: Family, slots: tuple[SlotKind, ...], draws: Draws, sizes: Sizes, level: jax.Array
) -> tuple[Blocks, jax.Array]:
    """The packed blocks of an arrangement about the origin, and the slot of the target []."""
    slot, used = _assign(draws.preference, slots, family.roles)
    more = level * (0.5 + 0.5 * draws.more) * (ROLES - family.least)
    used = used & (np.arange(ROLES) < family.least + jnp.round(more).astype(jnp.int32))
    long = np.array([role.long for role in family.roles])
    half = family.resize(jnp.where(long[:, None], sizes.long[slot], sizes.any[slot]))
    lying = draws.lying < np.array([role.on_side for role in family.roles], np.float32)
    lying = lying & ~jnp.asarray([kind in MESH_KINDS for kind in slots])[slot]
    feet = jnp.where(used[:, None], _feet(half, lying), 0.0)
    gap = GAPS[0] + (GAPS[1] - GAPS[0]) * (1.0 - level) * (0.5 + 0.5 * draws.gap)
    centre, rotated, target = family.place(draws, feet, used, gap)
    out = jnp.where(used, slot, len(slots))  # dropped where not used

    def by_slot(values: jax.Array) -> jax.Array:
        empty = jnp.zeros((len(slots), *values.shape[1:]), values.dtype)
        return empty.at[out].set(values, mode="drop")

    packed = Blocks(
        centre=by_slot(centre.at[:, 2].add(feet[:, 2])),
        yaw=by_slot(jnp.where(rotated, np.float32(0.5 * np.pi), 0.0)),
        on_side=by_slot(lying),
        half_size=jnp.asarray(sizes.any).at[out].set(half, mode="drop"),
        placed=by_slot(used),
    )
    return packed, slot[target]


def _assign(
    preference: jax.Array, slots: tuple[SlotKind, ...], roles: tuple[Role, ...]
) -> tuple[jax.Array, jax.Array]:
    """A different slot [R] int32 for every role, by `preference` [N] among its kinds, and whether
    one was left [R] bool."""
    free = jnp.ones(len(slots), bool)
    chosen, assigned = [], []
    for role in roles:
        fits = free & np.array([kind in role.kinds for kind in slots])
        chosen.append(jnp.argmax(jnp.where(fits, preference, -1.0)).astype(jnp.int32))
        assigned.append(jnp.any(fits))
        free = free & ~(fits & (np.arange(len(slots)) == chosen[-1]))
    return jnp.stack(chosen), jnp.stack(assigned)


def _feet(half: jax.Array, on_side: jax.Array) -> jax.Array:
    """Half extents [..., 3] m of blocks as they lie, before the yaw."""
    return jnp.where(on_side[..., None], half[..., np.array([0, 2, 1])], half)


# On the table.


def _put_down(key: jax.Array, border: float, packed: Blocks) -> Blocks:
    """The packed blocks, rotated and shifted as one at random within `border` m of the centre."""
    key_yaw, key_shift = jax.random.split(key)
    yaw = jax.random.uniform(key_yaw, (), jnp.float32, 0.0, 2.0 * np.pi)
    rotated = packed._replace(
        centre=packed.centre.at[:, :2].set(geometry.rotate2d(yaw, packed.centre[:, :2])),
        yaw=packed.yaw + yaw,
    )
    xy, reach = (
        rotated.centre[:, :2],
        _reach(rotated.yaw, _feet(rotated.half_size, rotated.on_side)),
    )
    low = jnp.min(jnp.where(packed.placed[:, None], xy - reach, jnp.inf), axis=0)
    high = jnp.max(jnp.where(packed.placed[:, None], xy + reach, -jnp.inf), axis=0)
    shift = jax.random.uniform(key_shift, (2,), jnp.float32, -border - low, border - high)
    return rotated._replace(centre=rotated.centre.at[:, :2].add(shift[None]))


def _reach(yaw: jax.Array, feet: jax.Array) -> jax.Array:
    """Half extents [N, 2] m along the world's x and y of blocks `feet` [N, 3] m at `yaw` [N]."""
    cos, sin = jnp.abs(jnp.cos(yaw)), jnp.abs(jnp.sin(yaw))
    x, y = cos * feet[:, 0] + sin * feet[:, 1], sin * feet[:, 0] + cos * feet[:, 1]
    return jnp.stack([x, y], axis=1)


def _add_loose(
    key: jax.Array, cfg: SceneConfig, border: float, level: jax.Array, packed: Blocks
) -> Blocks:
    """The arrangement and loose blocks in random free places; a block without one is left out."""
    key_order, key_number, key_tries = jax.random.split(key, 3)
    num = len(cfg.slots)
    order = jax.random.permutation(key_order, num)
    share = jax.random.uniform(key_number, ())
    extra = jnp.floor(share * (1.0 + _LOOSE[0] + (_LOOSE[1] - _LOOSE[0]) * level)).astype(jnp.int32)
    wanted = jnp.maximum(jnp.sum(packed.placed) + extra, cfg.min_blocks)

    def add(i: jax.Array, now: Blocks) -> Blocks:
        slot = order[i]
        half, key_place = now.half_size[slot], jax.random.fold_in(key_tries, i)
        is_free, xy, yaw = _free_place(key_place, border, now, half)
        joins = is_free & ~now.placed[slot] & (jnp.sum(now.placed) < wanted)
        here = joins & (np.arange(num) == slot)
        centre = jnp.concatenate([xy, half[2:]])
        return now._replace(
            centre=jnp.where(here[:, None], centre[None], now.centre),
            yaw=jnp.where(here, yaw, now.yaw),
            placed=now.placed | here,
        )

    return jax.lax.fori_loop(0, num, add, packed)


def _free_place(
    key: jax.Array, border: float, now: Blocks, half: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Whether a block of half size [3] m finds room, [] bool; its xy [2] m and yaw [] rad."""
    key_xy, key_yaw = jax.random.split(key)
    yaw = jax.random.uniform(key_yaw, (_TRIES,), jnp.float32, 0.0, 2.0 * np.pi)
    room = border - _reach(yaw, jnp.broadcast_to(half, (_TRIES, 3)))
    xy = jax.random.uniform(key_xy, (_TRIES, 2), jnp.float32, -1.0, 1.0) * room
    feet = _feet(now.half_size, now.on_side)[:, :2]
    to_each = jax.vmap(rectangle_gap, (None, None, None, 0, 0, 0))
    gap = jax.vmap(to_each, (0, 0, None, None, None, None))(
        xy, yaw, half[:2], now.centre[:, :2], now.yaw, feet
    )
    is_free = jnp.all((gap >= LOOSE_GAP) | ~now.placed[None], axis=1)  # [tries]
    first = jnp.argmax(is_free)
    return jnp.any(is_free), xy[first], yaw[first]


def rectangle_gap(
    xy: jax.Array,
    yaw: jax.Array,
    half: jax.Array,
    other_xy: jax.Array,
    other_yaw: jax.Array,
    other_half: jax.Array,
) -> jax.Array:
    """Gap [] m between two rectangles along their best separating axis; < 0 where they overlap.

    It is at most their distance. Args: centres [2] m, yaws [] rad, half sides [2] m.
    """
    # The sides' normals.
    angle = jnp.stack([yaw, yaw + 0.5 * np.pi, other_yaw, other_yaw + 0.5 * np.pi])
    distance = jnp.abs(jnp.cos(angle) * (other_xy - xy)[0] + jnp.sin(angle) * (other_xy - xy)[1])

    def width(side_yaw: jax.Array, side: jax.Array) -> jax.Array:
        cos, sin = jnp.abs(jnp.cos(angle - side_yaw)), jnp.abs(jnp.sin(angle - side_yaw))
        return side[0] * cos + side[1] * sin

    return jnp.max(distance - width(yaw, half) - width(other_yaw, other_half))


def _scene(key: jax.Array, cfg: SceneConfig, together: Blocks, target: jax.Array) -> Scene:
    """The blocks with random colours, densities and frictions; what is not placed is parked."""
    key_colour, key_density, key_friction = jax.random.split(key, 3)
    num = len(cfg.slots)
    palette = len(blocks.COLOURS)
    colours = jax.random.permutation(key_colour, max(num, palette))[:num] % palette
    tipped = jnp.where(together.on_side[:, None], _ON_SIDE[None], layout.UPRIGHT[None])
    yaws = jax.vmap(geometry.quat_from_yaw)(together.yaw)
    loose = Scene(
        position=together.centre,
        quaternion=jax.vmap(geometry.quat_multiply)(yaws, tipped),
        velocity=jnp.zeros((num, 6), jnp.float32),
        half_size=together.half_size,
        density=jax.random.uniform(key_density, (num,), jnp.float32, *cfg.density),
        friction=jax.random.uniform(key_friction, (num,), jnp.float32, *cfg.friction),
        colour=colours.astype(jnp.int32),
        in_play=together.placed,
        target=target,
    )
    return layout.park(loose, together.placed)
