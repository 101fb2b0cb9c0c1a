"""One ray against one geom of each kind, in the geom's own frame; callers vmap and fold.

A ray that starts inside a geom does not hit it. Distances are in lengths of the ray's direction.
All values are scalars: under vmap every step is one fused loop over rays, 20 times faster than with
vectors. Round surfaces are solved from the line's point nearest to the axis, since the textbook
b^2 - 4ac loses all digits from afar (Haines et al., Ray Tracing Gems, 2019, chapter 7).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.scene.solids import Kind

_PARALLEL = np.float32(1e-30)  # n . d of a plane along the ray, in place of 0
_ON_PLANE = np.float32(1e-12)  # m, depth of an origin that lies on a plane

Vector = jax.Array | Sequence[jax.Array]
"""[3], or its three scalars []."""


class Entry(NamedTuple):
    """Where one ray enters one geom; all but `valid` are meaningless where not valid."""

    distance: jax.Array  # [] in lengths of the ray's direction, not negative
    normal: tuple[jax.Array, jax.Array, jax.Array]  # outward, of unit length, in the geom's frame
    valid: jax.Array  # [] bool, True if it enters


class FaceEntry(NamedTuple):
    """As `Entry`, of an intersection of half-spaces, with the face in place of its normal."""

    distance: jax.Array  # [] in lengths of the ray's direction, not negative
    face: jax.Array  # [] int32, face through which it enters
    valid: jax.Array  # [] bool, True if it enters


def dot(a: Vector, b: Vector) -> jax.Array:
    """Scalar product [] of two vectors [3], in scalars."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def enter_half_spaces(
    normal: jax.Array, offset: jax.Array, origin: Vector, direction: Vector
) -> FaceEntry:
    """One ray against one intersection of half-spaces (slab method, Kay and Kajiya 1986).

    t = (offset - n . o) / (n . d) at each plane. The ray enters at the largest t with n . d < 0 and
    leaves at the smallest with n . d > 0. A parallel plane is left at t = +-1e30 (offset - n . o):
    never if the origin is inside or on it, at once if outside. 1 / (n . d) is computed first: rays
    that share a direction share the division.

    Args: normal [F, 3] and offset [F] m; origin [3] m, direction [3].
    """
    enter, leave = jnp.array(-jnp.inf, jnp.float32), jnp.array(jnp.inf, jnp.float32)
    face = jnp.array(0, jnp.int32)
    for f in range(normal.shape[0]):
        speed = dot(normal[f], direction)
        inverse = 1.0 / jnp.where(speed == 0.0, _PARALLEL, speed)
        depth = (offset[f] - dot(normal[f], origin)) + _ON_PLANE  # m, not negative inside
        crossing = depth * inverse
        inwards = jnp.where(speed < 0.0, crossing, -jnp.inf)
        face = jnp.where(inwards > enter, f, face)
        enter = jnp.maximum(enter, inwards)
        leave = jnp.minimum(leave, jnp.where(speed < 0.0, jnp.inf, crossing))
    return FaceEntry(enter, face, (enter >= 0.0) & (enter <= leave))


def ray_plane(size: jax.Array, origin: Vector, direction: Vector) -> Entry:
    """The upper side of the plane z = 0, |x| <= size[0] and |y| <= size[1]; 0 means no end."""
    falling = direction[2] < 0.0
    distance = -origin[2] / jnp.where(falling, direction[2], -1.0)
    inside = falling & (distance >= 0.0)
    for axis in range(2):
        endless = size[axis] <= 0.0
        place = jnp.abs(origin[axis] + distance * direction[axis])
        inside &= endless | (place <= size[axis])
    zero = jnp.zeros_like(distance)
    return Entry(distance, (zero, zero, zero + 1.0), inside)


def ray_box(size: jax.Array, origin: Vector, direction: Vector) -> Entry:
    """The box of half sizes `size` [3]: the ray enters through the slab that it enters last."""
    enter, leave = jnp.array(-jnp.inf, jnp.float32), jnp.array(jnp.inf, jnp.float32)
    side, excluded = jnp.array(0, jnp.int32), jnp.array(False)
    for axis in range(3):
        parallel = ~(jnp.abs(direction[axis]) > 0.0)
        inverse = 1.0 / jnp.where(parallel, 1.0, direction[axis])
        middle, half = -origin[axis] * inverse, size[axis] * jnp.abs(inverse)
        later = ~parallel & (middle - half > enter)
        enter, side = jnp.where(later, middle - half, enter), jnp.where(later, axis, side)
        leave = jnp.where(parallel, leave, jnp.minimum(leave, middle + half))
        excluded |= parallel & (jnp.abs(origin[axis]) > size[axis])
    normal = [jnp.where(side == axis, -jnp.sign(direction[axis]), 0.0) for axis in range(3)]
    valid = ~excluded & (enter >= 0.0) & (enter <= leave)
    return Entry(enter, (normal[0], normal[1], normal[2]), valid)


