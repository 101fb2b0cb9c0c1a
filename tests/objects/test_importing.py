"""Mesh files into objects: reading, mending, refusals."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from csac_jax import cli
from csac_jax.errors import SettingsError
from csac_jax.objects import conversion, importing, library, solid
from csac_jax.objects.body import Object
from csac_jax.objects.conversion import ImportSettings

pytest.importorskip("coacd")


BOX = trimesh.creation.box((0.03, 0.04, 0.05))


def _file(folder: Path, mesh: trimesh.Trimesh = BOX, name: str = "mesh.stl") -> Path:
    mesh.export(folder / name)
    return folder / name


def _text(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def _convert(path: Path) -> tuple[Object, float]:
    return conversion.convert(path, "name", ImportSettings())


@pytest.mark.parametrize("kind", ["obj", "stl", "ply", "glb"])
def test_every_format_gives_the_same_box(tmp_path: Path, kind: str):
    """Claim: a box of any format is one part with the closed form of volume and inertia. One that
    lacks a triangle is closed, and the materials that a file names are not opened."""
    path = _file(tmp_path, BOX, f"mesh.{kind}")
    if kind == "obj":
        _text(tmp_path, "secret.mtl", "newmtl a\nmap_Kd /etc/hostname\n").chmod(0)
        path.write_text("mtllib secret.mtl\nusemtl a\n" + path.read_text())
    elif kind == "stl":
        _file(tmp_path, trimesh.Trimesh(BOX.vertices, BOX.faces[1:], process=False))
    box, share = _convert(path)
    assert len(box.parts) == 1
    assert len(box.parts[0].planes) == 6
    assert share == pytest.approx(1.0, rel=1e-3)
    assert box.volume == pytest.approx(6e-5, rel=1e-4)
    squares = np.array([16 + 25, 9 + 25, 9 + 16]) * 1e-4 / 12
    np.testing.assert_allclose(box.inertia, 6e-5 * np.diag(squares), rtol=1e-4, atol=1e-14)


def test_a_ring_keeps_its_hole(tmp_path: Path):
    """Claim: a ring is split into parts that leave the hole free; mass and inertia are trimesh's
    of the ring, about its centre of mass."""
    ring = trimesh.creation.annulus(0.02, 0.03, 0.03)
    ring.apply_translation([0.1, 0.2, 0.3])
    one, share = _convert(_file(tmp_path, ring))
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
_TUBE = trimesh.creation.cylinder(0.02, 0.05)
_SIDES = _TUBE.faces[np.abs(_TUBE.face_normals[:, 2]) < 0.5]
REFUSED = {  # the mesh, the sides of a box, or the text of a file
    "open.stl": (trimesh.Trimesh(_TUBE.vertices, _SIDES, process=False), "is open or torn at "),
    "millimetres.stl": ((30, 40, 50), r"is 50 m large at scale 1; .* try scale 0\.001"),
    "flat.stl": ((0.03, 0.04, 1e-9), "sides of 1e-06 to 40 mm, not 1 to 400"),
    "garbage.glb": ("glTF nothing", "cannot be read as glb"),
    "huge_header.ply": (_PLY, "ply|mesh"),
    "not_finite.obj": (_NAN, "finite|open|mesh"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_taken_is_named(tmp_path: Path, name: str):
    """Claim: a file that is open, damaged, hostile or in another unit is one line with a reason."""
    content, message = REFUSED[name]
    mesh = trimesh.creation.box(content) if isinstance(content, tuple) else content
    path = _text(tmp_path, name, mesh) if isinstance(mesh, str) else _file(tmp_path, mesh, name)
    with pytest.raises(ValueError, match=message) as caught:
        _convert(path)
    assert "\n" not in str(caught.value)


def test_a_pipe_is_refused(tmp_path: Path):
    """Claim: a pipe in the place of a mesh is refused, and not waited for."""
    os.mkfifo(tmp_path / "a.stl")
    with pytest.raises(OSError, match="a pipe"):
        _convert(tmp_path / "a.stl")
    with pytest.raises(SettingsError, match="no mesh file"):
        importing.files([tmp_path / "a.stl"])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_the_import(tmp_path: Path, number: signal.Signals):
    """Claim: an import that is killed leaves no worker."""
    knot = trimesh.creation.torus(0.05, 0.02, 96, 48)
    paths = [_file(tmp_path, knot, f"{name}.stl") for name in range(4)]
    program = ["-m", "csac_jax", "objects", "import", *map(str, paths), "--jobs", "2"]
    root = str(Path(__file__).parents[2])
    process = subprocess.Popen(
        [sys.executable, *program, "--out", str(tmp_path / "lib")],
        env={**os.environ, "PYTHONPATH": root},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _wait_until(lambda: len(_workers(process.pid)) == 2, 60)
    workers = _workers(process.pid)
    process.send_signal(number)
    process.wait(20)
    _wait_until(lambda: not any(Path(f"/proc/{worker}/cmdline").exists() for worker in workers), 20)


def _workers(parent: int) -> list[str]:
    """Lists the spawned processes of a pool, which have begun."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    started = [one for one in children if Path(f"/proc/{one}/stat").exists()]
    return [one for one in started if b"spawn_main" in Path(f"/proc/{one}/cmdline").read_bytes()]


def _wait_until(holds: Callable[[], bool], limit: float) -> None:
    end = time.monotonic() + limit
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.slow
def test_the_command_writes_what_it_can(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Claim: good files become a library, bad ones a line each; what was finished is not computed
    again; without a good file nothing is written."""
    folder, out, settings = tmp_path / "meshes", tmp_path / "lib", ImportSettings()
    folder.mkdir()
    for name in ("a.stl", "b.obj"):
        _file(folder, BOX, name)
    bad = _text(folder, "c.ply", _PLY)
    partial = Path(f"{out}.partial")
    importing.run([folder / "a.stl"], settings, 1, partial, lambda *_: None)
    (entry,) = partial.iterdir()
    before = entry.stat().st_mtime_ns
    paths = importing.files([folder])
    converted, refused = importing.run(paths, settings, 2, partial, lambda *_: None)
    assert [member.name for member, _ in converted] == ["a", "b"]
    assert len(refused) == 1
    assert entry.stat().st_mtime_ns == before
    assert cli.main(["objects", "import", str(folder), "--out", str(out), "--jobs", "1"]) == 0
    assert not partial.exists()
    assert [member.name for member in library.load(out).objects] == ["a", "b"]
    assert "1 of 3 files left out" in capsys.readouterr().out
    assert cli.main(["objects", "import", str(bad), "--out", str(tmp_path / "none")]) == 1
    assert not (tmp_path / "none").exists()
    assert "nothing is written" in capsys.readouterr().err
