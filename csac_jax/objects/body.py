"""An object: a rigid body of convex parts, and the checks it must pass to be simulated.

Its frame has the axes of its file and its origin at the centre of mass.
"""

import dataclasses
import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from csac_jax.objects import solid
from csac_jax.objects.solid import Moments, Part

HELD_OUT = 0.2  # share of the names
MOST_PARTS = 32
DENSITY = 600.0  # kg/m^3, of objects that name no other
DENSITIES = 50.0, 25_000.0  # kg/m^3, least and most
LARGEST = 0.4  # m, of a side: more than fits on the table


@dataclasses.dataclass(frozen=True, eq=False)
class Object:
    """A rigid body. Its origin is the centre of mass."""

    name: str
    parts: tuple[Part, ...]  # the largest first
    volume: float  # m^3, of the body, from which its mass follows
    inertia: np.ndarray  # [3, 3] m^5, of density 1
    family: str = ""
    source: str = ""  # file that it was read from
    source_sha256: str = ""
    scale: float = 1.0  # m per unit of that file
    density: float = DENSITY  # kg/m^3; scenes draw theirs relative to DENSITY

    @property
    def bounds(self) -> np.ndarray:
        """Returns the lowest and highest corner of the bounding box [2, 3] m."""
        points = np.concatenate([part.vertices for part in self.parts])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    @property
    def narrowest(self) -> float:
        """Returns the least width, m, between parallel planes, one along a face of the hull."""
        points = np.concatenate([part.vertices for part in self.parts])
        hull = ConvexHull(points)
        along = np.einsum("fi,ni->fn", hull.equations[:, :3], points[hull.vertices])
        return float(np.ptp(along, axis=1).min())

    @property
    def held_out(self) -> bool:
        """Returns True for an object kept for evaluation: decided by digests, never by hand."""
        names = (self.source_sha256 or self.name, self.family)
        digests = (hashlib.sha256(name.encode()).digest() for name in names if name)
        return any(int.from_bytes(d[:8], "big") / 2**64 < HELD_OUT for d in digests)


def make(name: str, parts: Sequence[Part], whole: Moments | None = None, **more: Any) -> Object:
    """Builds an object of convex parts, which must not overlap unless `whole` has its integrals."""
    whole = whole or solid.joined(map(solid.moments, parts))
    com = whole.first / whole.volume
    shifted = [solid.moved(part, -com) for part in parts]
    shifted.sort(key=lambda part: -np.square(np.ptp(part.vertices, axis=0)).sum())
    return Object(name, tuple(shifted), whole.volume, solid.inertia(whole), **more)


def faults(one: Object) -> str | None:
    """Finds the first reason that an object cannot be simulated; None for a sound one."""
    if not (one.name.isprintable() and 1 <= len(one.name) <= 100):
        return "has no name of 1 to 100 printable characters"
    size = np.ptp(one.bounds, axis=0)
    if not (size.min() >= 1e-3 and size.max() <= LARGEST):
        sides = f"{1e3 * size.min():.3g} to {1e3 * size.max():.3g}"
        return f"has sides of {sides} mm, not 1 to {1e3 * LARGEST:g}"
    faces = max(len(part.planes) for part in one.parts)
    if len(one.parts) > MOST_PARTS or faces > solid.MOST_FACES:
        return f"has more than {MOST_PARTS} parts, or a part of more than {solid.MOST_FACES} faces"
    if not (0.0 < one.volume <= 1.01 * np.prod(size)):
        return "has a volume that is not positive, or larger than its bounding box"
    if not DENSITIES[0] <= one.density <= DENSITIES[1]:
        return f"has a density of {one.density:.3g} kg/m^3, not 50 to 25000"
    if one.inertia.shape != (3, 3) or not np.isfinite(one.inertia).all():
        return "has no inertia of 3 x 3 numbers"
    low, middle, high = np.linalg.eigvalsh(one.inertia)
    if not (low > 0.0 and low + middle >= 0.999 * high):
        return "has an inertia that no body can have"
    return None
