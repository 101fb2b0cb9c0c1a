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
_MADE = re.compile(r"(made|mixed):(\d{1,9}):(\d{1,4})")


class Tables(NamedTuple):
    """O objects, P most parts of an object, C most chunks of an object. Object frames.

    A chunk is CHUNK faces of one part; the last chunk of a part is padded. Parts have few faces or
    many: a table of parts by faces would be mostly empty.
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
    """Finds the objects of a split: of the library in the folder `source`, or of our own shapes.

    Those are `procedural:SEED:COUNT`, or `procedural+assemblies:SEED:COUNT` with assemblies.
    Raises LibraryError.
    """
    made = _MADE.fullmatch(source)
    return _select(_draw(*made.groups()) if made else library.load(Path(source)), split)


@functools.lru_cache(maxsize=8)
def _draw(kind: str, seed: str, count: str) -> Library:
    if not 1 <= int(count) <= library.MOST_OBJECTS:
        most = library.MOST_OBJECTS
        raise LibraryError(f"{kind}:{seed}:{count}: 1 to {most} objects can be made")
    draw = shapes.draw if kind == "made" else shapes.draw_mixed
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
        middle[number, : len(member.parts)] = [_middle(part.vertices) for part in member.parts]
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
    """Splits an object's faces into chunks, each with the number of its part."""
    chunks = []
    for number, part in enumerate(member.parts):
        missing = -len(part.planes) % CHUNK
        full = np.concatenate([part.planes, np.tile(_NO_PLANE, (missing, 1))])
        chunks += [(number, chunk) for chunk in full.reshape(-1, CHUNK, 4)]
    return chunks


def _middle(points: np.ndarray) -> np.ndarray:
    return 0.5 * (points.min(axis=0) + points.max(axis=0))


def _radius(member: Object) -> float:
    points = np.concatenate([part.vertices for part in member.parts])
    return float(np.linalg.norm(points - member.bounds.mean(axis=0), axis=1).max())
