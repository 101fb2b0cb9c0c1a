"""Packed arrangements, drawn inside the compiled program: some blocks together, a few loose.

N = block slots, R = roles of a family, see `packings`.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from csac_jax import geometry
from csac_jax.config import SceneConfig, SlotKind
from csac_jax.errors import SettingsError
from csac_jax.scenes import packings
from csac_jax.scenes.packings import ROLES, Draws, Family, Role
from csac_jax.world import blocks, scene_state
from csac_jax.world.scene_state import SceneState

Rectangle = tuple[Array, Array, Array]  # centre [2] m, yaw [] rad, half sides [2] m
MIN_ARRANGED = 4  # blocks in an arrangement
GAPS = (0.001, 0.040)  # m between packed neighbours: at level 1, and the widest at level 0
LOOSE_GAP = 0.015  # m, least distance of a loose block from any other
RADIUS = 0.205  # m from the middle of an arrangement: all packed blocks lie within, whatever size
_MARGIN = 0.001  # m kept free along the border of the square
_TRIES = 64  # random places tried for each loose block
_MAX_LOOSE = (1, 3)  # loose blocks at level 0 and at level 1, unless `min_blocks` needs more
_ON_SIDE = np.sqrt(np.array([0.5, 0.5, 0.0, 0.0], np.float32))  # a quarter turn about x


class Blocks(NamedTuple):
    """Blocks as oriented boxes on or above the table."""

    centre: Array  # [N, 3] m
    yaw: Array  # [N] rad
    on_side: Array  # [N] bool, rotated by a quarter turn about x before the yaw
    half_size: Array  # [N, 3] m, in the block's frame
    half_lying: Array  # [N, 3] m, as the block lies, before the yaw
    placed: Array  # [N] bool; where False, the other fields have no meaning


def arrange(key: Array, cfg: SceneConfig, extent: float, level: Array) -> SceneState:
    """Draws an arrangement at rest inside the square of side `extent` m; vmap for a batch.

    A higher `level` [] in 0..1 packs more blocks, closer, and adds loose ones. The target is the
    block that the others enclose. Fewer than `cfg.min_blocks` are in play if there is no room.
    While tracing, raises SceneError for slots that allow none, SettingsError for a small square.
    """
    least = 2.0 * (RADIUS + _MARGIN)
    if extent < least:
        raise SettingsError(f"heightmap.extent: packing needs at least {least:g} m, not {extent:g}")
    possible = packings.available(cfg.slots).values()
    key_sizes, key_family, key_pack, key_place, key_loose, key_looks = jax.random.split(key, 6)
    sizes = draw_sizes(key_sizes, cfg)
    draws = packings.draw(key_pack, len(cfg.slots))
    # All families, then a choice: under vmap lax.switch would compute all of them, too.
    options = [pack(family, cfg.slots, draws, sizes, level) for family in possible]
    chosen = jax.random.randint(key_family, (), 0, len(options))
    packed, target = jax.tree.map(lambda *leaves: jnp.stack(leaves)[chosen], *options)
    border = 0.5 * extent - _MARGIN
    placed = _add_loose(key_loose, cfg, border, level, _put_down(key_place, border, packed))
    return _scene(key_looks, cfg, placed, target)


def arrangements(cfg: SceneConfig, extent: float, stream: int, count: int) -> SceneState:
    """Draws `count` packed arrangements, NumPy leaves [P, N, ...], easy ones first. See `arrange`.

    If there is room, each has at least MIN_ARRANGED blocks, or `cfg.min_blocks` if that is less.
    """
    cfg = dataclasses.replace(cfg, min_blocks=min(cfg.min_blocks, MIN_ARRANGED))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(stream), jnp.arange(count))
    draw = jax.vmap(lambda key, level: arrange(key, cfg, extent, level))
    return jax.device_get(jax.jit(draw)(keys, jnp.linspace(0.0, 1.0, count)))


def draw_sizes(key: Array, cfg: SceneConfig) -> Array:
    """Samples half sizes [2, N, 3] m: of any shape of each slot's kind; of one of its longest."""
    key_any, key_long, key_scale = jax.random.split(key, 3)
    num, shapes = len(cfg.slots), [blocks.half_size_choices(kind) for kind in cfg.slots]
    longest = [choices[choices[:, 0] == choices[:, 0].max()] for choices in shapes]
    scale = blocks.scales(cfg, jax.random.uniform(key_scale, (num,), jnp.float32, -1.0, 1.0))

    def choose(key: Array, tables: list[np.ndarray]) -> Array:
        number = np.array([len(table) for table in tables], np.int32)
        row = jax.random.randint(key, (num,), 0, jnp.asarray(number))
        padded = np.stack([np.resize(table, (number.max(), 3)) for table in tables])
        return jnp.asarray(padded)[np.arange(num), row] * scale[:, None]

    return jnp.stack([choose(key_any, shapes), choose(key_long, longest)])


