"""One file to an object: read by trimesh, split into convex parts by CoACD (extra `objects`).

A mesh file is read from memory, so that it can name no other file. A description of a robot, which
names mesh files, is read by a `Reader` that the caller gives. A shape must be closed: volume,
inertia and parts of an open one would be anybody's guess.
"""

import contextlib
import hashlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csac_jax.objects import body, solid
from csac_jax.objects.body import DENSITY, Object

MOST_BYTES, MOST_TRIANGLES = 2**26, 500_000  # of a file
_PARTS, _THRESHOLD = 16, 0.05  # CoACD's bounds of number and of concavity
_LEAST_VOLUME = 1e-4  # of the bounding box's: CoACD crashes on less

Reader = Callable[[Path], Any]  # the mesh, as trimesh has it, of a file; raises ValueError


class How(NamedTuple):
    """How files become objects; a value that processes can share."""

    scale: float = 1.0  # m per unit
    density: float = DENSITY  # kg/m^3
    readers: tuple[tuple[str, Reader], ...] = ()  # suffix of descriptions -> what reads them

    def reader(self, path: Path) -> Reader | None:
        """What reads a file; None for a mesh file."""
        return dict(self.readers).get(path.suffix.lower())


def convert(path: Path, name: str, how: How) -> tuple[Object, float]:
    """The object in a file, and the volume of its parts over that of its mesh.

    Raises ValueError, one line with what to change.
    """
    import coacd

    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"is larger than {MOST_BYTES >> 20} MiB; reduce its mesh")
    content, mesh = opened(path, how)
    mesh = _closed(mesh, how.scale)
    coacd.set_log_level("error")
    hulls = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces), threshold=_THRESHOLD, max_convex_hull=_PARTS
    )
    parts = []
    for corners, _ in hulls:
        with contextlib.suppress(ValueError):  # a part without volume
            parts.append(solid.simplified(corners))
    if not parts:
        raise ValueError("has no part with a volume")
    share = sum(solid.moments(part).volume for part in parts) / mesh.volume
    source = {"source": path.name, "source_sha256": hashlib.sha256(content).hexdigest()}
    more = {"scale": how.scale, "density": how.density}
    one = body.centred(name, parts, _moments(mesh), **more, **source)
    if fault := body.faults(one):
        raise ValueError(fault)
    return one, float(share)


def opened(path: Path, how: How) -> tuple[bytes, Any]:
    """What a file says, and its mesh as trimesh has it; of a description with the mesh's corners,
    which are in other files."""
    content, reader = path.read_bytes(), how.reader(path)
    if reader is None:
        return content, _read(content, path.suffix[1:].lower())
    mesh = reader(path)
    if not 4 <= len(mesh.faces) <= MOST_TRIANGLES:
        raise ValueError(f"has no mesh of 4 to {MOST_TRIANGLES} triangles")
    return content + np.asarray(mesh.vertices, np.float32).tobytes(), mesh


def _read(content: bytes, kind: str) -> Any:
    """The mesh of a file, as trimesh has it."""
    import trimesh

    try:
        mesh = trimesh.load(io.BytesIO(content), file_type=kind, force="mesh", skip_materials=True)
    except Exception as error:  # a damaged file raises nearly anything
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise ValueError(f"cannot be read as {kind}: {reason}") from None
    if not isinstance(mesh, trimesh.Trimesh) or not 4 <= len(mesh.faces) <= MOST_TRIANGLES:
        raise ValueError(f"has no mesh of 4 to {MOST_TRIANGLES} triangles")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError("has corners that are not finite")
    return mesh


def _closed(mesh: Any, scale: float) -> Any:
    """The mesh in metres, mended where holes are small. Raises ValueError."""
    mesh.apply_scale(scale)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    if not 2e-3 <= size <= body.LARGEST:
        fits = [unit for unit in (1e-3, 1e-2, 2.54e-2, 10.0, 1000.0) if 0.01 <= size * unit <= 0.3]
        units = " or ".join(f"{scale * unit:g}" for unit in fits)
        remedy = f"its unit may be another: try --scale {units}" if fits else "give another --scale"
        raise ValueError(f"is {size:.3g} m large at --scale {scale:g}; {remedy}")
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    if not mesh.is_watertight:
        mesh.fill_holes()
    mesh.fix_normals()
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        edges = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
        raise ValueError(f"is open or torn at {(edges != 2).sum()} edges; close its mesh")
    if mesh.volume <= _LEAST_VOLUME * np.prod(np.ptp(mesh.vertices, axis=0)):
        raise ValueError("has hardly any volume; close its mesh, and turn its faces outwards")
    return mesh


def _moments(mesh: Any) -> solid.Moments:
    """Integrals over a closed mesh, from trimesh's inertia about the centre of mass."""
    com, inertia = mesh.center_mass, mesh.moment_inertia
    about = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    return solid.Moments(mesh.volume, mesh.volume * com, about + mesh.volume * np.outer(com, com))
