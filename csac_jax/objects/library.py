"""A library of objects: a folder of two files.

LIB/objects.json  format, a digest of all that follows, and the fields of each `Object`
LIB/parts.npz     corners, triangles and half-spaces of all convex parts, one after the other
"""

import dataclasses
import hashlib
import io
import json
import os
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np

from csac_jax import reading
from csac_jax.errors import FailedError
from csac_jax.objects.body import DENSITY, Object
from csac_jax.objects.solid import Part

Split = Literal["train", "held_out", "all"]
FORMAT = 1
INDEX, ARRAYS = "objects.json", "parts.npz"
MOST_OBJECTS = 4096
_MOST_BYTES = {INDEX: 2**24, ARRAYS: 2**28}  # of a file
_FIELDS = ("vertices", "triangles", "planes")  # of a part


class LibraryError(FailedError):
    """A library that is missing, damaged or of another format; the message has the remedy."""


@dataclasses.dataclass(frozen=True, eq=False)
class Library:
    """Objects by number."""

    objects: tuple[Object, ...]
    sha256: str  # of the index and of the split, which pools of settled scenes depend on

    def number(self, name: str) -> int:
        """Returns the number of an object. Raises ValueError with some names if unknown."""
        names = [member.name for member in self.objects]
        if name not in names:
            some = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
            raise ValueError(f"no object '{name}' in the library; it has: {some}")
        return names.index(name)


def from_objects(objects: Sequence[Object]) -> Library:
    """Builds a library of objects without a file."""
    names = " ".join(member.name for member in objects)
    return Library(tuple(objects), hashlib.sha256(names.encode() + _pack(objects)).hexdigest())


def select(library: Library, split: Split) -> Library:
    """Selects the objects of a split. Raises LibraryError where there are none."""
    if split == "all":
        return library
    held_out = split == "held_out"
    members = tuple(member for member in library.objects if member.held_out == held_out)
    if not members:
        none = f"none of the {len(library.objects)} objects is of the split {split}"
        raise LibraryError(f"{none}; make a larger library, or take the split all")
    return Library(members, hashlib.sha256(f"{split} {library.sha256}".encode()).hexdigest())


def save(folder: Path, objects: Sequence[Object]) -> Library:
    """Writes a library; its folder appears at once, complete. Raises OSError."""
    if folder.exists():
        raise FileExistsError(f"{folder} exists; give another name")
    arrays, entries = _pack(objects), [_entry(member) for member in objects]
    fields = {"format": FORMAT, "sha256": _digest(entries, arrays), "objects": entries}
    index = (json.dumps(fields, indent=1) + "\n").encode()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as parent:
        draft = Path(parent) / folder.name
        draft.mkdir()
        for name, content in ((ARRAYS, arrays), (INDEX, index)):
            with (draft / name).open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        draft.rename(folder)
    return Library(tuple(objects), hashlib.sha256(index).hexdigest())


def _pack(objects: Iterable[Object]) -> bytes:
    parts = [part for member in objects for part in member.parts]
    rows = [[getattr(part, name) for name in _FIELDS] for part in parts]
    arrays: Any = dict(zip(_FIELDS, map(np.concatenate, zip(*rows, strict=True)), strict=True))
    file = io.BytesIO()
    np.savez(file, **arrays, counts=np.array([[*map(len, row)] for row in rows], np.int32))
    return file.getvalue()


_TEXTS, _SIZES = ("name", "family", "source", "source_sha256"), ("scale", "volume", "density")


def _digest(entries: Any, arrays: bytes) -> str:
    return hashlib.sha256(json.dumps(entries).encode() + arrays).hexdigest()


def _entry(member: Object) -> dict[str, Any]:
    return {name: getattr(member, name) for name in (*_TEXTS, "scale")} | {
        "size": np.ptp(member.bounds, axis=0).tolist(),
        "volume": member.volume,
        "density": member.density,
        "mass": member.density * member.volume,
        "inertia": (member.density * member.inertia).tolist(),
        "parts": len(member.parts),
        "held_out": member.held_out,
    }


_DAMAGE = (ArithmeticError, ValueError, LookupError, TypeError, RecursionError, BadZipFile)
_LOADED: dict[tuple[str, str], Library] = {}  # by folder and digest of its index


def load(folder: Path) -> Library:
    """Loads the library in a folder. Raises LibraryError, one line with the remedy."""
    try:
        index = reading.read_bytes(folder / INDEX, _MOST_BYTES[INDEX])
        key = (os.path.realpath(folder), hashlib.sha256(index).hexdigest())
        if key not in _LOADED:
            _LOADED[key] = Library(tuple(_read(folder, index)), key[1])
        return _LOADED[key]
    except OSError as error:
        missing = f"{folder}: no library of objects there ({error.strerror})"
        raise LibraryError(f"{missing}; csac-jax objects make --out {folder} makes one") from None
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise LibraryError(f"{folder}: damaged library: {reason}; make it again") from None


def _read(folder: Path, index: bytes) -> list[Object]:
    """Reads objects. Their digest is that of `save`, which needs no other check."""
    content = json.loads(index)
    if content["format"] != FORMAT:
        raise ValueError(f"format {content['format']} is unknown, this version reads {FORMAT}")
    packed = reading.read_bytes(folder / ARRAYS, _MOST_BYTES[ARRAYS])
    entries = content["objects"]
    if _digest(entries, packed) != content["sha256"]:
        raise ValueError(f"the digest in {INDEX} is not that of the files")
    parts = _parts(packed)
    return [_object(entry, parts) for entry in entries]


def _parts(packed: bytes) -> list[Part]:
    """Reads all parts of an array file, in reverse order."""
    stored = reading.read_arrays(packed)
    *arrays, counts = (stored[name] for name in (*_FIELDS, "counts"))
    ends = np.cumsum(counts, axis=0)[:-1].T
    rows = map(np.split, arrays, ends)
    return [Part(*fields) for fields in zip(*rows, strict=True)][::-1]


def _object(entry: dict[str, Any], parts: list[Part]) -> Object:
    """Builds the object of an entry; its parts are taken off the end of `parts`."""
    entry = {"density": DENSITY} | entry  # the first libraries had no other
    values: dict[str, Any] = {name: entry[name] for name in (*_TEXTS, *_SIZES)}
    inertia = np.array(entry["inertia"], np.float64) / values["density"]
    own = tuple(parts.pop() for _ in range(entry["parts"]))
    return Object(parts=own, inertia=inertia, **values)
