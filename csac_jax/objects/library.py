"""A library of objects: a folder of two files.

LIB/objects.json  format, a digest of all that follows, and of each object what `Object` says
LIB/parts.npz     corners, triangles and half-spaces of all convex parts, one after the other

An object's frame has the axes of its file and its origin at the centre of mass.
"""

import dataclasses
import hashlib
import io
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from csac_jax.errors import FailedError
from csac_jax.objects import solid
from csac_jax.objects.solid import Part

Split = Literal["train", "held_out", "all"]
FORMAT = 1
INDEX, ARRAYS = "objects.json", "parts.npz"
HELD_OUT = 0.2  # share of the names
MOST_OBJECTS, MOST_PARTS = 4096, 32
LARGEST = 0.4  # m, of a side: more than fits on the table
DENSITY = 600.0  # kg/m^3, of stored masses; scenes draw their own
_MOST_BYTES = 2**28  # of a file
_DTYPES = {"vertices": np.float32, "triangles": np.int32, "planes": np.float32, "counts": np.int32}


class LibraryError(FailedError):
    """A library that is missing, damaged or of another format; the message has the remedy."""


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

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner of the bounding box [2, 3] m."""
        points = np.concatenate([part.vertices for part in self.parts])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    @property
    def narrowest(self) -> float:
        """Least width, m, between two parallel planes, one of them along a face of the hull."""
        return solid.narrowest(self.parts)

    @property
    def held_out(self) -> bool:
        """Kept for evaluation: decided by the digest of the family, or of the object's name or
        file, never by hand."""
        return any(_drawn(name) for name in (self.source_sha256 or self.name, self.family) if name)


def _drawn(name: str) -> bool:
    number = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    return number < HELD_OUT * 2**64


def renamed(one: Object, name: str) -> Object:
    """The object under another name."""
    return dataclasses.replace(one, name=name)


def make(name: str, parts: Sequence[Part], **more: Any) -> Object:
    """The object of convex parts that do not overlap, shifted such that its centre of mass is the
    origin."""
    whole = solid.joined(map(solid.moments, parts))
    return centred(name, parts, whole, **more)


def centred(name: str, parts: Sequence[Part], whole: solid.Moments, **more: Any) -> Object:
    """The object of these parts whose integrals are `whole`."""
    com = whole.first / whole.volume
    shifted = [solid.moved(part, -com) for part in parts]
    shifted.sort(key=lambda part: -np.linalg.norm(np.ptp(part.vertices, axis=0)))
    return Object(name, tuple(shifted), whole.volume, solid.inertia(whole), **more)


@dataclasses.dataclass(frozen=True, eq=False)
class Library:
    """Objects by number."""

    objects: tuple[Object, ...]
    sha256: str  # of the index and of the split, which pools of settled scenes depend on

    def number(self, name: str) -> int:
        """The number of an object. Raises ValueError with some names if there is none."""
        names = [each.name for each in self.objects]
        if name not in names:
            some = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
            raise ValueError(f"no object '{name}' in the library; it has: {some}")
        return names.index(name)


def of(objects: Sequence[Object]) -> Library:
    """The library of these objects, in no file."""
    names = " ".join(each.name for each in objects)
    return Library(tuple(objects), hashlib.sha256(names.encode() + _packed(objects)).hexdigest())


def chosen(library: Library, split: Split) -> Library:
    """The objects of a split. Raises LibraryError where there are none."""
    if split == "all":
        return library
    kept = tuple(each for each in library.objects if each.held_out == (split == "held_out"))
    if not kept:
        raise LibraryError(
            f"none of the {len(library.objects)} objects is of the split {split}; "
            "make a larger library, or take the split all"
        )
    digest = hashlib.sha256(f"{split} {library.sha256}".encode()).hexdigest()
    return Library(kept, digest)


def save(folder: Path, objects: Sequence[Object]) -> Library:
    """Writes a library such that it appears all at once.

    Raises FileExistsError where there is a file or folder of that name, OSError.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists; give another name")
    arrays = _packed(objects)
    index = _index(objects, arrays)
    folder.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        for name, content in ((ARRAYS, arrays), (INDEX, index)):
            with (draft / name).open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        draft.chmod(0o755)
        draft.rename(folder)
    except OSError:
        shutil.rmtree(draft, ignore_errors=True)
        raise
    return Library(tuple(objects), hashlib.sha256(index).hexdigest())


def _packed(objects: Iterable[Object]) -> bytes:
    """The array file: `counts` has the corners, triangles and planes of each part."""
    parts = [part for each in objects for part in each.parts]
    fields = ("vertices", "triangles", "planes")
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in fields
    }
    counts = [[len(getattr(part, name)) for name in fields] for part in parts]
    file = io.BytesIO()
    np.savez(file, **arrays, counts=np.array(counts, np.int32))
    return file.getvalue()


def _digest(entries: Any, arrays: bytes) -> str:
    """Of all that a library holds."""
    return hashlib.sha256(json.dumps(entries).encode() + arrays).hexdigest()


def _index(objects: Iterable[Object], arrays: bytes) -> bytes:
    entries = [
        {
            "name": each.name,
            "family": each.family,
            "source": each.source,
            "source_sha256": each.source_sha256,
            "scale": each.scale,
            "size": np.ptp(each.bounds, axis=0).tolist(),
            "volume": each.volume,
            "mass": DENSITY * each.volume,
            "inertia": (DENSITY * each.inertia).tolist(),
            "parts": len(each.parts),
            "held_out": each.held_out,
        }
        for each in objects
    ]
    content = {
        "format": FORMAT,
        "density": DENSITY,
        "sha256": _digest(entries, arrays),
        "objects": entries,
    }
    return (json.dumps(content, indent=1) + "\n").encode()


