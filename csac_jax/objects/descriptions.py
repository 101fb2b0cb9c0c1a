"""A robot description, URDF or MJCF, as one mesh of all its geoms, read by MuJoCo.

It must be one rigid body: no joints but a free one.
"""

import html
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from csac_jax import reading

SUFFIXES = (".urdf", ".xml")
_LARGEST = 2**22  # bytes of a description
_LARGEST_NAMED = 2**26  # bytes of a file that it names
_MOST_NAMES = 1000  # of files in all descriptions of an object
_FILE = re.compile(rb"""\bfile\w*\s*=\s*(?:"([^"]*)"|'([^']*)')""")
_FOLDER = re.compile(rb"""\b(?:mesh|texture|asset)dir\s*=\s*(?:"([^"]*)"|'([^']*)')""")
_FREE = 6  # degrees of freedom of the whole
_Geom = mujoco.mjtGeom


def read(path: Path) -> Any:
    """Reads the geoms that collide, or all if none does, as one mesh of trimesh.

    Raises ValueError, one line with what to change.
    """
    if path.stat().st_size > _LARGEST:
        raise ValueError(f"is larger than {_LARGEST >> 20} MiB; keep its meshes in files")
    _check_named(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.assets = _whole_files(spec, path.parent)
        model = spec.compile()
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise ValueError(" ".join(str(error).split())[:200]) from None
    if model.nv not in (0, _FREE) or model.njnt > 1:
        raise ValueError(f"has {model.njnt} joints that move; an object is one rigid body")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    geoms = np.flatnonzero(collides | ~collides.any())
    if not geoms.size:
        raise ValueError("has no geom")
    import trimesh

    meshes = [surface(model, geom).apply_transform(_pose(data, geom)) for geom in map(int, geoms)]
    return trimesh.util.concatenate(meshes)


def one_shape(content: bytes) -> bytes:
    """Rewrites an OBJ file so that readers take it as one shape, corners told apart by position.

    MuJoCo reads the first shape of several, with no warning.
    """
    plain = re.sub(rb"(?m)^[ \t]*(?:o|g|usemtl|mtllib|vn|vt)\b.*$", b"", content)
    return re.sub(rb"/[-\d/]*", b"", plain)  # numbers of textures and normals


def _whole_files(spec: mujoco.MjSpec, folder: Path) -> dict[str, bytes]:
    """Returns the OBJ files that a description names, each as one shape."""
    whole = {}
    for mesh in spec.meshes:
        file = folder / spec.meshdir / mesh.file
        if file.suffix.lower() == ".obj" and file.is_file():
            whole[mesh.file] = one_shape(file.read_bytes())
    return whole


def _check_named(path: Path) -> None:
    """Raises ValueError if a file that MuJoCo may open for a description is not a regular one below
    its folder: all that look like names count, in the files named as well."""
    root, left, read = os.path.realpath(path.parent), {os.path.realpath(path)}, set[str]()
    names, folders = set[str](), {root}
    while left:
        for file in left:
            content = reading.read_bytes(Path(file), _LARGEST_NAMED)
            names |= _texts(_FILE, content)
            folders |= {os.path.dirname(file), *_texts(_FOLDER, content)}
        if len(names) * len(folders) ** 2 > 100 * _MOST_NAMES:
            raise ValueError(f"names more than {_MOST_NAMES} files; join its meshes")
        read |= left
        left = set(_existing(root, names, folders)) - read


def _existing(root: str, names: set[str], folders: set[str]) -> Iterator[str]:
    """Yields the files of these names in all folders that MuJoCo may take them from."""
    plain = {name.removeprefix("package://") for name in names}
    places = {os.path.join(root, one, two) for one in folders for two in folders}
    for name in plain | {os.path.basename(name) for name in plain}:
        for place in filter(os.path.lexists, (os.path.join(place, name) for place in places)):
            file = os.path.realpath(place)
            if not Path(file).is_relative_to(root):
                raise ValueError(f"names '{name}', outside of its folder; move it there")
            if name and not os.path.isdir(file):
                yield file


def _texts(pattern: re.Pattern[bytes], content: bytes) -> set[str]:
    found = {one or other for one, other in pattern.findall(content)}
    return {html.unescape(os.fsdecode(text)) for text in found}


def _pose(data: mujoco.MjData, geom: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    return pose


def surface(model: mujoco.MjModel, geom: int) -> Any:
    """Builds the mesh of trimesh of one geom, m, in its frame. Raises ValueError for a plane."""
    import trimesh

    size, kind, make = model.geom_size[geom], int(model.geom_type[geom]), trimesh.creation

    def mesh_of_model() -> Any:
        number = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
        begin, faces = model.mesh_faceadr[number], model.mesh_facenum[number]
        corners, triangles = model.mesh_vert[first:][:count], model.mesh_face[begin:][:faces]
        return trimesh.Trimesh(corners, triangles, process=False)

    makers = {
        _Geom.mjGEOM_MESH: mesh_of_model,
        _Geom.mjGEOM_BOX: lambda: make.box(2.0 * size),
        _Geom.mjGEOM_SPHERE: lambda: make.icosphere(3, size[0]),
        _Geom.mjGEOM_ELLIPSOID: lambda: make.icosphere(3, 1.0).apply_scale(size),
        _Geom.mjGEOM_CYLINDER: lambda: make.cylinder(size[0], 2.0 * size[1]),
        _Geom.mjGEOM_CAPSULE: lambda: make.capsule(2.0 * size[1], size[0]),
    }
    if kind not in makers:
        raise ValueError(f"has a geom of kind {_Geom(kind).name[7:].lower()}; give it a mesh")
    return makers[_Geom(kind)]()
