"""Mesh files into objects: what is read, mended, refused and said."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from csac_jax import cli
from csac_jax.objects import conversion, importing, library, solid
from csac_jax.objects.conversion import ImportSettings

pytest.importorskip("coacd")


def _file(folder: Path, mesh: trimesh.Trimesh, name: str = "mesh.stl") -> Path:
    mesh.export(folder / name)
    return folder / name


def _box(sides: tuple[float, float, float] = (0.03, 0.04, 0.05)) -> trimesh.Trimesh:
    return trimesh.creation.box(sides)


@pytest.mark.parametrize("kind", ["obj", "stl", "ply", "glb"])
def test_every_format_gives_the_same_box(tmp_path: Path, kind: str):
    """Claim: a box of any format is one part with the closed form of volume and inertia."""
    one, share = conversion.convert(
        _file(tmp_path, _box(), f"mesh.{kind}"), "box", ImportSettings()
    )
    assert len(one.parts) == 1
    assert len(one.parts[0].planes) == 6
    assert share == pytest.approx(1.0, rel=1e-3)
    assert one.volume == pytest.approx(6e-5, rel=1e-4)
    squares = np.array([16 + 25, 9 + 25, 9 + 16]) * 1e-4 / 12
    np.testing.assert_allclose(one.inertia, 6e-5 * np.diag(squares), rtol=1e-4, atol=1e-14)


def test_a_ring_keeps_its_hole(tmp_path: Path):
    """Claim: a ring is split into parts that leave the hole free; mass and inertia are trimesh's
    of the ring, about its centre of mass."""
    ring = trimesh.creation.annulus(0.02, 0.03, 0.03)
    ring.apply_translation([0.1, 0.2, 0.3])
    one, share = conversion.convert(_file(tmp_path, ring), "ring", ImportSettings())
    assert len(one.parts) >= 4
    assert importing.SOUND[0] <= share <= importing.SOUND[1]
    assert not any((part.planes[:, 3] > 0.0).all() for part in one.parts)  # the middle is outside
    assert one.volume == pytest.approx(ring.volume, rel=1e-4)
    np.testing.assert_allclose(one.inertia, ring.moment_inertia, rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(one.bounds.mean(axis=0), 0.0, atol=1e-4)
    assert all(len(part.planes) <= solid.MOST_FACES for part in one.parts)


def test_round_parts_keep_most_of_their_volume():
    """Claim: a sphere of a thousand corners becomes a part of at most 64 faces that has more than
    four fifths of its volume and none of it outside."""
    points = trimesh.creation.icosphere(4, 0.03).vertices
    part = solid.simplified(points)
    assert len(part.planes) <= solid.MOST_FACES
    whole = solid.moments(part).volume / solid.moments(solid.convex(points)).volume
    assert 0.8 < whole < 1.0
    assert np.linalg.norm(part.vertices, axis=1).max() <= 0.03 + 1e-6


def test_a_small_hole_is_mended(tmp_path: Path):
    """Claim: a mesh that lacks one triangle is closed."""
    box = _box()
    holed = trimesh.Trimesh(box.vertices, box.faces[1:], process=False)
    one, _ = conversion.convert(_file(tmp_path, holed), "box", ImportSettings())
    assert one.volume == pytest.approx(6e-5, rel=1e-4)


def _open(folder: Path) -> Path:
    tube = trimesh.creation.cylinder(0.02, 0.05)
    sides = np.abs(tube.face_normals[:, 2]) < 0.5
    return _file(folder, trimesh.Trimesh(tube.vertices, tube.faces[sides], process=False))


def _text(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


_PLY = """ply
format ascii 1.0
element vertex 99999999999
property float x
element face 1
property list uchar int vertex_indices
end_header
0
"""
_NAN = "v 0 0 nan\nv 0.01 0 0\nv 0 0.01 0\nv 0 0 0.01\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
REFUSED = {
    "open": (_open, "is open or torn at [0-9]+ edges; close its mesh"),
    "millimetres": (
        lambda folder: _file(folder, _box((30, 40, 50))),
        r"is 50 m large at scale 1; .* try scale 0\.001",
    ),
    "tiny": (lambda folder: _file(folder, _box((3e-5, 4e-5, 5e-5))), "its unit may be another"),
    "garbage": (lambda folder: _text(folder, "mesh.glb", "glTF nothing"), "cannot be read as glb"),
    "empty": (lambda folder: _text(folder, "mesh.obj", ""), "mesh"),
    "huge header": (lambda folder: _text(folder, "mesh.ply", _PLY), "ply|mesh"),
    "not finite": (lambda folder: _text(folder, "mesh.obj", _NAN), "finite|open|mesh"),
    "flat": (
        lambda folder: _file(folder, _box((0.03, 0.04, 1e-9))),
        "sides of 1e-06 to 40 mm, not 1 to 400",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_taken_is_named(tmp_path: Path, name: str):
    """Claim: a file that is open, damaged, hostile or in another unit is one line with a reason."""
    make, message = REFUSED[name]
    with pytest.raises(ValueError, match=message) as caught:
        conversion.convert(make(tmp_path), name, ImportSettings())
    assert "\n" not in str(caught.value)


def test_a_file_names_no_other_file(tmp_path: Path):
    """Claim: materials and buffers that a mesh names are not opened."""
    _text(tmp_path, "secret.mtl", "newmtl a\nmap_Kd /etc/hostname\n")
    mesh = _file(tmp_path, _box(), "mesh.obj")
    mesh.write_text("mtllib secret.mtl\nusemtl a\n" + mesh.read_text())
    (tmp_path / "secret.mtl").chmod(0)
    assert conversion.convert(mesh, "box", ImportSettings())[0].volume > 0


@pytest.mark.slow
def test_the_command_writes_what_it_can(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Claim: good files become a library, bad ones a line each; what was finished is not computed
    again; without a good file nothing is written."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    for name in ("a.stl", "b.obj"):
        _file(folder, _box(), name)
    bad = _text(folder, "c.ply", _PLY)
    out = tmp_path / "lib"
    partial = Path(f"{out}.partial")
    importing.run([folder / "a.stl"], ImportSettings(), 1, partial, lambda *_: None)
    (kept,) = partial.iterdir()
    before = kept.stat().st_mtime_ns
    found = importing.run(importing.files([folder]), ImportSettings(), 2, partial, lambda *_: None)
    assert [one.name for one in found.objects] == ["a", "b"]
    assert len(found.refused) == 1
    assert kept.stat().st_mtime_ns == before
    assert cli.main(["objects", "import", str(folder), "--out", str(out), "--jobs", "1"]) == 0
    assert not partial.exists()
    assert [one.name for one in library.load(out).objects] == ["a", "b"]
    assert "1 of 3 files left out" in capsys.readouterr().out
    assert cli.main(["objects", "import", str(bad), "--out", str(tmp_path / "none")]) == 1
    assert not (tmp_path / "none").exists()
    assert "nothing is written" in capsys.readouterr().err
