"""Objects from mesh files: read by trimesh, split into convex parts by CoACD (extra `objects`).

A file is read from memory, so that it can name no other file. Its shape must be closed: volume,
inertia and parts of an open one would be anybody's guess.
"""

import contextlib
import hashlib
import io
import os
import resource
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csac_jax.objects import library, solid
from csac_jax.objects.library import LibraryError, Object

SUFFIXES = (".obj", ".stl", ".ply", ".glb")
MODULES = ("trimesh", "coacd")
MOST_BYTES, MOST_TRIANGLES = 2**26, 500_000  # of a file
SOUND = (0.9, 1.15)  # volume of the parts / volume of the mesh, else it is said
_PARTS, _THRESHOLD = 16, 0.05  # CoACD's bounds of number and of concavity
_LEAST_VOLUME = 1e-4  # of the bounding box's: CoACD crashes on less
_MEMORY = 2**33  # bytes that one worker may ask for

Progress = Callable[[int, int, str], None]  # finished, all, name of the one just finished


class Imported(NamedTuple):
    """What became of the files."""

    objects: list[Object]
    volumes: dict[str, float]  # by name: volume of the parts / volume of the mesh
    refused: list[str]  # one line each, with the file


def files(paths: list[Path]) -> list[Path]:
    """The mesh files among these files and in these folders, sorted. Raises ValueError."""
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise ValueError(f"{path} does not exist")
        inside = [*path.rglob("*")] if path.is_dir() else [path]
        chosen = [one for one in inside if one.suffix.lower() in SUFFIXES and one.is_file()]
        if not chosen:
            raise ValueError(f"{path}: no mesh file; known are: {', '.join(SUFFIXES)}")
        found += sorted(chosen)
    return list(dict.fromkeys(found))


def convert(path: Path, name: str, scale: float) -> tuple[Object, float]:
    """The object in a file, and the volume of its parts over that of its mesh.

    Raises ValueError, one line with what to change.
    """
    import coacd

    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"is larger than {MOST_BYTES >> 20} MiB; reduce its mesh")
    content = path.read_bytes()
    mesh = _closed(_read(content, path.suffix[1:].lower()), scale)
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
    one = library.centred(name, parts, _moments(mesh), scale=scale, **source)
    if fault := library.faults(one):
        raise ValueError(fault)
    return one, float(share)


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
    if not 2e-3 <= size <= library.LARGEST:
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


def run(paths: list[Path], scale: float, jobs: int, kept: Path, progress: Progress) -> Imported:
    """The objects of mesh files, split by `jobs` processes.

    Finished objects are kept in the folder `kept`, so that a run that was stopped goes on.
    """
    names = _names(paths)
    done: dict[Path, tuple[Object, float]] = {}
    refused: dict[Path, str] = {}
    for path in paths:
        if (entry := _kept(kept, path, names[path], scale)) is not None:
            done[path] = entry
    waiting = [path for path in paths if path not in done]

    def finish(path: Path, task: Future) -> None:
        try:
            done[path] = task.result()
            _keep(kept, path, scale, *done[path])
        except (ValueError, OSError, MemoryError) as error:
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            refused[path] = f"{path}: {reason}"
        progress(len(done) + len(refused), len(paths), path.name)

    broken = _each(waiting, jobs, names, scale, finish)
    for path in broken:  # a process that ends takes those beside it along: now each by itself
        for alone in _each([path], 1, names, scale, finish):
            refused[alone] = f"{alone}: CoACD crashed or ran out of memory; mend or reduce its mesh"
    entries = [done[path] for path in paths if path in done]
    volumes = {one.name: share for one, share in entries}
    lines = [refused[path] for path in paths if path in refused]
    return Imported([one for one, _ in entries], volumes, lines)


def _each(
    paths: list[Path],
    jobs: int,
    names: dict[Path, str],
    scale: float,
    finish: Callable[[Path, Future], None],
) -> list[Path]:
    """Converts files in `jobs` processes; returns those that a process which ended left."""
    broken = []
    with _pool(max(min(jobs, len(paths)), 1)) as pool:
        tasks = {pool.submit(convert, path, names[path], scale): path for path in paths}
        for task in as_completed(tasks):
            if isinstance(task.exception(), BrokenProcessPool):
                broken.append(tasks[task])
            else:
                finish(tasks[task], task)
    return broken


@contextlib.contextmanager
def _pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Processes of bounded memory; what waits is dropped where the block is left by an error."""
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), initializer=_limit)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))


def _names(paths: list[Path]) -> dict[Path, str]:
    """A name for each file: its own, or with a number where others have it too."""
    names: dict[Path, str] = {}
    for path in paths:
        stem = "".join(c if c.isprintable() else "_" for c in path.stem)[:90] or "object"
        name, number = stem, 1
        while name in names.values():
            number += 1
            name = f"{stem}-{number}"
        names[path] = name
    return names


def _entry(kept: Path, path: Path, scale: float) -> Path:
    text = f"{path.name} {scale} ".encode() + path.read_bytes()
    return kept / hashlib.sha256(text).hexdigest()[:32]


def _kept(kept: Path, path: Path, name: str, scale: float) -> tuple[Object, float] | None:
    """What an earlier run has made of a file."""
    with contextlib.suppress(LibraryError, OSError):
        if path.stat().st_size <= MOST_BYTES:
            (one,) = library.load(_entry(kept, path, scale)).objects
            share = sum(solid.moments(part).volume for part in one.parts) / one.volume
            return library.renamed(one, name), share
    return None


def _keep(kept: Path, path: Path, scale: float, one: Object, share: float) -> None:
    folder = _entry(kept, path, scale)
    if not folder.exists():
        library.save(folder, [one])


def forget(kept: Path) -> None:
    """Removes what was kept."""
    shutil.rmtree(kept, ignore_errors=True)


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))
