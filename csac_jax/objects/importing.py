"""Many files to objects, several at a time. A cache of finished ones lets a stopped run resume."""

import contextlib
import dataclasses
import hashlib
import itertools
import resource
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path

from csac_jax import reading
from csac_jax.errors import SettingsError
from csac_jax.objects import conversion, descriptions, library
from csac_jax.objects.body import Object
from csac_jax.objects.conversion import ImportSettings
from csac_jax.objects.library import LibraryError
from csac_jax.runtime import processes

MESHES = (".obj", ".stl", ".ply", ".glb")
MODULES = ("trimesh", "coacd")
SOUND = (0.9, 1.15)  # volume of the parts / volume of all shapes; others deserve a look
_MEMORY = 2**33  # bytes that one worker may ask for

Converted = tuple[Object, float]  # with the volume of its parts / of all shapes


def files(paths: list[Path]) -> list[Path]:
    """Lists the importable files among these files and in these folders, sorted.

    The meshes in a folder with URDF or MJCF are parts of these. Raises SettingsError for a path
    that is missing or has none.
    """
    chosen: list[Path] = []
    for path in paths:
        if not path.exists():
            raise SettingsError(f"{path} does not exist")
        inside = [file for file in (path.rglob("*") if path.is_dir() else [path]) if file.is_file()]
        for suffixes in (descriptions.SUFFIXES, MESHES):
            if files := sorted(file for file in inside if file.suffix.lower() in suffixes):
                break
        else:
            known = ", ".join((*MESHES, *descriptions.SUFFIXES))
            raise SettingsError(f"{path}: no mesh file; known are: {known}")
        chosen += files
    return list(dict.fromkeys(chosen))


def run(
    paths: list[Path],
    settings: ImportSettings,
    jobs: int,
    cache: Path,
    on_progress: Callable[[int, int, str], None],  # finished, all, name of the latest
) -> tuple[list[Converted], list[str]]:
    """Converts files in `jobs` processes; the folder `cache` keeps finished objects.

    Returns: the objects; of each file that gave none, one line.
    """
    names, refused = _names(paths), dict[Path, str]()
    cached = {path: _cached(cache, path, names[path], settings) for path in paths}
    done = {path: entry for path, entry in cached.items() if entry is not None}

    def finish(path: Path, task: Future) -> None:
        try:
            done[path] = task.result()
            folder = _entry(cache, path, settings)
            if not folder.exists():
                library.save(folder, [done[path][0]])
        except (ValueError, OSError, MemoryError) as error:
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            refused[path] = f"{path}: {reason}"
        on_progress(len(done) + len(refused), len(paths), path.name)

    waiting = [path for path in paths if path not in done]
    unfinished = _convert(waiting, jobs, names, settings, finish)
    for path in unfinished:  # a crash ends all processes of a pool: now each file in its own
        if _convert([path], 1, names, settings, finish):
            refused[path] = f"{path}: CoACD crashed or ran out of memory; mend or reduce its mesh"
    lines = [refused[path] for path in paths if path in refused]
    return [done[path] for path in paths if path in done], lines


def _convert(
    paths: list[Path],
    jobs: int,
    names: dict[Path, str],
    settings: ImportSettings,
    on_done: Callable[[Path, Future], None],
) -> list[Path]:
    """Converts files in `jobs` processes; returns those left unfinished by a process that ended."""
    unfinished, number = [], max(min(jobs, len(paths)), 1)
    pool = ProcessPoolExecutor(number, get_context("spawn"), _begin)
    with contextlib.ExitStack() as stack:
        stack.callback(pool.shutdown, cancel_futures=True)
        submit = pool.submit
        tasks = {submit(conversion.convert, path, names[path], settings): path for path in paths}
        for task in as_completed(tasks):
            if isinstance(task.exception(), BrokenProcessPool):
                unfinished.append(tasks[task])
            else:
                on_done(tasks[task], task)
    return unfinished


def _begin() -> None:
    """Prepares a worker: its memory is bounded and it ends with its parent."""
    processes.end_with_parent()
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))


def _names(paths: list[Path]) -> dict[Path, str]:
    """Names each file by its stem, with a number where several have the same."""
    names: dict[Path, str] = {}
    for path in paths:
        stem = "".join(c if c.isprintable() else "_" for c in path.stem)[:90] or "object"
        choices = itertools.chain([stem], (f"{stem}-{number}" for number in itertools.count(2)))
        names[path] = next(name for name in choices if name not in names.values())
    return names


def _entry(cache: Path, path: Path, settings: ImportSettings) -> Path:
    described = path.suffix.lower() in descriptions.SUFFIXES
    content = conversion.read(path)[0] if described else reading.read_bytes(path)
    text = f"{path.name} {settings.scale} {settings.density} ".encode() + content
    return cache / hashlib.sha256(text).hexdigest()[:32]


def _cached(cache: Path, path: Path, name: str, settings: ImportSettings) -> Converted | None:
    with contextlib.suppress(LibraryError, OSError, ValueError):
        if cache.exists():
            (entry,) = library.load(_entry(cache, path, settings)).objects
            return dataclasses.replace(entry, name=name), conversion.share(entry)
    return None
