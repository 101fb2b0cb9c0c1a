"""Files of several shapes: all are read, and convex ones are taken as they are."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from csac_jax.objects import conversion, importing
from csac_jax.objects.body import Object
from csac_jax.objects.conversion import ImportSettings

coacd = pytest.importorskip("coacd")

FILES = {
    "shapes.obj": "",
    "a.urdf": '<robot name="a"><link name="one"><collision><geometry>'
    '<mesh filename="shapes.obj"/></geometry></collision></link></robot>',
    "a.xml": '<mujoco><asset><mesh file="shapes.obj"/></asset><worldbody>'
    '<geom type="mesh" mesh="shapes"/></worldbody></mujoco>',
}


def _box(x: float, y: float, *size: float) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation((x, y, 0.0))


TOUCHING = [_box(0, 0, 0.02, 0.02, 0.02), _box(0.02, 0, 0.02, 0.02, 0.02)]
TOUCHING += [_box(0.02, 0.025, 0.02, 0.03, 0.02)]
OVERLAPPING = [_box(0, 0, 0.03, 0.02, 0.02), _box(0.02, 0, 0.03, 0.02, 0.02)]
L_SHAPE = trimesh.boolean.union([_box(0, 0, 0.06, 0.02, 0.02), _box(0.02, 0.02, 0.02, 0.06, 0.02)])


def _write(folder: Path, meshes: list[trimesh.Trimesh], name: str, key: str = "o") -> Path:
    """Writes an OBJ file of several shapes with trimesh, and the file that names it. The last shape
    has two materials."""
    text = trimesh.Scene(meshes).export(file_type="obj", include_normals=True)
    assert text.count("\no ") == len(meshes)
    rest, last_face = text.replace("\no ", f"\n{key} ").rsplit("\nf ", 1)
    (folder / "shapes.obj").write_text(f"{rest}\nusemtl other\nf {last_face}")
    if FILES[name]:
        (folder / name).write_text(FILES[name])
    return folder / name


def _convert(path: Path) -> tuple[Object, float]:
    return conversion.convert(path, "a", ImportSettings())


def _hull(vertices: np.ndarray) -> trimesh.Trimesh:
    return trimesh.convex.convex_hull(vertices)


@pytest.fixture
def no_splitting(monkeypatch: pytest.MonkeyPatch):
    """Makes every call of CoACD an error."""

    def refuse(*_, **__):
        raise AssertionError("a convex shape was split")

    monkeypatch.setattr(coacd, "run_coacd", refuse)


@pytest.mark.usefixtures("no_splitting")
@pytest.mark.parametrize("key", ["o", "g"])
@pytest.mark.parametrize("name", FILES)
def test_every_convex_shape_is_a_part(tmp_path: Path, name: str, key: str):
    """Claim: convex shapes of an OBJ, also touching ones, are each a part of the same volume.
    MuJoCo finds the mass and inertia of the object in these parts."""
    one, share = _convert(_write(tmp_path, TOUCHING, name, key))
    volumes = sorted(_hull(part.vertices).volume for part in one.parts)
    np.testing.assert_allclose(volumes, [8e-6, 8e-6, 12e-6], rtol=1e-4)
    assert share == pytest.approx(1.0, rel=1e-4)
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    for number, part in enumerate(one.parts):
        corners, faces = part.vertices.ravel(), part.triangles.ravel()
        spec.add_mesh(name=f"{number}", uservert=corners, userface=faces)
        kind = mujoco.mjtGeom.mjGEOM_MESH
        body.add_geom(type=kind, meshname=f"{number}", density=one.density)
    model = spec.compile()
    assert model.body_mass[1] == pytest.approx(one.density * 28e-6, rel=1e-4)
    moments = np.linalg.eigvalsh(one.density * one.inertia)[::-1]
    np.testing.assert_allclose(model.body_inertia[1], moments, rtol=1e-3)
    np.testing.assert_allclose(model.body_ipos[1], 0.0, atol=1e-6)


@pytest.mark.usefixtures("no_splitting")
@pytest.mark.parametrize("name", FILES)
def test_the_volume_check_counts_overlaps_once(tmp_path: Path, name: str):
    """Claim: overlapping shapes have the volume of their union, and so have their parts. An import
    that resumes says the same."""
    path = _write(tmp_path, OVERLAPPING, name)
    one, share = _convert(path)
    assert len(one.parts) == 2
    assert one.volume == pytest.approx(0.05 * 0.02 * 0.02, rel=1e-4)
    assert share == pytest.approx(1.0, rel=1e-4)
    partial = tmp_path / "partial"
    for _ in range(2):
        ((_, again),), _ = importing.run([path], ImportSettings(), 1, partial, lambda *_: None)
        assert again == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize("name", FILES)
def test_only_the_shape_that_is_not_convex_is_split(tmp_path: Path, name: str):
    """Claim: of an L and a box, the L is split, and the box is a part as it is."""
    one, share = _convert(_write(tmp_path, [L_SHAPE, _box(-0.02, 0.02, 0.02, 0.02, 0.02)], name))
    assert len(one.parts) >= 3
    assert any(_hull(p.vertices).volume == pytest.approx(8e-6, rel=1e-5) for p in one.parts)
    assert one.volume == pytest.approx(L_SHAPE.volume + 8e-6, rel=1e-4)
    assert share == pytest.approx(1.0, abs=0.05)


def test_more_shapes_than_parts_are_split_as_a_whole(tmp_path: Path):
    """Claim: forty shapes make an object of at most 32 parts. The volume check compares these with
    all shapes, by sampling."""
    slabs = [_box(0.005 * i, 0, 0.004, 0.02, 0.02) for i in range(40)]
    one, share = _convert(_write(tmp_path, slabs, "a.urdf"))
    assert len(one.parts) <= 32
    assert one.volume == pytest.approx(40 * 1.6e-6, rel=1e-4)
    low, high = one.bounds
    points = np.random.default_rng(0).uniform(low, high, (20_000, 3))
    inside = np.any(
        [(points @ p.planes[:, :3].T <= p.planes[:, 3]).all(axis=1) for p in one.parts], axis=0
    )
    assert share == pytest.approx(inside.mean() * np.prod(high - low) / one.volume, abs=0.03)


@pytest.mark.parametrize("name", ["a.urdf", "a.xml"])
def test_an_open_shape_among_closed_ones_is_named(tmp_path: Path, name: str):
    """Claim: a file of which one shape is open, not the first, is refused in one line."""
    tube = trimesh.creation.cylinder(0.01, 0.02).apply_translation((0.05, 0.0, 0.0))
    tube.update_faces(np.abs(tube.face_normals[:, 2]) < 0.5)
    path = _write(tmp_path, [TOUCHING[0], tube], name)
    with pytest.raises(ValueError, match=r"open or torn at 64 edges") as caught:
        _convert(path)
    assert "\n" not in str(caught.value)
