"""A library of objects: a folder of two files.

LIB/objects.json  format, a digest of all that follows, and of each object what `Object` says
LIB/parts.npz     corners, triangles and half-spaces of all convex parts, one after the other
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
from csac_jax.objects import body, solid
from csac_jax.objects.body import DENSITY, Object
from csac_jax.objects.solid import Part

Split = Literal["train", "held_out", "all"]
FORMAT = 1
INDEX, ARRAYS = "objects.json", "parts.npz"
MOST_OBJECTS = 4096
_MOST_BYTES = 2**28  # of a file
_DTYPES = {"vertices": np.float32, "triangles": np.int32, "planes": np.float32, "counts": np.int32}


class LibraryError(FailedError):
    """A library that is missing, damaged or of another format; the message has the remedy."""


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
            "density": each.density,
            "mass": each.density * each.volume,
            "inertia": (each.density * each.inertia).tolist(),
            "parts": len(each.parts),
            "held_out": each.held_out,
        }
        for each in objects
    ]
    content = {"format": FORMAT, "sha256": _digest(entries, arrays), "objects": entries}
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
    if not 1 <= count <= min(body.MOST_PARTS, len(parts)):
        raise ValueError(f"1 to {body.MOST_PARTS} parts an object, not {count}")
    own = tuple(parts.pop() for _ in range(count))
    density = float(entry.get("density", DENSITY))  # the first libraries had no other
    inertia = np.array(entry["inertia"], np.float64) / density
    texts: dict[str, Any] = {
        name: str(entry[name]) for name in ("name", "family", "source", "source_sha256")
    }
    volume, scale = float(entry["volume"]), float(entry["scale"])
    numbers: dict[str, Any] = {"volume": volume, "scale": scale, "density": density}
    found = Object(parts=own, inertia=inertia, **numbers, **texts)
    if fault := body.faults(found):
        raise ValueError(f"object '{found.name[:60]}' {fault}")
    return found
