"""The objects of a library as one array per field, for compiled programs."""

import functools
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from csac_jax.objects import library, shapes, solid
from csac_jax.objects.body import DENSITY, Object
from csac_jax.objects.library import Library, LibraryError, Split

CHUNK = 6  # faces, as many as a box has
NO_FACE = 1e3  # m, offset of a padding face: every point lies inside it
PROCEDURAL = re.compile(
    r"(procedural(\+assemblies)?|made|mixed):\d{1,9}:\d{1,4}"
)  # or a former name


class Tables(NamedTuple):
    """Fields in object frames. O objects, P most parts of an object, C most chunks of an object.

    A chunk is CHUNK faces of one part, the last one padded: a table of parts by faces would be
    mostly empty.
    """

    normal: np.ndarray  # [O, C, CHUNK, 3] float32 outward unit normals, 0 for padding
    offset: np.ndarray  # [O, C, CHUNK] float32 m, NO_FACE for padding
    first: np.ndarray  # [O, C] bool, the chunk begins a part, or is padding
    part: np.ndarray  # [O, C] int32, the part it belongs to; P for padding
    present: np.ndarray  # [O, P] bool, the object has this part
    middle: np.ndarray  # [O, P, 3] float32 m, middle of the part's bounding box
    centre: np.ndarray  # [O, 3] float32 m, middle of the bounding box
    half: np.ndarray  # [O, 3] float32 m, half of the bounding box
    volume: np.ndarray  # [O] m^3
    heaviness: np.ndarray  # [O] density relative to `body.DENSITY`
    moments: np.ndarray  # [O, 3] m^5, principal moments of inertia of density 1
    axes: np.ndarray  # [O, 4] unit quaternions (w, x, y, z), principal axes to object
    radius: float  # m, largest distance of a corner from its object's `centre`


def find(source: str, split: Split) -> Library:
    """Finds the objects of a split, of the library in the folder `source` or of our own shapes:
    `procedural:SEED:COUNT`, `procedural+assemblies:SEED:COUNT`. Raises LibraryError.
    """
    procedural = PROCEDURAL.fullmatch(source) is not None
    return _select(_draw(source) if procedural else library.load(Path(source)), split)


@functools.lru_cache(maxsize=8)
def _draw(source: str) -> Library:
    _, seed, count = source.split(":")
    if not 1 <= int(count) <= library.MOST_OBJECTS:
        raise LibraryError(f"{source}: 1 to {library.MOST_OBJECTS} objects can be made")
    draw = shapes.draw_mixed if "+" in source or "mixed" in source else shapes.draw
    return library.from_objects(draw(int(seed), int(count)))


_select = functools.lru_cache(maxsize=16)(library.select)


@functools.lru_cache(maxsize=16)
def from_library(source: Library) -> Tables:
    """Builds the tables of a library."""
    objects = source.objects
    parts = max(len(member.parts) for member in objects)
    middle = np.zeros((len(objects), parts, 3), np.float32)
    present = np.zeros((len(objects), parts), bool)
    for number, member in enumerate(objects):
        present[number, : len(member.parts)] = True
        corners = [part.vertices for part in member.parts]
        middle[number, : len(corners)] = [0.5 * (c.min(axis=0) + c.max(axis=0)) for c in corners]
    rows = [_chunks(member) for member in objects]
    chunks = max(map(len, rows))
    planes = np.full((len(objects), chunks, CHUNK, 4), _NO_PLANE, np.float32)
    first, part = np.ones(planes.shape[:2], bool), np.full(planes.shape[:2], parts, np.int32)
    for number, row in enumerate(rows):
        owners, planes[number, : len(row)] = zip(*row, strict=True)
        part[number, : len(row)], first[number, 1 : len(row)] = owners, np.diff(owners) > 0
    bounds = np.stack([member.bounds for member in objects]).astype(np.float32)
    moments, axes = solid.principal(np.stack([member.inertia for member in objects]))
    return Tables(
        normal=planes[..., :3],
        offset=planes[..., 3],
        first=first,
        part=part,
        present=present,
        middle=middle,
        centre=bounds.mean(axis=1),
        half=0.5 * np.ptp(bounds, axis=1),
        volume=np.array([member.volume for member in objects]),
        heaviness=np.array([member.density / DENSITY for member in objects]),
        moments=moments,
        axes=Rotation.from_matrix(axes).as_quat(scalar_first=True),
        radius=max(map(_radius, objects)),
    )


_NO_PLANE = np.array([0.0, 0.0, 0.0, NO_FACE], np.float32)


def _chunks(member: Object) -> list[tuple[int, np.ndarray]]:
    chunks = []  # and the number of the part that each belongs to
    for number, part in enumerate(member.parts):
        missing = -len(part.planes) % CHUNK
        full = np.concatenate([part.planes, np.tile(_NO_PLANE, (missing, 1))])
        chunks += [(number, chunk) for chunk in full.reshape(-1, CHUNK, 4)]
    return chunks


def _radius(member: Object) -> float:
    points = np.concatenate([part.vertices for part in member.parts])
    return float(np.linalg.norm(points - member.bounds.mean(axis=0), axis=1).max())
