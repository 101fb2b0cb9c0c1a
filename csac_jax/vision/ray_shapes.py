"""One ray against one geom of each kind, in the geom's own frame; callers vmap and fold.

A ray that starts inside a geom does not hit it. Distances are in lengths of the ray's direction.
All values are scalars: under vmap every step is one fused loop over rays, 20 times faster than with
vectors. Round surfaces are solved from the line's point nearest to the axis, since the textbook
b^2 - 4ac loses all digits from afar (Haines et al., Ray Tracing Gems, 2019, chapter 7).
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.world.solids import Kind

_PARALLEL = np.float32(1e-30)  # n . d of a plane along the ray, in place of 0
_ON_PLANE = np.float32(1e-12)  # m, depth of an origin that lies on a plane

Vector = jax.Array | Sequence[jax.Array]  # [3], or its three scalars []


class RayHit(NamedTuple):
    """Entry of one ray into one geom; all but `valid` are meaningless where not valid."""

    distance: jax.Array  # [] in lengths of the ray's direction, not negative
    normal: tuple[jax.Array, ...]  # [] x 3, outward, of unit length, in the geom's frame
    valid: jax.Array  # [] bool, True if it enters


def dot(a: Vector, b: Vector) -> jax.Array:
    """Returns the scalar product [] of two vectors, in scalars."""
    return functools.reduce(jnp.add, (a[axis] * b[axis] for axis in range(len(a))))


def enter_half_spaces(
    normal: jax.Array, offset: jax.Array, origin: Vector, direction: Vector
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Intersects one ray with half-spaces, normals [F, 3] and offsets [F] m (slab method, Kay and
    Kajiya 1986). Returns distance, face int32 and bool, the ray enters, all []; see `RayHit`.

    t = (offset - n . o) / (n . d) at each plane. The ray enters at the largest t with n . d < 0 and
    leaves at the smallest with n . d > 0. A parallel plane is left at t = +-1e30 (offset - n . o):
    never if the origin is inside or on it, at once if outside. 1 / (n . d) is computed first: rays
    that share a direction share the division.
    """
    whole = jnp.float32(-jnp.inf), jnp.float32(jnp.inf), jnp.int32(0)
    enter, leave, face = clip(normal, offset, origin, direction, whole, 0)
    return enter, face, (enter >= 0.0) & (enter <= leave)


