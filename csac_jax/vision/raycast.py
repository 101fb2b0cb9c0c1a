"""Rays against the table and convex blocks, one ray at a time: callers vmap over rays with the
scene held fixed.

A block is an intersection of half-spaces, so a ray enters it at the last plane that it crosses
inwards and leaves it at the first plane that it crosses outwards (slab method, Kay and Kajiya
1986). Faces and geoms are folded one after another with running maxima and minima: under vmap no
[R, G, F] array is ever formed. What depends on the scene alone (the half-spaces in the world frame)
has no ray axis under `vmap(cast, in_axes=(None, 0, 0))`, so it is done once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax.scene.solids import GeomGroup, Solids
from csac_jax.vision import shapes

TABLE = -1
"""`Hit.geom` of the table."""


@struct.dataclass
class Polytopes:
    """Convex blocks of one scene. G geoms, F faces of the one with the most; colour is for the eye
    only.

    Unused faces have a zero normal and a positive offset: they bound nothing. A geom of such faces
    alone is never hit.
    """

    normal: jax.Array  # [G, F, 3] outward unit normals, body frame
    offset: jax.Array  # [G, F] m, normal . x <= offset inside
    position: jax.Array  # [G, 3] m, body origin in the world
    rotation: jax.Array  # [G, 3, 3] body to world
    colour: jax.Array  # [G, 3] red, green, blue in 0 .. 1


@struct.dataclass
class Hit:
    """Where one ray first meets something."""

    distance: jax.Array  # [] in lengths of the ray's direction; infinite where not valid
    normal: (
        jax.Array
    )  # [3] outward unit normal of the surface, world frame; meaningless where not valid
    geom: (
        jax.Array
    )  # [] int32, index into Polytopes, TABLE for the table; meaningless where not valid
    valid: jax.Array  # [] bool, True if the ray meets anything


class Meeting(NamedTuple):
    """Where one ray first meets a block or the table. Surfaces: 0 is the table, 1 + g F + f face f
    of geom g."""

    distance: jax.Array  # [] in lengths of the ray's direction; infinite where not valid
    surface: jax.Array  # [] int32; 0 where not valid
    valid: jax.Array  # [] bool, True if the ray meets anything


def world_half_spaces(polytopes: Polytopes) -> tuple[jax.Array, jax.Array]:
    """Half-spaces of every geom in the world frame: normals [G, F, 3] and offsets [G, F] m."""
    # Written as products and sums: a matrix product would run at reduced precision on some
    # accelerators.
    normal = (polytopes.rotation[:, None, :, :] * polytopes.normal[:, :, None, :]).sum(-1)
    return normal, polytopes.offset + (normal * polytopes.position[:, None, :]).sum(-1)


def surfaces(polytopes: Polytopes) -> tuple[jax.Array, jax.Array]:
    """Of every surface (see `Meeting`): normal [1 + G F, 3] in the world frame, and geom [1 + G F]
    int32 or TABLE."""
    normal, _ = world_half_spaces(polytopes)
    geoms, faces = normal.shape[:2]
    up = jnp.array([[0.0, 0.0, 1.0]], jnp.float32)
    geom = np.concatenate([[TABLE], np.repeat(np.arange(geoms), faces)])
    return jnp.concatenate([up, normal.reshape(-1, 3)]), jnp.asarray(geom, jnp.int32)


def meet(polytopes: Polytopes, origin: jax.Array, direction: jax.Array) -> Meeting:
    """First surface that the ray from `origin` [3] m along `direction` [3] (any length) meets,
    world frame.

    4096 rays straight down in each of 64 scenes of 12 geoms with 10 faces: 6 ms on two CPU cores.
    What is known of a surface, such as its colour, is better read from a table of surfaces than
    computed for every ray: reading the normal alone takes longer than finding the surface.
    """
    normal, offset = world_half_spaces(polytopes)
    geoms, faces = offset.shape
    table = shapes.ray_plane(jnp.zeros(3), origin, direction)

    def fold_geom(nearest, geom):
        distance, surface = nearest
        entry = shapes.enter_half_spaces(geom[0], geom[1], origin, direction)
        closer = entry.valid & (entry.distance < distance)
        surface = jnp.where(closer, geom[2] * faces + entry.face + 1, surface)
        return (jnp.where(closer, entry.distance, distance), surface), None

    start = (jnp.where(table.valid, table.distance, jnp.inf), jnp.array(0, jnp.int32))
    (distance, surface), _ = jax.lax.scan(
        fold_geom, start, (normal, offset, jnp.arange(geoms, dtype=jnp.int32))
    )
    return Meeting(distance, surface, table.valid | (surface > 0))


def cast(polytopes: Polytopes, origin: jax.Array, direction: jax.Array) -> Hit:
    """As `meet`, with the normal and the geom of what is met."""
    normal, geom = surfaces(polytopes)
    distance, surface, valid = meet(polytopes, origin, direction)
    at = (
        normal.at[surface].get(mode="promise_in_bounds"),
        geom.at[surface].get(mode="promise_in_bounds"),
    )
    return Hit(distance, at[0], at[1], valid)


def cast_solids(solids: Solids, origin: jax.Array, direction: jax.Array) -> Hit:
    """First geom of any kind that the ray from `origin` [3] m along `direction` [3] (any length)
    meets, world frame.

    There is no table here but what `solids` holds; `Hit.geom` is the geom's number. Kinds are
    folded one after another, each as one loop over its geoms.
    """
    zero = jnp.zeros((), jnp.float32)
    nearest: Nearest = (
        jnp.array(jnp.inf, jnp.float32),
        (zero, zero, zero),
        jnp.array(-1, jnp.int32),
    )
    for group in solids.groups:
        nearest = _fold_group(group, origin, direction, nearest)
    distance, normal, geom = nearest
    return Hit(distance, jnp.stack(normal), geom, geom >= 0)


Nearest = tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array], jax.Array]
"""Of the nearest entry so far: distance [], normal [] x 3 in the world frame, number of the geom []
int32 or -1."""


def _fold_group(
    group: GeomGroup, origin: jax.Array, direction: jax.Array, nearest: Nearest
) -> Nearest:
    ray = shapes.RAY[group.kind]

    def fold(nearest: Nearest, geom: tuple[jax.Array, ...]) -> tuple[Nearest, None]:
        shape, position, turn, number = geom
        away = [origin[axis] - position[axis] for axis in range(3)]
        local = [
            [shapes.dot(turn[:, axis], vector) for axis in range(3)] for vector in (away, direction)
        ]
        entry = ray(shape, *local)
        closer = entry.valid & (entry.distance < nearest[0])
        normal = tuple(shapes.dot(turn[axis], entry.normal) for axis in range(3))
        return jax.tree.map(
            lambda new, old: jnp.where(closer, new, old), (entry.distance, normal, number), nearest
        ), None

    return jax.lax.scan(fold, nearest, (group.shape, group.position, group.rotation, group.geom))[0]