def pack(
    family: Family, slots: tuple[SlotKind, ...], draws: Draws, sizes: Array, level: Array
) -> tuple[Blocks, Array]:
    """Packs the blocks of a family about the origin; also returns the slot of the target []."""
    slot, used = _assign(draws.preference, slots, family.roles)
    optional = level * (0.75 + 0.25 * draws.optional) * (ROLES - family.needed)
    num_used = family.needed + jnp.round(optional).astype(jnp.int32)
    used = used & (np.arange(ROLES) < num_used)
    half = family.resize(sizes[np.array([role.long for role in family.roles], int), slot])
    on_side = draws.on_side < np.array([role.on_side for role in family.roles], np.float32)
    on_side = on_side & ~jnp.asarray(blocks.is_mesh(slots))[slot]
    half_lying = jnp.where(on_side[:, None], half[:, np.array([0, 2, 1])], half)
    half_lying = jnp.where(used[:, None], half_lying, 0.0)
    gap = GAPS[0] + (GAPS[1] - GAPS[0]) * (1.0 - level) * (0.5 + 0.5 * draws.gap)
    xy, crosswise, target, floor, yaw = family.place(draws, half_lying, used, gap)
    centre = jnp.concatenate([xy, (floor + half_lying[:, 2])[:, None]], axis=1)
    row = jnp.where(used, slot, len(slots))  # dropped where not used

    def by_slot(values: Array) -> Array:
        blank = jnp.zeros((len(slots), *values.shape[1:]), values.dtype)
        return blank.at[row].set(values, mode="drop")

    yaw = jnp.where(crosswise, np.float32(0.5 * np.pi), 0.0) + yaw
    half, lying = (sizes[0].at[row].set(size, mode="drop") for size in (half, half_lying))
    packed = Blocks(by_slot(centre), by_slot(yaw), by_slot(on_side), half, lying, by_slot(used))
    return packed, slot[target]


def _assign(
    preference: Array, slots: tuple[SlotKind, ...], roles: tuple[Role, ...]
) -> tuple[Array, Array]:
    """Assigns a slot to each role [R] int32, by `preference` [N], and tells if one was free [R]."""
    free = jnp.ones(len(slots), bool)
    chosen, is_free = [], []
    for role in roles:
        fits = free & np.array([kind in role.kinds for kind in slots])
        chosen.append(jnp.argmax(jnp.where(fits, preference, -1.0)).astype(jnp.int32))
        is_free.append(jnp.any(fits))
        free = free & ~(fits & (np.arange(len(slots)) == chosen[-1]))
    return jnp.stack(chosen), jnp.stack(is_free)


def _put_down(key: Array, border: float, packed: Blocks) -> Blocks:
    """Moves the packed blocks as one to a random yaw and place within `border` m of 0."""
    key_yaw, key_shift = jax.random.split(key)
    yaw = jax.random.uniform(key_yaw, (), jnp.float32, 0.0, 2.0 * np.pi)
    xy = geometry.rotate2d(yaw, packed.centre[:, :2])
    half_xy = _half_aligned(packed.yaw + yaw, packed.half_lying)
    low = jnp.min(jnp.where(packed.placed[:, None], xy - half_xy, jnp.inf), axis=0)
    high = jnp.max(jnp.where(packed.placed[:, None], xy + half_xy, -jnp.inf), axis=0)
    xy = xy + jax.random.uniform(key_shift, (2,), jnp.float32, -border - low, border - high)[None]
    return packed._replace(centre=packed.centre.at[:, :2].set(xy), yaw=packed.yaw + yaw)


def _half_aligned(yaw: Array, half: Array) -> Array:
    """Computes half extents [N, 2] m along world x and y of boxes `half` [N, 3] m at yaws [N]."""
    cos, sin = jnp.abs(jnp.cos(yaw)), jnp.abs(jnp.sin(yaw))
    x, y = cos * half[:, 0] + sin * half[:, 1], sin * half[:, 0] + cos * half[:, 1]
    return jnp.stack([x, y], axis=1)


