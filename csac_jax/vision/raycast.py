"""One ray against the table, convex blocks and objects; callers vmap.

Faces and geoms are folded one after another, so vmap forms no [R, G, F] array. Half-spaces in the
world frame have no ray axis under `vmap(cast, in_axes=(None, 0, 0))`. A ray that starts inside a
geom does not hit it. Products are in scalars: under vmap every step is one fused loop over rays, 20
times faster than with vectors.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

_PARALLEL = np.float32(1e-30)  # n . d of a plane along the ray, in place of 0
_ON_PLANE = np.float32(1e-12)  # m, depth of an origin that lies on a plane

Vector = jax.Array | Sequence[jax.Array]  # [3], or its three scalars []
# Rows and columns [h, w] of a grid of rays -> their origin and direction, [h, w, 3] or one for all.
Ray = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]


@struct.dataclass
class Polytopes:
    """Convex blocks of one scene. G geoms, F faces of the one with the most.

    Unused faces have a zero normal and a positive offset. A geom of only such faces is never hit.
    """

    normal: jax.Array  # [G, F, 3] outward unit normals, body frame
    offset: jax.Array  # [G, F] m, normal . x <= offset inside
    position: jax.Array  # [G, 3] m, body origin in the world
    rotation: jax.Array  # [G, 3, 3] body to world
    colour: jax.Array  # [G, 3] red, green, blue in 0 .. 1


@struct.dataclass
class ObjectShapes:
    """Objects of many convex parts in one scene, world frame. M objects, C chunks of faces of the
    one with the most, F faces of a chunk; see `objects.tables`."""

    normal: jax.Array  # [M, C, F, 3] outward unit normals; unused faces as in Polytopes
    offset: jax.Array  # [M, C, F] m, normal . x <= offset inside
    first: jax.Array  # [M, C] bool, the chunk begins a part
    centre: jax.Array  # [M, 3] m, middle of the object
    colour: jax.Array  # [M, 3] red, green, blue in 0 .. 1
    radius: float = struct.field(pytree_node=False)  # m, of a ball about `centre` that holds it


class SurfaceHit(NamedTuple):
    """First hit of one ray. Surfaces: 0 the table, 1 + g F + f face f of geom g, then objects."""

    distance: jax.Array  # [] in lengths of the direction; infinite where not valid
    surface: jax.Array  # [] int32; 0 where not valid
    valid: jax.Array  # [] bool


def _dot(a: Vector, b: Vector) -> jax.Array:
    return functools.reduce(jnp.add, (a[axis] * b[axis] for axis in range(len(a))))


def clip(
    normal: jax.Array,
    offset: jax.Array,
    origin: Vector,
    direction: Vector,
    part: tuple[jax.Array, jax.Array, jax.Array],
    first: jax.Array | int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Cuts a ray's part (enter, leave, face), all [], by half-spaces, normals [F, 3] and offsets
    [F] m, numbered from `first` (slab method, Kay and Kajiya 1986).

    t = (offset - n . o) / (n . d) at each plane. The ray enters at the largest t with n . d < 0 and
    leaves at the smallest with n . d > 0. A parallel plane is left at t = +-1e30 (offset - n . o):
    never if the origin is inside or on it, at once if outside. 1 / (n . d) is computed first: rays
    that share a direction share the division.
    """
    enter, leave, face = part
    for f in range(normal.shape[0]):
        speed = _dot(normal[f], direction)
        inverse = 1.0 / jnp.where(speed == 0.0, _PARALLEL, speed)
        depth = (offset[f] - _dot(normal[f], origin)) + _ON_PLANE  # m, not negative inside
        crossing = depth * inverse
        inwards = jnp.where(speed < 0.0, crossing, -jnp.inf)
        face = jnp.where(inwards > enter, first + f, face)
        enter = jnp.maximum(enter, inwards)
        leave = jnp.minimum(leave, jnp.where(speed < 0.0, jnp.inf, crossing))
    return enter, leave, face


def world_half_spaces(polytopes: Polytopes) -> tuple[jax.Array, jax.Array]:
    """Returns the half-spaces of geoms in the world frame: normals [G, F, 3], offsets [G, F] m."""
    # Products and sums: some accelerators run a matrix product at reduced precision.
    normal = (polytopes.rotation[:, None, :, :] * polytopes.normal[:, :, None, :]).sum(-1)
    return normal, polytopes.offset + (normal * polytopes.position[:, None, :]).sum(-1)


def surface_normals(polytopes: Polytopes) -> jax.Array:
    """Returns the world normal [1 + G F, 3] of every surface, see `SurfaceHit`."""
    normal, _ = world_half_spaces(polytopes)
    return jnp.concatenate([jnp.array([[0.0, 0.0, 1.0]]), normal.reshape(-1, 3)])


