"""Convex parts, and the mass and inertia of what they make up.

Integrals over a polyhedron are sums over the tetrahedra of its triangles with the origin (Tonon
2005, J. Math. Stat. 1, 8-11). Products use `einsum`: BLAS, which `@` calls, rounds differently on
each kind of processor, and a pile of falling bodies amplifies a last bit.
"""

import dataclasses
import itertools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

MOST_FACES = 64  # of a part, after faces in one plane are merged
_SAME_PLANE = 4  # decimals of normals and, in units of the part's size, of offsets


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """A convex polyhedron. V corners, T triangles, F faces."""

    vertices: np.ndarray  # [V, 3] float32 m
    triangles: np.ndarray  # [T, 3] int32, corners counter-clockwise as seen from outside
    planes: np.ndarray  # [F, 4] float32, outward unit normal and offset m; n . p <= offset inside


class Moments(NamedTuple):
    """Integrals over a solid of density 1."""

    volume: float  # m^3
    first: np.ndarray  # [3] m^4, of x
    second: np.ndarray  # [3, 3] m^5, of x x^T


def convex(points: np.ndarray) -> Part:
    """Builds the convex hull of points [n, 3] m. Raises ValueError for one without volume."""
    points = np.asarray(points, np.float32).astype(np.float64)
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        raise ValueError("its points lie in one plane") from None
    corners, triangles = np.unique(hull.simplices, return_inverse=True)
    triangles = triangles.reshape(hull.simplices.shape)
    vertices = points[corners]
    sides = np.diff(vertices[triangles], axis=1)  # [T, 2, 3]
    inwards = np.einsum("ti,ti->t", np.cross(*sides.transpose(1, 0, 2)), hull.equations[:, :3]) < 0
    triangles[inwards] = triangles[inwards][:, [0, 2, 1]]
    planes = hull.equations * [1, 1, 1, -1]
    rounded = (planes / [1, 1, 1, np.ptp(vertices, axis=0).max()]).round(_SAME_PLANE)
    distinct = np.sort(np.unique(rounded, axis=0, return_index=True)[1])
    vertices, planes = vertices.astype(np.float32), planes[distinct].astype(np.float32)
    return Part(vertices, triangles.astype(np.int32), planes)


def simplified(points: np.ndarray) -> Part:
    """Builds a hull of at most MOST_FACES faces from the outermost of the points [n, 3] m.

    Raises ValueError for points without volume.
    """
    part = convex(points)
    if len(part.planes) <= MOST_FACES:
        return part
    corners = part.vertices.astype(np.float64)
    chosen = {*corners.argmin(axis=0).tolist(), *corners.argmax(axis=0).tolist()}
    chosen |= {*np.einsum("ni,mi->mn", corners, _DIAGONALS).argmax(axis=1).tolist()}
    best = convex(corners[[*chosen]])
    while True:
        above = np.einsum("ni,fi->nf", corners, best.planes[:, :3]) - best.planes[:, 3]
        outside = above.max(axis=1)
        chosen.add(int(outside.argmax()))
        part = convex(corners[[*chosen]])
        if len(part.planes) > MOST_FACES:
            return best
        best = part


_DIAGONALS = np.array([*itertools.product((-1.0, 1.0), repeat=3)])


def moments(part: Part) -> Moments:
    """Integrates over a part."""
    corners = part.vertices.astype(np.float64)[part.triangles]  # [T, 3, 3]
    normals = np.cross(corners[:, 1], corners[:, 2])
    sixth = np.einsum("ti,ti->t", corners[:, 0], normals) / 6.0  # volumes of the tetrahedra
    total = corners.sum(axis=1)
    squares = np.einsum("tki,tkj->tij", corners, corners) + np.einsum("ti,tj->tij", total, total)
    second = np.einsum("t,tij->ij", sixth, squares) / 20.0
    return Moments(float(sixth.sum()), np.einsum("t,ti->i", sixth, total) / 4.0, second)


def joined(solids: Iterable[Moments]) -> Moments:
    """Sums integrals over solids that do not overlap."""
    volumes, firsts, seconds = zip(*solids, strict=True)
    return Moments(sum(volumes), np.sum(firsts, axis=0), np.sum(seconds, axis=0))


def inertia(solid: Moments) -> np.ndarray:
    """Computes the inertia [3, 3] m^5 of density 1 about the centre of mass, axes unchanged."""
    com = solid.first / solid.volume
    about = solid.second - solid.volume * np.outer(com, com)
    return np.trace(about) * np.eye(3) - about


def principal(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Computes principal moments [n, 3] of inertias [n, 3, 3] and their axes, right-handed columns.

    Cyclic Jacobi rotations, Golub and Van Loan, sec. 8.5.
    """
    left, axes = np.array(inertia, np.float64), np.tile(np.eye(3), (len(inertia), 1, 1))
    for i, j in 5 * ((0, 1), (0, 2), (1, 2)):
        twice, gap = 2.0 * left[:, i, j], left[:, j, j] - left[:, i, i]
        sign = np.where(gap < 0.0, -1.0, 1.0)
        length = np.abs(gap) + np.sqrt(gap**2 + twice**2)
        tangent = sign * twice / np.where(length > 0.0, length, 1.0)
        cosine = 1.0 / np.sqrt(1.0 + tangent**2)
        turn = np.tile(np.eye(3), (len(left), 1, 1))
        turn[:, i, i] = turn[:, j, j] = cosine
        turn[:, i, j], turn[:, j, i] = tangent * cosine, -tangent * cosine
        left = np.einsum("nki,nkl,nlj->nij", turn, left, turn)
        axes = np.einsum("nik,nkj->nij", axes, turn)
    return np.einsum("nii->ni", left), axes


def moved(part: Part, shift: np.ndarray) -> Part:
    """Shifts a part by `shift` [3] m."""
    normals, offsets = part.planes[:, :3], part.planes[:, 3]
    along = offsets + np.einsum("fi,i->f", normals, np.asarray(shift, np.float32))
    vertices = (part.vertices + shift).astype(np.float32)
    return Part(vertices, part.triangles, np.column_stack([normals, along]))