def _add_loose(key: Array, cfg: SceneConfig, border: float, level: Array, packed: Blocks) -> Blocks:
    key_order, key_number, key_tries = jax.random.split(key, 3)
    num = len(cfg.slots)
    order = jax.random.permutation(key_order, num)
    share = jax.random.uniform(key_number, ())
    most = 1.0 + _MAX_LOOSE[0] + (_MAX_LOOSE[1] - _MAX_LOOSE[0]) * level
    extra = jnp.floor(share * most).astype(jnp.int32)
    total = jnp.maximum(jnp.sum(packed.placed) + extra, cfg.min_blocks)

    def add(i: Array, now: Blocks) -> Blocks:
        key = jax.random.fold_in(key_tries, i)
        is_free, xy, yaw = _free_place(key, border, now, now.half_size[order[i]])
        joins = is_free & ~now.placed[order[i]] & (jnp.sum(now.placed) < total)
        here = joins & (np.arange(num) == order[i])
        place = jnp.concatenate([xy, now.half_size[order[i], 2:]])
        return now._replace(
            centre=jnp.where(here[:, None], place[None], now.centre),
            yaw=jnp.where(here, yaw, now.yaw),
            placed=now.placed | here,
        )

    return jax.lax.fori_loop(0, num, add, packed)


def _free_place(key: Array, border: float, now: Blocks, half: Array) -> tuple[Array, Array, Array]:
    """Searches a place for a block of half size [3] m: success [] bool, xy [2] m, yaw [] rad."""
    key_xy, key_yaw = jax.random.split(key)
    yaw = jax.random.uniform(key_yaw, (_TRIES,), jnp.float32, 0.0, 2.0 * np.pi)
    room = border - _half_aligned(yaw, jnp.broadcast_to(half, (_TRIES, 3)))
    xy = jax.random.uniform(key_xy, (_TRIES, 2), jnp.float32, -1.0, 1.0) * room
    to_each = jax.vmap(_rectangle_gap, (None, 0))
    from_all = jax.vmap(to_each, ((0, 0, None), None))
    gap = from_all((xy, yaw, half[:2]), (now.centre[:, :2], now.yaw, now.half_lying[:, :2]))
    free = jnp.all((gap >= LOOSE_GAP) | ~now.placed[None], axis=1)  # [tries]
    first = jnp.argmax(free)
    return jnp.any(free), xy[first], yaw[first]


def _rectangle_gap(one: Rectangle, two: Rectangle) -> Array:
    """Computes the gap [] m of two rectangles along their best separating axis; < 0: overlap."""
    (xy, yaw, half), (other_xy, other_yaw, other_half) = one, two
    # Normals of all sides.
    angle = jnp.stack([yaw, yaw + 0.5 * np.pi, other_yaw, other_yaw + 0.5 * np.pi])
    between = jnp.cos(angle) * (other_xy - xy)[0] + jnp.sin(angle) * (other_xy - xy)[1]

    def half_width(yaw: Array, side: Array) -> Array:
        along = side[0] * jnp.abs(jnp.cos(angle - yaw))
        return along + side[1] * jnp.abs(jnp.sin(angle - yaw))

    return jnp.max(jnp.abs(between) - half_width(yaw, half) - half_width(other_yaw, other_half))


def _scene(key: Array, cfg: SceneConfig, placed: Blocks, target: Array) -> SceneState:
    key_colour, key_density, key_friction = jax.random.split(key, 3)
    num, num_colours = len(cfg.slots), len(blocks.COLOURS)
    colours = jax.random.permutation(key_colour, max(num, num_colours))[:num] % num_colours
    scene = scene_state.parked(cfg.slots)
    tilt = jnp.where(placed.on_side[:, None], _ON_SIDE[None], scene.quaternion)
    yaws = jax.vmap(geometry.quat_from_yaw)(placed.yaw)
    scene = scene.replace(
        position=placed.centre,
        quaternion=jax.vmap(geometry.quat_multiply)(yaws, tilt),
        half_size=placed.half_size,
        density=jax.random.uniform(key_density, (num,), jnp.float32, *cfg.density),
        friction=jax.random.uniform(key_friction, (num,), jnp.float32, *cfg.friction),
        colour=colours.astype(jnp.int32),
        in_play=placed.placed,
        target=target,
    )
    return scene_state.park(scene, placed.placed)
