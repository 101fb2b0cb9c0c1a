"""Many files to objects, several at a time.

What is finished is kept, so that a run that was stopped goes on.
"""

import contextlib
import hashlib
import resource
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

from csac_jax.objects import body, conversion, library, solid
from csac_jax.objects.body import Object
from csac_jax.objects.conversion import How
from csac_jax.objects.library import LibraryError

SUFFIXES = (".obj", ".stl", ".ply", ".glb")
MODULES = ("trimesh", "coacd")
SOUND = (0.9, 1.15)  # volume of the parts / volume of the mesh, else it is said
_MEMORY = 2**33  # bytes that one worker may ask for

Progress = Callable[[int, int, str], None]  # finished, all, name of the one just finished


class Imported(NamedTuple):
    """What became of the files."""

    objects: list[Object]
    volumes: dict[str, float]  # by name: volume of the parts / volume of the mesh
    refused: list[str]  # one line each, with the file


def files(paths: list[Path], described: tuple[str, ...] = ()) -> list[Path]:
    """The mesh files among these files and in these folders, sorted. Raises ValueError.

    In a folder with descriptions, of the suffixes `described`, they are taken: the meshes are
    parts of them.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise ValueError(f"{path} does not exist")
        inside = [*path.rglob("*")] if path.is_dir() else [path]
        for suffixes in (described, SUFFIXES):
            chosen = [one for one in inside if one.suffix.lower() in suffixes and one.is_file()]
            if chosen:
                break
        else:
            known = ", ".join((*SUFFIXES, *described))
            raise ValueError(f"{path}: no mesh file; known are: {known}")
        found += sorted(chosen)
    return list(dict.fromkeys(found))


def run(paths: list[Path], how: How, jobs: int, kept: Path, progress: Progress) -> Imported:
    """The objects of mesh files, split by `jobs` processes.

    Finished objects are kept in the folder `kept`, so that a run that was stopped goes on.
    """
    names = _names(paths)
    done: dict[Path, tuple[Object, float]] = {}
    refused: dict[Path, str] = {}
    for path in paths:
        if (entry := _kept(kept, path, names[path], how)) is not None:
            done[path] = entry
    waiting = [path for path in paths if path not in done]

    def finish(path: Path, task: Future) -> None:
        try:
            done[path] = task.result()
            _keep(kept, path, how, *done[path])
        except (ValueError, OSError, MemoryError) as error:
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            refused[path] = f"{path}: {reason}"
        progress(len(done) + len(refused), len(paths), path.name)

    broken = _each(waiting, jobs, names, how, finish)
    for path in broken:  # a process that ends takes those beside it along: now each by itself
        for alone in _each([path], 1, names, how, finish):
            refused[alone] = f"{alone}: CoACD crashed or ran out of memory; mend or reduce its mesh"
    entries = [done[path] for path in paths if path in done]
    volumes = {one.name: share for one, share in entries}
    lines = [refused[path] for path in paths if path in refused]
    return Imported([one for one, _ in entries], volumes, lines)


def _each(
    paths: list[Path],
    jobs: int,
    names: dict[Path, str],
    how: How,
    finish: Callable[[Path, Future], None],
) -> list[Path]:
    """Converts files in `jobs` processes; returns those that a process which ended left."""
    broken = []
    with _pool(max(min(jobs, len(paths)), 1)) as pool:
        tasks = {pool.submit(conversion.convert, path, names[path], how): path for path in paths}
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


def _entry(kept: Path, path: Path, how: How) -> Path:
    content = path.read_bytes() if how.reader(path) is None else conversion.opened(path, how)[0]
    text = f"{path.name} {how.scale} {how.density} ".encode() + content
    return kept / hashlib.sha256(text).hexdigest()[:32]


def _kept(kept: Path, path: Path, name: str, how: How) -> tuple[Object, float] | None:
    """What an earlier run has made of a file."""
    with contextlib.suppress(LibraryError, OSError, ValueError):
        if kept.exists() and path.stat().st_size <= conversion.MOST_BYTES:
            (one,) = library.load(_entry(kept, path, how)).objects
            share = sum(solid.moments(part).volume for part in one.parts) / one.volume
            return body.renamed(one, name), share
    return None


def _keep(kept: Path, path: Path, how: How, one: Object, share: float) -> None:
    folder = _entry(kept, path, how)
    if not folder.exists():
        library.save(folder, [one])


def forget(kept: Path) -> None:
    """Removes what was kept."""
    shutil.rmtree(kept, ignore_errors=True)
