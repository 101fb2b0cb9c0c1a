"""The objects of a library as arrays of one shape each, for compiled programs."""

import functools
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from csac_jax.objects import families, library, solid
from csac_jax.objects.body import DENSITY, Object
from csac_jax.objects.library import Library, LibraryError, Split

CHUNK = 6  # faces, as many as a box has
NO_FACE = 1e3  # m, offset of a face that is not there: every point lies inside it
_MADE = re.compile(r"(made|mixed):(\d{1,9}):(\d{1,4})")


class Tables(NamedTuple):
    """O objects, P parts of the one with most, C chunks of the one with most. Object frames.

    A chunk is CHUNK faces of one part, the last one of a part filled up: parts have few faces or
    many, so that a table of all parts by the most faces would be mostly empty.
    """

    normal: np.ndarray  # [O, C, CHUNK, 3] float32 outward unit normals, 0 where there is no face
    offset: np.ndarray  # [O, C, CHUNK] float32 m, NO_FACE where there is none
    first: np.ndarray  # [O, C] bool, the chunk begins a part, or there is no such chunk
    part: np.ndarray  # [O, C] int32, whose faces they are; P where there is no such chunk
    present: np.ndarray  # [O, P] bool, there is such a part
    middle: np.ndarray  # [O, P, 3] float32 m, middle of the part's bounding box
    centre: np.ndarray  # [O, 3] float32 m, middle of the bounding box
    half: np.ndarray  # [O, 3] float32 m, half of the bounding box
    volume: np.ndarray  # [O] m^3
    heaviness: np.ndarray  # [O] density relative to that of objects of which nothing is said
    moments: np.ndarray  # [O, 3] m^5, principal moments of inertia of density 1
    axes: np.ndarray  # [O, 4] unit quaternions (w, x, y, z), principal axes to object
    radius: float  # m, largest distance of a corner from its object's `centre`


def find(source: str, split: Split) -> Library:
    """The objects of a split of the library in the folder `source`, or of our own shapes:
    `made:SEED:COUNT`, or `mixed:SEED:COUNT` with assemblies among them. Raises LibraryError."""
    if made := _MADE.fullmatch(source):
        kind, seed, count = made.groups()
        return _chosen(_made(kind, int(seed), int(count)), split)
    return _chosen(library.load(Path(source)), split)


@functools.lru_cache(maxsize=8)
def _made(kind: str, seed: int, count: int) -> Library:
    if not 1 <= count <= library.MOST_OBJECTS:
        most = library.MOST_OBJECTS
        raise LibraryError(f"{kind}:{seed}:{count}: 1 to {most} objects can be made")
    return library.of(DRAWS[kind](seed, count))


DRAWS = {"made": families.draw, "mixed": families.draw_mixed}


_chosen = functools.lru_cache(maxsize=16)(library.chosen)


@functools.lru_cache(maxsize=16)
def of(source: Library) -> Tables:
    """The tables of a library."""
    objects = source.objects
    parts = max(len(one.parts) for one in objects)
    middle, present = (
        np.zeros((len(objects), parts, 3), np.float32),
        np.zeros((len(objects), parts), bool),
    )
    for number, one in enumerate(objects):
        present[number, : len(one.parts)] = True
        middle[number, : len(one.parts)] = [_middle(part.vertices) for part in one.parts]
    rows = [_chunks(one) for one in objects]
    chunks = max(map(len, rows))
    planes = np.full((len(objects), chunks, CHUNK, 4), _NO_PLANE, np.float32)
    first, part = np.ones(planes.shape[:2], bool), np.full(planes.shape[:2], parts, np.int32)
    for number, row in enumerate(rows):
        of, planes[number, : len(row)] = zip(*row, strict=True)
        part[number, : len(row)], first[number, 1 : len(row)] = of, np.diff(of) > 0
    bounds = np.stack([one.bounds for one in objects]).astype(np.float32)
    moments, axes = solid.principal(np.stack([one.inertia for one in objects]))
    return Tables(
        normal=planes[..., :3],
        offset=planes[..., 3],
        first=first,
        part=part,
        present=present,
        middle=middle,
        centre=bounds.mean(axis=1),
        half=0.5 * np.ptp(bounds, axis=1),
        volume=np.array([one.volume for one in objects]),
        heaviness=np.array([one.density / DENSITY for one in objects]),
        moments=moments,
        axes=Rotation.from_matrix(axes).as_quat(scalar_first=True),
        radius=max(map(_radius, objects)),
    )


_NO_PLANE = np.array([0.0, 0.0, 0.0, NO_FACE], np.float32)


def _chunks(one: Object) -> list[tuple[int, np.ndarray]]:
    """The chunks of an object, each with the number of its part."""
    found = []
    for number, part in enumerate(one.parts):
        missing = -len(part.planes) % CHUNK
        full = np.concatenate([part.planes, np.tile(_NO_PLANE, (missing, 1))])
        found += [(number, chunk) for chunk in full.reshape(-1, CHUNK, 4)]
    return found


def _middle(points: np.ndarray) -> np.ndarray:
    return 0.5 * (points.min(axis=0) + points.max(axis=0))


def _radius(one: Object) -> float:
    points = np.concatenate([part.vertices for part in one.parts])
    return float(np.linalg.norm(points - one.bounds.mean(axis=0), axis=1).max())
