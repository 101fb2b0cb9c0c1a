"""Libraries as files."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from csac_jax.objects import families, library, tables
from csac_jax.objects.library import LibraryError


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("library") / "lib"
    library.save(folder, families.draw(0, 14))
    return folder


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "copy"))


def test_a_library_comes_back(made: Path):
    """Claim: what is saved is what is loaded, to the bit but for inertias, which are text."""
    for one, two in zip(families.draw(0, 14), library.load(made).objects, strict=True):
        assert (one.name, one.family, one.volume) == (two.name, two.family, two.volume)
        np.testing.assert_allclose(one.inertia, two.inertia, rtol=1e-12)
        for mine, other in zip(one.parts, two.parts, strict=True):
            for name in ("vertices", "triangles", "planes"):
                np.testing.assert_array_equal(getattr(mine, name), getattr(other, name))


def test_the_same_shapes_are_the_same_files(made: Path, tmp_path: Path):
    """Claim: a library made again has the same bytes, so that digests can be compared."""
    library.save(tmp_path / "again", families.draw(0, 14))
    for name in (library.INDEX, library.ARRAYS):
        assert (tmp_path / "again" / name).read_bytes() == (made / name).read_bytes()


def test_nothing_is_overwritten(made: Path):
    """Claim: a folder that exists is left alone, and nothing lies beside it."""
    with pytest.raises(FileExistsError, match="give another name"):
        library.save(made, families.draw(1, 2))
    assert [path.name for path in made.parent.iterdir()] == [made.name]


def _edit(folder: Path, **changes: object) -> None:
    index = json.loads((folder / library.INDEX).read_text())
    index["objects"][0].update(changes.pop("first", {}))  # type: ignore[arg-type]
    arrays = (folder / library.ARRAYS).read_bytes()
    index["sha256"] = library._digest(changes.get("objects", index["objects"]), arrays)
    (folder / library.INDEX).write_text(json.dumps(index | changes))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "format 2 is unknown"),
        ({"sha256": "0"}, "the digest in objects.json"),
        ({"objects": []}, "1 to 4096 objects, not 0"),
        ({"objects": 3}, "damaged"),
        ({"first": {"parts": 10**9}}, "1 to 32 parts"),
        ({"first": {"parts": 1}}, "damaged"),
        ({"first": {"volume": 1e9}}, "volume"),
        ({"first": {"volume": float("inf")}}, "volume"),
        ({"first": {"inertia": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}}, "inertia"),
        ({"first": {"inertia": 1}}, "inertia"),
        ({"first": {"name": ""}}, "name"),
        ({"first": {"name": "bowl-0-1"}}, "two objects have one name"),
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
@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "gone", "folder"])
def test_a_damaged_file_is_named(copy: Path, name: str, damage: str):
    """Claim: a file that is cut off, changed, empty, missing or a folder is one line."""
    path = copy / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    whole = {"cut": content[:-20], "flipped": content, "empty": b""}
    path.unlink()
    if damage == "folder":
        path.mkdir()
    elif damage != "gone":
        path.write_bytes(whole[damage])
    with pytest.raises(LibraryError) as caught:
        library.load(copy)
    assert "\n" not in str(caught.value)


def test_a_missing_library_says_how_to_make_one(tmp_path: Path):
    """Claim: where there is none, the message has the command that makes one."""
    with pytest.raises(LibraryError, match="csac-jax objects make --out"):
        tables.find(str(tmp_path / "none"), "train")


def test_too_many_made_objects_are_refused():
    """Claim: made:SEED:COUNT has a bound, and no object of a split is an error in words."""
    with pytest.raises(LibraryError, match="1 to 4096"):
        tables.find("made:0:9999", "all")
    with pytest.raises(LibraryError, match="none of the 1 objects is of the split"):
        tables.find("made:0:1", "held_out")


def test_an_object_is_found_by_name(made: Path):
    """Claim: a name gives the object's number; an unknown one is named with some that there are."""
    known = library.load(made)
    assert known.objects[known.number("cup-0-2")].family == "cup"
    with pytest.raises(ValueError, match="no object 'cub' in the library; it has: bottle-0-0"):
        known.number("cub")


_TABLES = """
import hashlib
from csac_jax.objects import tables
content = hashlib.sha256()
for leaf in tables.from_library(tables.find("mixed:5:80", "all")):
    content.update(repr(leaf.tobytes() if hasattr(leaf, "tobytes") else leaf).encode())
print(content.hexdigest())
"""


def test_objects_are_the_same_by_all_kernels_of_blas():
    """Claim: all numbers of objects are the same, bit by bit, whatever the kernels of BLAS."""
    found = {
        kernel: subprocess.run(
            [sys.executable, "-c", _TABLES],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "OPENBLAS_CORETYPE": kernel},
        ).stdout
        for kernel in ("Prescott", "Haswell")
    }
    assert found["Prescott"] == found["Haswell"]
