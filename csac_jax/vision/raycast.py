"""One ray against the table and convex blocks, or against geoms of any kind; callers vmap.

A block is an intersection of half-spaces. A ray enters it at the last plane that it crosses inwards
and leaves at the first that it crosses outwards (slab method, Kay and Kajiya 1986). Faces and geoms
are folded one after another, so vmap forms no [R, G, F] array. Half-spaces in the world frame have
no ray axis under `vmap(cast, in_axes=(None, 0, 0))`: they are computed once per scene.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax.scene.solids import GeomGroup, Solids
from csac_jax.vision import shapes


@struct.dataclass
class Polytopes:
    """Convex blocks of one scene. G geoms, F faces of the one with the most.

    Unused faces have a zero normal and a positive offset: they bound nothing. A geom that has only
    such faces is never hit.
    """

    normal: jax.Array  # [G, F, 3] outward unit normals, body frame
    offset: jax.Array  # [G, F] m, normal . x <= offset inside
    position: jax.Array  # [G, 3] m, body origin in the world
    rotation: jax.Array  # [G, 3, 3] body to world
    colour: jax.Array  # [G, 3] red, green, blue in 0 .. 1


@struct.dataclass
class Hit:
    """Where one ray first hits; normal and geom are meaningless where not valid."""

    distance: jax.Array  # [] in lengths of the ray's direction; infinite where not valid
    normal: jax.Array  # [3] outward unit normal of the surface, world frame
    geom: jax.Array  # [] int32, number of the geom
    valid: jax.Array  # [] bool, True if the ray hits anything


class SurfaceHit(NamedTuple):
    """Where one ray first hits: surface 0 is the table, 1 + g F + f is face f of geom g."""

    distance: jax.Array  # [] in lengths of the ray's direction; infinite where not valid
    surface: jax.Array  # [] int32; 0 where not valid
    valid: jax.Array  # [] bool, True if the ray hits anything


def world_half_spaces(polytopes: Polytopes) -> tuple[jax.Array, jax.Array]:
    """Half-spaces of every geom in the world frame: normals [G, F, 3] and offsets [G, F] m."""
    # Products and sums: some accelerators run a matrix product at reduced precision.
    normal = (polytopes.rotation[:, None, :, :] * polytopes.normal[:, :, None, :]).sum(-1)
    return normal, polytopes.offset + (normal * polytopes.position[:, None, :]).sum(-1)


def surface_normals(polytopes: Polytopes) -> jax.Array:
    """World normal [1 + G F, 3] of every surface, see `SurfaceHit`."""
    normal, _ = world_half_spaces(polytopes)
    up = jnp.array([[0.0, 0.0, 1.0]], jnp.float32)
    return jnp.concatenate([up, normal.reshape(-1, 3)])


def cast_polytopes(polytopes: Polytopes, origin: jax.Array, direction: jax.Array) -> SurfaceHit:
    """First surface on the ray from `origin` [3] m along `direction` [3] of any length.

    Read properties of a surface, such as its colour, from a table of surfaces: to compute the
    normal alone for every ray takes longer than to find the surface.
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
    geom_rows = (normal, offset, jnp.arange(geoms, dtype=jnp.int32))
    (distance, surface), _ = jax.lax.scan(fold_geom, start, geom_rows)
    return SurfaceHit(distance, surface, table.valid | (surface > 0))


def cast_solids(solids: Solids, origin: jax.Array, direction: jax.Array) -> Hit:
    """First geom of `solids` on the ray from `origin` [3] m along `direction` [3] of any length.

    There is no table unless `solids` has one. Each kind of geom is one loop.
    """
    zero = jnp.zeros((), jnp.float32)
    distance = jnp.array(jnp.inf, jnp.float32)
    nearest: Nearest = (distance, (zero, zero, zero), jnp.array(-1, jnp.int32))
    for group in solids.groups:
        nearest = _fold_group(group, origin, direction, nearest)
    distance, normal, geom = nearest
    return Hit(distance, jnp.stack(normal), geom, geom >= 0)


Nearest = tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array], jax.Array]
"""The nearest entry so far: distance [], world normal [] x 3, geom [] int32 or -1."""


def _fold_group(
    group: GeomGroup, origin: jax.Array, direction: jax.Array, nearest: Nearest
) -> Nearest:
    ray = shapes.RAY[group.kind]

    def fold(nearest: Nearest, geom: tuple[jax.Array, ...]) -> tuple[Nearest, None]:
        shape, position, rotation, number = geom
        offset = [origin[axis] - position[axis] for axis in range(3)]
        local = [
            [shapes.dot(rotation[:, axis], vector) for axis in range(3)]
            for vector in (offset, direction)
        ]
        entry = ray(shape, *local)
        closer = entry.valid & (entry.distance < nearest[0])
        normal = tuple(shapes.dot(rotation[axis], entry.normal) for axis in range(3))
        found = (entry.distance, normal, number)
        return jax.tree.map(lambda new, old: jnp.where(closer, new, old), found, nearest), None

    return jax.lax.scan(fold, nearest, (group.shape, group.position, group.rotation, group.geom))[0]