def ray_sphere(size: jax.Array, origin: Vector, direction: Vector) -> Entry:
    """The sphere of radius size[0]: |o + t d| = r."""
    square = dot(direction, direction)
    nearest = -dot(origin, direction) / square  # t at which the line passes the centre
    miss = [origin[axis] + nearest * direction[axis] for axis in range(3)]
    half_chord_sq = size[0] * size[0] - dot(miss, miss)  # m^2
    hits = half_chord_sq >= 0.0
    distance = nearest - jnp.sqrt(jnp.where(hits, half_chord_sq, 0.0) / square)
    x, y, z = ((origin[axis] + distance * direction[axis]) / size[0] for axis in range(3))
    return Entry(distance, (x, y, z), hits & (distance >= 0.0))


def _tube(
    radius: jax.Array, origin: Vector, direction: Vector
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where the ray's line enters and leaves the endless cylinder about z, and whether it does.

    -inf and inf for a parallel line inside.
    """
    square = direction[0] * direction[0] + direction[1] * direction[1]
    parallel = ~(square > 0.0)
    safe = jnp.where(parallel, 1.0, square)
    nearest = -(origin[0] * direction[0] + origin[1] * direction[1]) / safe
    x, y = (origin[axis] + nearest * direction[axis] for axis in range(2))
    half_chord_sq = radius * radius - (x * x + y * y)
    hits = half_chord_sq >= 0.0
    half = jnp.sqrt(jnp.where(hits, half_chord_sq, 0.0) / safe)
    half = jnp.where(parallel, jnp.inf, half)
    return nearest - half, nearest + half, hits


def ray_cylinder(size: jax.Array, origin: Vector, direction: Vector) -> Entry:
    """The cylinder about z of radius size[0] and half length size[1]: tube and slab."""
    enter_side, leave_side, hits = _tube(size[0], origin, direction)
    parallel = ~(jnp.abs(direction[2]) > 0.0)
    inverse = 1.0 / jnp.where(parallel, 1.0, direction[2])
    middle, half = -origin[2] * inverse, jnp.where(parallel, jnp.inf, size[1] * jnp.abs(inverse))
    distance = jnp.maximum(enter_side, middle - half)
    hits &= (distance <= jnp.minimum(leave_side, middle + half)) & (distance >= 0.0)
    hits &= ~parallel | (jnp.abs(origin[2]) <= size[1])
    end = middle - half > enter_side  # through an end, not the side
    x, y = (
        jnp.where(end, 0.0, (origin[axis] + distance * direction[axis]) / size[0])
        for axis in range(2)
    )
    return Entry(distance, (x, y, jnp.where(end, -jnp.sign(direction[2]), 0.0)), hits)


def ray_capsule(size: jax.Array, origin: Vector, direction: Vector) -> Entry:
    """The capsule about z of radius size[0], half length size[1] without its caps.

    A line that enters the endless tube between the caps enters the capsule there. One that enters
    it beyond an end can hit only the sphere at that end. A parallel ray can hit only the sphere at
    the end beyond which it starts.
    """
    enter, _, hits = _tube(size[0], origin, direction)
    z = origin[2] + jnp.where(jnp.isinf(enter), 0.0, enter) * direction[2]
    middle = jnp.abs(z) <= size[1]
    cap = ray_sphere(size, (origin[0], origin[1], origin[2] - jnp.sign(z) * size[1]), direction)
    x, y = ((origin[axis] + enter * direction[axis]) / size[0] for axis in range(2))
    normal = tuple(
        jnp.where(middle, a, b) for a, b in zip((x, y, jnp.zeros_like(x)), cap.normal, strict=True)
    )
    valid = hits & jnp.where(middle, enter >= 0.0, cap.valid)
    return Entry(jnp.where(middle, enter, cap.distance), (normal[0], normal[1], normal[2]), valid)


def ray_polytope(faces: jax.Array, origin: Vector, direction: Vector) -> Entry:
    """The polytope of the half-spaces `faces` [F, 4]: outward unit normal and offset m."""
    entry = enter_half_spaces(faces[:, :3], faces[:, 3], origin, direction)
    x, y, z = (faces[:, axis].at[entry.face].get(mode="promise_in_bounds") for axis in range(3))
    return Entry(entry.distance, (x, y, z), entry.valid)


RAY: dict[Kind, Callable[[jax.Array, Vector, Vector], Entry]] = {
    Kind.PLANE: ray_plane,
    Kind.BOX: ray_box,
    Kind.SPHERE: ray_sphere,
    Kind.CAPSULE: ray_capsule,
    Kind.CYLINDER: ray_cylinder,
    Kind.POLYTOPE: ray_polytope,
}
"""Per kind, a function of the shape (a row of `Group.shape`), the ray's origin [3] m and direction
[3]."""
