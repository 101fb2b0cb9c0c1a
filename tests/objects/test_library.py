"""Libraries as files."""

import io
import json
import os
import shutil
import subprocess
import sys
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from csac_jax.objects import library, shapes, tables
from csac_jax.objects.library import LibraryError


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("library") / "lib"
    library.save(folder, shapes.draw(0, 14))
    return folder


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "copy"))


def test_a_library_comes_back(made: Path, tmp_path: Path):
    """Claim: what is saved is what is loaded, to the bit but for inertias, which are text. Made
    again, a library has the same bytes. A name gives the object's number."""
    loaded = library.load(made)
    for one, two in zip(shapes.draw(0, 14), loaded.objects, strict=True):
        assert (one.name, one.family, one.volume) == (two.name, two.family, two.volume)
        np.testing.assert_allclose(one.inertia, two.inertia, rtol=1e-12)
        for mine, other in zip(one.parts, two.parts, strict=True):
            for name in ("vertices", "triangles", "planes"):
                np.testing.assert_array_equal(getattr(mine, name), getattr(other, name))
    library.save(tmp_path / "again", shapes.draw(0, 14))
    for name in (library.INDEX, library.ARRAYS):
        assert (tmp_path / "again" / name).read_bytes() == (made / name).read_bytes()
    assert loaded.objects[loaded.number("cup-0-2")].family == "cup"
    with pytest.raises(ValueError, match="no object 'cub' in the library; it has: bottle-0-0"):
        loaded.number("cub")


def test_nothing_is_overwritten(made: Path):
    """Claim: a folder that exists is left alone, and no draft stays in its parent."""
    with pytest.raises(FileExistsError, match="give another name"):
        library.save(made, shapes.draw(1, 2))
    assert [path.name for path in made.parent.iterdir()] == [made.name]


def _edit(folder: Path, **changes: object) -> None:
    """Changes an index and its digest."""
    index = json.loads((folder / library.INDEX).read_text())
    arrays = (folder / library.ARRAYS).read_bytes()
    index["sha256"] = library._digest(changes.get("objects", index["objects"]), arrays)
    (folder / library.INDEX).write_text(json.dumps(index | changes))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "format 2 is unknown"),
        ({"sha256": "0"}, "the digest in objects.json"),
        ({"objects": 3}, "damaged"),
        ({"objects": [{}]}, "damaged library: 'name'"),
    ],
)
def test_a_damaged_index_is_named(copy: Path, change: dict, message: str):
    """Claim: an index that does not fit is one line with the folder and what is wrong."""
    _edit(copy, **change)
    with pytest.raises(LibraryError, match=message) as caught:
        library.load(copy)
    assert str(caught.value).startswith(str(copy))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [library.INDEX, library.ARRAYS])
@pytest.mark.parametrize("damage", ["cut", "flipped", "gone", "folder"])
def test_a_damaged_file_is_named(copy: Path, name: str, damage: str):
    """Claim: a file that is cut off, changed, missing or a folder is one line."""
    path = copy / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.unlink()
    if damage == "folder":
        path.mkdir()
    elif damage != "gone":
        path.write_bytes(content[:-20] if damage == "cut" else content)
    with pytest.raises(LibraryError) as caught:
        library.load(copy)
    assert "\n" not in str(caught.value)


def _header(shape: int) -> bytes:
    np.lib.format.write_array_header_1_0(
        header := io.BytesIO(), {"descr": "|u1", "fortran_order": False, "shape": (shape,)}
    )
    return header.getvalue()


@pytest.mark.parametrize(
    ("content", "compression", "message"),
    [
        (lambda: _header(2**36) + bytes(9), zipfile.ZIP_STORED, "not as large as its header"),
        (lambda: _header(2**24) + bytes(2**24), zipfile.ZIP_DEFLATED, "compressed or overlap"),
    ],
)
def test_arrays_that_unpack_to_more_are_refused(
    copy: Path, content: Callable[[], bytes], compression: int, message: str
):
    """Claim: an array that claims more than its file holds, or that is compressed, is refused
    before memory is taken for it, whatever the digest says."""
    with zipfile.ZipFile(copy / library.ARRAYS, "w", compression) as archive:
        archive.writestr("vertices.npy", content())
    _edit(copy)
    tracemalloc.start()
    with pytest.raises(LibraryError, match=message):
        library.load(copy)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**22


@pytest.mark.parametrize(
    ("source", "split", "message"),
    [
        ("none", "train", "csac-jax objects make --out"),
        ("procedural:0:9999", "all", "1 to 4096"),
        ("procedural:0:1", "held_out", "none of the 1 objects is of the split"),
    ],
)
def test_a_library_that_is_not_there_is_an_error(source: str, split: library.Split, message: str):
    """Claim: a missing folder, too many objects and an empty split are one line with a remedy."""
    with pytest.raises(LibraryError, match=message):
        tables.find(source, split)


_TABLES = """
import hashlib
from csac_jax.objects import tables
content = hashlib.sha256()
for leaf in tables.from_library(tables.find("procedural+assemblies:5:80", "all")):
    content.update(repr(leaf.tobytes() if hasattr(leaf, "tobytes") else leaf).encode())
print(content.hexdigest())
"""


def test_objects_are_the_same_by_all_kernels_of_blas():
    """Claim: all numbers of objects are the same, bit by bit, whatever the kernels of BLAS."""
    run = [sys.executable, "-c", _TABLES]
    digests = {
        subprocess.check_output(run, env={**os.environ, "OPENBLAS_CORETYPE": kernel})
        for kernel in ("Prescott", "Haswell")
    }
    assert len(digests) == 1
