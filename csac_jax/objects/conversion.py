"""One file to an object: read by trimesh, split into convex parts by CoACD (extra `objects`).

A mesh file is read from memory, so that it can name no other file. A shape must be closed: volume,
inertia and parts of an open one are not defined. Shapes may overlap; their union is the body.
"""

import contextlib
import hashlib
import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csac_jax import reading
from csac_jax.objects import body, descriptions, solid
from csac_jax.objects.body import DENSITY, Object

MOST_BYTES, MOST_TRIANGLES = 2**26, 500_000  # of a file
_PARTS, _THRESHOLD = 16, 0.05  # CoACD's bounds of number and of concavity
_LEAST_VOLUME = 1e-4  # of the bounding box's: CoACD crashes on less
_CONVEX = 0.99  # of the hull's volume; ours


class ImportSettings(NamedTuple):
    """Units and density of the objects in files."""

    scale: float = 1.0  # m per unit
    density: float = DENSITY  # kg/m^3


def convert(path: Path, name: str, settings: ImportSettings) -> tuple[Object, float]:
    """Converts a file to an object; also returns the volume of its parts over that of its shapes.

    Raises ValueError, one line with what to change.
    """
    import trimesh

    content, mesh = read(path)
    shapes = _shapes(_scaled(mesh, settings.scale))
    whole = trimesh.boolean.union(shapes) if len(shapes) > 1 else shapes[0]
    parts = [part for shape in shapes for part in _parts(shape)]
    if len(parts) > body.MOST_PARTS:
        parts = _split(whole)
    if not parts:
        raise ValueError("has no part with a volume")
    source = {"source": path.name, "source_sha256": hashlib.sha256(content).hexdigest()}
    converted = body.make(name, parts, _moments(whole), **settings._asdict(), **source)
    if fault := body.faults(converted):
        raise ValueError(fault)
    return converted, share(converted)


def share(one: Object) -> float:
    """Computes the volume of the union of an object's parts, over the volume of the object."""
    import trimesh

    meshes = [trimesh.Trimesh(part.vertices, part.triangles, process=False) for part in one.parts]
    return float(trimesh.boolean.union(meshes, check_volume=False).volume / one.volume)


def read(path: Path) -> tuple[bytes, Any]:
    """Reads a file: its content, with corners that are in other files, and its mesh of trimesh."""
    content, kind = reading.read_bytes(path, MOST_BYTES), path.suffix.lower()
    described = kind in descriptions.SUFFIXES
    mesh = descriptions.read(path) if described else _read_mesh(content, kind[1:])
    if not 4 <= len(getattr(mesh, "faces", ())) <= MOST_TRIANGLES:
        raise ValueError(f"has no mesh of 4 to {MOST_TRIANGLES} triangles")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError("has corners that are not finite")
    return content + described * np.asarray(mesh.vertices, np.float32).tobytes(), mesh


def _read_mesh(content: bytes, kind: str) -> Any:
    import trimesh

    file = io.BytesIO(descriptions.one_shape(content) if kind == "obj" else content)
    try:
        return trimesh.load(file, file_type=kind, force="mesh", process=False, skip_materials=True)
    except Exception as error:  # a damaged file raises nearly anything
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise ValueError(f"cannot be read as {kind}: {reason}") from None


def _scaled(mesh: Any, scale: float) -> Any:
    mesh.apply_scale(scale)
    size = float(mesh.extents.max())
    if not 2e-3 <= size <= body.LARGEST:
        fits = [unit for unit in (1e-3, 1e-2, 2.54e-2, 10.0, 1000.0) if 0.01 <= size * unit <= 0.3]
        units = " or ".join(f"{scale * unit:g}" for unit in fits)
        remedy = f"its unit may be another: try scale {units}" if fits else "give another scale"
        raise ValueError(f"is {size:.3g} m large at scale {scale:g}; {remedy}")
    return mesh


def _shapes(mesh: Any) -> list[Any]:
    """Splits a mesh into shapes that are closed each; without such a split, closes the whole."""
    import trimesh

    for _ in range(2):  # by shared corners, then by corners in one place
        faces = np.arange(len(mesh.faces))
        groups = trimesh.graph.connected_components(mesh.face_adjacency, min_len=4, nodes=faces)
        if sum(map(len, groups)) == len(faces):
            shapes = mesh.submesh(groups, repair=False)
            for shape in shapes:
                shape.merge_vertices()
                shape.update_faces((np.diff(np.sort(shape.faces)) > 0).all(axis=1))
                shape.fix_normals()
            if all(shape.is_volume for shape in shapes):
                return shapes
        mesh.merge_vertices()
    return [_closed(mesh)]


def _parts(shape: Any) -> list[solid.Part]:
    """Returns a convex shape as one part; splits any other."""
    try:
        hull = solid.convex(shape.vertices)
    except ValueError:  # a sliver without volume
        return []
    if shape.volume < _CONVEX * solid.moments(hull).volume:
        return _split(shape)
    return [solid.simplified(shape.vertices)]


def _split(mesh: Any) -> list[solid.Part]:
    """Splits a mesh into convex parts by CoACD."""
    import coacd

    if mesh.volume <= _LEAST_VOLUME * np.prod(mesh.extents):
        raise ValueError("has hardly any volume; close its mesh, and turn its faces outwards")
    coacd.set_log_level("error")
    whole, parts = coacd.Mesh(mesh.vertices, mesh.faces), []
    for corners, _ in coacd.run_coacd(whole, threshold=_THRESHOLD, max_convex_hull=_PARTS):
        with contextlib.suppress(ValueError):  # a part without volume
            parts.append(solid.simplified(corners))
    return parts


def _closed(mesh: Any) -> Any:
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    if not mesh.is_watertight:
        mesh.fill_holes()
    mesh.fix_normals()
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        edges = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
        raise ValueError(f"is open or torn at {(edges != 2).sum()} edges; close its mesh")
    return mesh


def _moments(mesh: Any) -> solid.Moments:
    com, inertia = mesh.center_mass, mesh.moment_inertia
    about = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    return solid.Moments(mesh.volume, mesh.volume * com, about + mesh.volume * np.outer(com, com))