_LOADED: dict[tuple[str, str], Library] = {}  # by folder and digest of its index


def load(folder: Path) -> Library:
    """The library in a folder. Raises LibraryError, one line with the remedy."""
    try:
        index = _bytes(folder / INDEX)
        key = (str(folder.resolve()), hashlib.sha256(index).hexdigest())
        if key not in _LOADED:
            _LOADED[key] = Library(tuple(_read(folder, index)), key[1])
        return _LOADED[key]
    except OSError as error:
        missing = f"{folder}: no library of objects there ({error.strerror})"
        raise LibraryError(f"{missing}; csac-jax objects make --out {folder} makes one") from None
    except (
        ArithmeticError,
        ValueError,
        LookupError,
        TypeError,
        zipfile.BadZipFile,
        RecursionError,
    ) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise LibraryError(
            f"{folder}: damaged library of objects: {reason}; make it again"
        ) from None


def _bytes(path: Path) -> bytes:
    if not path.is_file() or path.stat().st_size > _MOST_BYTES:
        path.stat()  # raises for one that is missing
        raise ValueError(f"{path.name} is no file, or larger than {_MOST_BYTES >> 20} MiB")
    return path.read_bytes()


def _read(folder: Path, index: bytes) -> list[Object]:
    content = json.loads(index)
    if content["format"] != FORMAT:
        raise ValueError(
            f"format {str(content['format'])[:20]} is unknown, this version reads {FORMAT}"
        )
    packed = _bytes(folder / ARRAYS)
    entries = content["objects"]
    if _digest(entries, packed) != content["sha256"]:
        raise ValueError(f"the digest in {INDEX} is another than that of the files")
    if not 1 <= len(entries) <= MOST_OBJECTS:
        raise ValueError(f"1 to {MOST_OBJECTS} objects, not {len(entries)}")
    parts = _parts(packed)
    found = [_object(entry, parts) for entry in entries]
    if parts:
        raise ValueError("parts are left over")
    if len({each.name for each in found}) < len(found):
        raise ValueError("two objects have one name")
    return found


def _parts(packed: bytes) -> list[Part]:
    """All parts of an array file, the last one first."""
    with np.load(io.BytesIO(packed), allow_pickle=False) as file:
        arrays = {name: file[name] for name in _DTYPES}
    for name, dtype in _DTYPES.items():
        width = 4 if name == "planes" else 3
        if arrays[name].dtype != dtype or arrays[name].ndim != 2 or arrays[name].shape[1] != width:
            raise ValueError(f"{name} is no array of {np.dtype(dtype)} [..., {width}]")
    counts = arrays.pop("counts")
    if (counts < 4).any() or (counts[:, 2] > solid.MOST_FACES).any():
        raise ValueError(f"a part has less than 4 corners or more than {solid.MOST_FACES} faces")
    rows = []
    for column, (name, array) in enumerate(arrays.items()):
        ends = np.cumsum(counts[:, column].astype(np.int64))
        if len(array) != ends[-1] or not np.isfinite(array).all():
            raise ValueError(f"{name} does not fit the counts, or is not finite")
        rows.append(np.split(array, ends[:-1]))
    parts = [Part(*arrays) for arrays in zip(*rows, strict=True)]
    if any(
        (part.triangles < 0).any() or part.triangles.max() >= len(part.vertices) for part in parts
    ):
        raise ValueError("triangles name corners that there are not")
    return parts[::-1]


def _object(entry: dict[str, Any], parts: list[Part]) -> Object:
    """The object of an entry; takes its parts off the end."""
    count = int(entry["parts"])
    if not 1 <= count <= min(MOST_PARTS, len(parts)):
        raise ValueError(f"1 to {MOST_PARTS} parts an object, not {count}")
    own = tuple(parts.pop() for _ in range(count))
    inertia = np.array(entry["inertia"], np.float64) / DENSITY
    texts: dict[str, Any] = {
        name: str(entry[name]) for name in ("name", "family", "source", "source_sha256")
    }
    volume, scale = float(entry["volume"]), float(entry["scale"])
    found = Object(parts=own, volume=volume, inertia=inertia, scale=scale, **texts)
    if fault := faults(found):
        raise ValueError(f"object '{found.name[:60]}' {fault}")
    return found


def faults(one: Object) -> str | None:
    """What keeps an object from being simulated; None if nothing does."""
    if not (one.name.isprintable() and 1 <= len(one.name) <= 100):
        return "has no name of 1 to 100 printable characters"
    size = np.ptp(one.bounds, axis=0)
    if not (size.min() >= 1e-3 and size.max() <= LARGEST):
        sides = f"{1e3 * size.min():.3g} to {1e3 * size.max():.3g}"
        return f"has sides of {sides} mm, not 1 to {1e3 * LARGEST:g}"
    if (
        len(one.parts) > MOST_PARTS
        or max(len(part.planes) for part in one.parts) > solid.MOST_FACES
    ):
        return f"has more than {MOST_PARTS} parts, or a part of more than {solid.MOST_FACES} faces"
    if not (0.0 < one.volume <= 1.01 * np.prod(size)):
        return "has a volume that is not positive, or larger than its bounding box"
    if one.inertia.shape != (3, 3) or not np.isfinite(one.inertia).all():
        return "has no inertia of 3 x 3 numbers"
    low, middle, high = np.linalg.eigvalsh(one.inertia)
    if not (low > 0.0 and low + middle >= 0.999 * high):
        return "has an inertia that no body can have"
    return None