def cast_polytopes(polytopes: Polytopes, origin: jax.Array, direction: jax.Array) -> SurfaceHit:
    """Finds the first surface on the ray from `origin` [3] m along `direction` [3], any length.

    Read colours and normals of a hit from a table of surfaces: computing them per ray is slower.
    """
    normal, offset = world_half_spaces(polytopes)
    geoms, faces = offset.shape
    falling = direction[2] < 0.0
    down = -origin[2] / jnp.where(falling, direction[2], -1.0)  # to the table, z = 0
    on_table = falling & (down >= 0.0)

    whole = jnp.float32(-jnp.inf), jnp.float32(jnp.inf), jnp.int32(0)

    def fold_geom(nearest, geom):
        distance, surface = nearest
        part = clip(geom[0], geom[1], origin, direction, whole, geom[2] * faces + 1)
        enter, leave, face = part
        closer = (enter >= 0.0) & (enter <= leave) & (enter < distance)
        return (jnp.where(closer, enter, distance), jnp.where(closer, face, surface)), None

    start = (jnp.where(on_table, down, jnp.inf), jnp.array(0, jnp.int32))
    rows = (normal, offset, jnp.arange(geoms, dtype=jnp.int32))
    (distance, surface), _ = jax.lax.scan(fold_geom, start, rows)
    return SurfaceHit(distance, surface, on_table | (surface > 0))


def cast_body(objects: ObjectShapes, origin: jax.Array, direction: jax.Array) -> SurfaceHit:
    """Finds the first face of one object, leaves without the axis M; faces count from 0.

    A part may span several chunks: a chunk with `first` begins the next part.
    """
    chunks, faces = objects.offset.shape

    def ended(nearest: Any, part: Any, ends: Any) -> Any:
        enter, leave, _ = part
        closer = ends & (enter >= 0.0) & (enter <= leave) & (enter < nearest[0])
        return jax.tree.map(functools.partial(jnp.where, closer), (enter, part[2]), nearest)

    def fold_chunk(carry: Any, chunk: Any) -> tuple[Any, None]:
        nearest, part = carry
        normal, offset, first, number = chunk
        nearest = ended(nearest, part, first)
        part = jax.tree.map(functools.partial(jnp.where, first), outside, part)
        part = clip(normal, offset, origin, direction, part, number * faces)
        return (nearest, part), None

    far, no_face = jnp.float32(jnp.inf), jnp.int32(0)
    outside: Any = (jnp.float32(-jnp.inf), far, no_face)
    start: Any = ((far, no_face), outside)
    rows = (objects.normal, objects.offset, objects.first, jnp.arange(chunks, dtype=jnp.int32))
    (nearest, last), _ = jax.lax.scan(fold_chunk, start, rows)
    distance, face = ended(nearest, last, jnp.array(True))
    return SurfaceHit(distance, face, distance < jnp.inf)


def cast_windows(
    objects: ObjectShapes,
    hits: SurfaceHit,
    corner: jax.Array,
    side: tuple[int, int],
    ray: Ray,
    first: int,
) -> SurfaceHit:
    """Adds objects to the hits [h, w] of a grid of rays; each is tested on a window of rays only.

    Args: corner [M, 2], whole numbers, first row and column of each object's window, which is moved
    into the grid and holds all rays that meet the object; side, its rows and columns; ray, see
    `Ray`; first, number of the objects' first surface.
    """
    most = jnp.asarray(np.array(hits.distance.shape) - side, jnp.float32)
    corner = jnp.clip(corner, 0.0, most[None]).astype(jnp.int32)
    rows, columns = jnp.meshgrid(*(jnp.arange(n, dtype=jnp.int32) for n in side), indexing="ij")
    size = objects.offset.shape[1] * objects.offset.shape[2]

    def fold_object(nearest: SurfaceHit, row: Any) -> tuple[SurfaceHit, None]:
        shapes, at, number = row
        before = jax.tree.map(lambda leaf: jax.lax.dynamic_slice(leaf, at, side), nearest)
        rays = ray(at[0] + rows, at[1] + columns)
        axes = (None, *(0 if leaf.ndim == 3 else None for leaf in rays))
        inside = jax.vmap(jax.vmap(cast_body, axes), axes)(shapes, *rays)
        after = inside._replace(surface=inside.surface + (first + number * size))
        closer = after.valid & (after.distance < before.distance)
        merged = jax.tree.map(functools.partial(jnp.where, closer), after, before)
        paste = functools.partial(jax.lax.dynamic_update_slice, start_indices=at)
        return jax.tree.map(paste, nearest, merged), None

    numbers = jnp.arange(len(corner), dtype=jnp.int32)
    return jax.lax.scan(fold_object, hits, (objects, corner, numbers))[0]
