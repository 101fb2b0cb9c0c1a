"""URDF and MJCF files as one closed mesh."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from csac_jax.objects import conversion, descriptions, importing
from csac_jax.objects.conversion import ImportSettings

pytest.importorskip("coacd")
_URDF = """<robot name="a"><link name="one">
<visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual>
<collision><origin xyz="0.01 0 0" rpy="0.3 0 1"/>
<geometry><mesh filename="{mesh}" scale="0.001 0.001 0.001"/></geometry></collision>
</link>{more}</robot>"""
_HINGE = """<link name="two"><collision><geometry><sphere radius="0.01"/></geometry></collision>
</link>
<joint name="turn" type="continuous"><parent link="one"/><child link="two"/></joint>"""
_MJCF = "<mujoco><worldbody>{}</worldbody></mujoco>"


def _text(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


@pytest.fixture
def bent(tmp_path: Path) -> trimesh.Trimesh:
    """Writes a.urdf, with a bent mesh in millimetres; returns the mesh that it describes."""
    arm = trimesh.creation.box((20, 40, 20)).apply_translation((20, 20, 0))
    corner = trimesh.boolean.union([trimesh.creation.box((60, 20, 20)), arm])
    (tmp_path / "meshes").mkdir()
    corner.export(tmp_path / "meshes" / "corner.obj")
    _text(tmp_path, "a.urdf", _URDF.format(mesh="meshes/corner.obj", more=""))
    place = trimesh.transformations.euler_matrix(0.3, 0.0, 1.0)
    return corner.apply_scale(1e-3).apply_transform(place)


def test_a_urdf_has_the_volume_and_inertia_of_its_mesh(bent: trimesh.Trimesh, tmp_path: Path):
    """Claim: what collides in a URDF, where its origin puts it, has trimesh's volume, inertia and
    size. A folder with a URDF gives that, not the mesh it names; without one its meshes."""
    assert importing.files([tmp_path]) == [tmp_path / "a.urdf"]
    assert importing.files([tmp_path / "meshes"])[0].name == "corner.obj"
    member, share = conversion.convert(tmp_path / "a.urdf", "a", ImportSettings())
    assert member.volume == pytest.approx(bent.volume, rel=1e-4)
    np.testing.assert_allclose(member.inertia, bent.moment_inertia, rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(member.bounds[1] - member.bounds[0], bent.extents, atol=1e-3)
    assert share == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("kind", "size", "volume"),
    [
        ("sphere", ".02", 4.0 / 3.0 * np.pi * 0.02**3),
        ("cylinder", ".02 .03", np.pi * 0.02**2 * 0.06),
        ("capsule", ".02 .03", np.pi * 0.02**2 * (0.06 + 4.0 / 3.0 * 0.02)),
        ("ellipsoid", ".01 .02 .03", 4.0 / 3.0 * np.pi * 6e-6),
    ],
)
def test_every_kind_of_geom_has_its_volume(tmp_path: Path, kind: str, size: str, volume: float):
    """Claim: a geom's mesh has the closed form's volume, but for flat faces, and its middle."""
    body = f'<body pos="0 0 1"><geom type="{kind}" size="{size}" pos="0.1 0 0"/></body>'
    mesh = descriptions.read(_text(tmp_path, "a.xml", _MJCF.format(body)))
    assert mesh.is_watertight
    assert 0.95 * volume < mesh.volume <= volume
    np.testing.assert_allclose(mesh.center_mass, [0.1, 0.0, 1.0], atol=1e-6)


REFUSED = {
    "plane.xml": (_MJCF.format('<geom type="plane" size="1 1 1"/>'), "kind plane; give it a mesh"),
    "nothing.xml": (_MJCF.format(""), "has no geom"),
    "garbage.urdf": ("<robot", "XML|Error"),
    "outside.urdf": (_URDF.format(mesh="../meshes/corner.obj", more=""), "outside of its folder"),
    "missing.urdf": (_URDF.format(mesh="b.obj", more=""), "b.obj"),
    "hinge.urdf": (_URDF.format(mesh="a.obj", more=_HINGE), "an object is one rigid body"),
}


_ASSETS = "<mujoco><compiler {}/><asset>{}</asset></mujoco>"
ELSEWHERE = {
    "include": '<mujoco><include file="{}"/></mujoco>',
    "model": _ASSETS.format("", '<model name="a" file="{}"/>'),
    "mesh": _ASSETS.format("", '<mesh name="a" file="{}"/>'),
    "texture": _ASSETS.format("", '<texture type="2d" name="a" file="{}"/>'),
    "side of a texture": _ASSETS.format("", '<texture type="cube" name="a" fileright="{}"/>'),
    "heights": _ASSETS.format("", '<hfield name="a" file="{}" size="1 1 1 1"/>'),
    "URDF": _URDF.format(mesh="{}", more=""),
    "entity": _ASSETS.format("", "<mesh name='a' file='{}'/>").replace("{}", "&#46;/{}"),
}


@pytest.mark.parametrize("kind", ELSEWHERE)
@pytest.mark.parametrize("place", ["../out.stl", "pipe.stl", "link.stl", "sub", "by_include"])
def test_only_regular_files_below_the_folder_are_opened(tmp_path: Path, kind: str, place: str):
    """Claim: a description that names a file elsewhere, a pipe or a link out of its folder, itself
    or in a file that it includes, is refused before anything is opened."""
    folder = tmp_path / "inside"
    (folder / "sub").mkdir(parents=True)
    os.mkfifo(tmp_path / "out.stl")
    os.mkfifo(folder / "pipe.stl")
    os.mkfifo(folder / "sub" / "deep.stl")
    (folder / "link.stl").symlink_to(tmp_path / "out.stl")
    text = ELSEWHERE[kind].format("pipe.stl" if place == "by_include" else place)
    if place == "sub":
        text = ELSEWHERE[kind].format("deep.stl")
        _text(folder, "dirs.xml", _ASSETS.format('meshdir="sub" texturedir="sub"', ""))
        text = text.replace("</mujoco>", '<include file="dirs.xml"/></mujoco>')
        text = text.replace("<robot", '<robot meshdir="sub"')
    if place == "by_include":
        _text(folder, "more.xml", text)
        text = '<mujoco><include file="more.xml"/></mujoco>'
    with pytest.raises((ValueError, OSError), match=r"outside of its folder|a pipe"):
        descriptions.read(_text(folder, "a.xml", text))


@pytest.mark.usefixtures("bent")
@pytest.mark.parametrize("name", REFUSED)
def test_a_description_that_is_no_object_is_named(tmp_path: Path, name: str):
    """Claim: geoms without a mesh, damaged files, meshes elsewhere and joints are one line."""
    text, message = REFUSED[name]
    (tmp_path / "inside").mkdir()
    trimesh.creation.box((20, 20, 20)).export(tmp_path / "inside" / "a.obj")
    with pytest.raises(ValueError, match=message) as caught:
        descriptions.read(_text(tmp_path / "inside", name, text))
    assert "\n" not in str(caught.value)