def clip(
    normal: jax.Array,
    offset: jax.Array,
    origin: Vector,
    direction: Vector,
    part: tuple[jax.Array, jax.Array, jax.Array],
    first: jax.Array | int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Cuts a ray's part (enter, leave, face), all [], by half-spaces, numbered from `first`."""
    enter, leave, face = part
    for f in range(normal.shape[0]):
        speed = dot(normal[f], direction)
        inverse = 1.0 / jnp.where(speed == 0.0, _PARALLEL, speed)
        depth = (offset[f] - dot(normal[f], origin)) + _ON_PLANE  # m, not negative inside
        crossing = depth * inverse
        inwards = jnp.where(speed < 0.0, crossing, -jnp.inf)
        face = jnp.where(inwards > enter, first + f, face)
        enter = jnp.maximum(enter, inwards)
        leave = jnp.minimum(leave, jnp.where(speed < 0.0, jnp.inf, crossing))
    return enter, leave, face


def ray_plane(size: jax.Array, origin: Vector, direction: Vector) -> RayHit:
    """Intersects the upper side of the plane z = 0, |x| <= size[0], |y| <= size[1]; 0: endless."""
    falling = direction[2] < 0.0
    distance = -origin[2] / jnp.where(falling, direction[2], -1.0)
    inside = falling & (distance >= 0.0)
    for axis in range(2):
        place = jnp.abs(origin[axis] + distance * direction[axis])
        inside &= (size[axis] <= 0.0) | (place <= size[axis])
    zero = jnp.zeros_like(distance)
    return RayHit(distance, (zero, zero, zero + 1.0), inside)


def _slab(half: jax.Array, origin: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns entry and exit [] of |x| <= half on an axis: crossed if missed, -+inf if parallel."""
    parallel = ~(jnp.abs(direction) > 0.0)
    inverse = 1.0 / jnp.where(parallel, 1.0, direction)
    middle, reach = -origin * inverse, half * jnp.abs(inverse)
    always = jnp.where(jnp.abs(origin) <= half, jnp.inf, -jnp.inf)
    enter, leave = jnp.where(parallel, -always, middle - reach), middle + reach
    return enter, jnp.where(parallel, always, leave)


def _ball(radius: jax.Array, origin: Vector, direction: Vector) -> tuple[jax.Array, jax.Array]:
    """Returns entry and exit [] of a ball of `radius` m; for two axes, of z's endless tube."""
    square = dot(direction, direction)
    parallel = ~(square > 0.0)
    safe = jnp.where(parallel, 1.0, square)
    nearest = -dot(origin, direction) / safe  # t at which the line passes the centre
    miss = [a + nearest * b for a, b in zip(origin, direction, strict=True)]
    half_chord_sq = radius * radius - dot(miss, miss)  # m^2
    hits = half_chord_sq >= 0.0
    half = jnp.sqrt(jnp.where(hits, half_chord_sq, 0.0) / safe)
    half = jnp.where(hits, jnp.where(parallel, jnp.inf, half), -jnp.inf)
    return nearest - half, nearest + half


def ray_box(size: jax.Array, origin: Vector, direction: Vector) -> RayHit:
    """Intersects the box of half sizes `size` [3]: the ray enters through the slab entered last."""
    slabs = [_slab(size[axis], origin[axis], direction[axis]) for axis in range(3)]
    enters, leaves = zip(*slabs, strict=True)
    enter, leave = functools.reduce(jnp.maximum, enters), functools.reduce(jnp.minimum, leaves)
    x = enters[0] == enter
    y = ~x & (enters[1] == enter)
    sides = zip((x, y, ~x & ~y), direction, strict=True)
    normal = tuple(jnp.where(side, -jnp.sign(along), 0.0) for side, along in sides)
    return RayHit(enter, normal, (enter >= 0.0) & (enter <= leave))


def ray_sphere(size: jax.Array, origin: Vector, direction: Vector) -> RayHit:
    """Intersects the sphere of radius size[0]: |o + t d| = r."""
    distance, _ = _ball(size[0], origin, direction)
    normal = tuple((origin[axis] + distance * direction[axis]) / size[0] for axis in range(3))
    return RayHit(distance, normal, (distance >= 0.0) & (distance < jnp.inf))


def ray_cylinder(size: jax.Array, origin: Vector, direction: Vector) -> RayHit:
    """Intersects the cylinder about z of radius size[0], half length size[1]: tube and slab."""
    enter_side, leave_side = _ball(size[0], origin[:2], direction[:2])
    enter_end, leave_end = _slab(size[1], origin[2], direction[2])
    distance = jnp.maximum(enter_side, enter_end)
    valid = (distance >= 0.0) & (distance <= jnp.minimum(leave_side, leave_end))
    end = enter_end > enter_side  # through an end, not the side
    x, y = ((origin[axis] + distance * direction[axis]) / size[0] for axis in range(2))
    side, cap = (x, y, jnp.zeros_like(x)), (0.0, 0.0, -jnp.sign(direction[2]))
    return RayHit(distance, jax.tree.map(functools.partial(jnp.where, end), cap, side), valid)


def ray_capsule(size: jax.Array, origin: Vector, direction: Vector) -> RayHit:
    """Intersects the capsule about z of radius size[0], half length size[1] without its caps.

    A line that enters the endless tube between the caps enters the capsule there. Beyond an end it
    can hit only the sphere there; so can a parallel ray that starts beyond it.
    """
    enter, _ = _ball(size[0], origin[:2], direction[:2])
    z = origin[2] + jnp.where(jnp.isinf(enter), 0.0, enter) * direction[2]
    middle = jnp.abs(z) <= size[1]
    cap = ray_sphere(size, (origin[0], origin[1], origin[2] - jnp.sign(z) * size[1]), direction)
    x, y = ((origin[axis] + enter * direction[axis]) / size[0] for axis in range(2))
    side = RayHit(enter, (x, y, jnp.zeros_like(x)), enter >= 0.0)
    entry = jax.tree.map(functools.partial(jnp.where, middle), side, cap)
    return entry._replace(valid=entry.valid & (enter < jnp.inf))


def ray_polytope(faces: jax.Array, origin: Vector, direction: Vector) -> RayHit:
    """Intersects the polytope of half-spaces `faces` [F, 4]: outward unit normal and offset m."""
    distance, face, valid = enter_half_spaces(faces[:, :3], faces[:, 3], origin, direction)
    normal = (faces[:, axis].at[face].get(mode="promise_in_bounds") for axis in range(3))
    return RayHit(distance, tuple(normal), valid)


RAY: dict[Kind, Callable[[jax.Array, Vector, Vector], RayHit]] = {
    Kind.PLANE: ray_plane,
    Kind.BOX: ray_box,
    Kind.SPHERE: ray_sphere,
    Kind.CAPSULE: ray_capsule,
    Kind.CYLINDER: ray_cylinder,
    Kind.POLYTOPE: ray_polytope,
}
"""Per kind, a function of a row of `GeomGroup.shape`, the ray's origin [3] m and direction [3]."""
