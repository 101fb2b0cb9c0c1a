"""`csac-jax objects make|import|show`: libraries of objects."""

import contextlib
import dataclasses
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import tyro

from csac_jax.algorithms import unknown
from csac_jax.cli import output, parsing
from csac_jax.cli.failures import (
    PROGRAM,
    BadArgumentsError,
    as_bad_arguments,
    check_extra,
    check_seed,
)
from csac_jax.errors import FailedError
from csac_jax.runtime import processes


@dataclasses.dataclass(frozen=True)
class MakeOptions:
    """Makes a library of our own shapes, at random; it needs no file of anybody's."""

    out: Path
    """Folder to write, which must not exist."""
    seed: int = 0
    """Number that the shapes follow from."""
    count: int = 200
    """Objects, family by family in turn."""
    mixed: bool = False
    """Make every other object an assembly of random blocks: more shapes to train on."""
    json: Path | None = None
    """File to write the list of objects to, as JSON."""


@dataclasses.dataclass(frozen=True)
class ImportOptions:
    """Makes a library of mesh files: .obj, .stl, .ply and .glb, or of URDF and MJCF. Each is split
    into convex parts, which takes seconds to a minute. Files that cannot be taken are named and
    left out. In a folder with URDF or MJCF, the meshes are parts of these."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Files, and folders of them."""
    out: Path
    """Folder to write, which must not exist. Beside it, until all is done, OUT.partial keeps what
    is finished: the same command goes on from there."""
    scale: float = 1.0
    """Metres per unit of the files: 0.001 for millimetres."""
    density: float = 600.0
    """Density of the objects, kg/m^3. Scenes draw theirs around it, as around 600."""
    jobs: int = 0
    """Files at a time; 0 for one per core."""
    json: Path | None = None
    """File to write the list of objects to, as JSON."""


@dataclasses.dataclass(frozen=True)
class ShowOptions:
    """Lists the objects of a library; draws them if asked to."""

    library: tyro.conf.Positional[str]
    """The library: a folder, made:SEED:COUNT or mixed:SEED:COUNT."""
    png: Path | None = None
    """File to write a contact sheet to, with names and sizes: .png, .jpg, .webp or .gif."""
    json: Path | None = None
    """File to write the list to, as JSON."""


def run(arguments: list[str]) -> int:
    """Runs one of the commands; returns the exit code."""
    name, *rest = arguments or [""]
    if name in ("", *parsing.SHORT_HELP):
        known = ", ".join(COMMANDS)
        print(f"usage: {PROGRAM} objects COMMAND ..., with COMMAND one of: {known}")
        return 0 if name else 2
    if name not in COMMANDS:
        raise BadArgumentsError(f"objects: {unknown('command', name, COMMANDS)}")
    return COMMANDS[name](rest)


def _make(arguments: list[str]) -> int:
    options = parsing.parse(MakeOptions, arguments, "objects make")
    check_seed(options.seed)
    from csac_jax.objects import families, library

    if not 1 <= options.count <= library.MOST_OBJECTS:
        raise BadArgumentsError(f"--count: must lie in 1 .. {library.MOST_OBJECTS}")
    _check_new(options.out)
    draw = families.draw_mixed if options.mixed else families.draw
    made = library.save(options.out, draw(options.seed, options.count))
    _list(made.objects)
    print(f"wrote {options.out}")
    output.write_result(options.json, {"objects": [_row(one) for one in made.objects]})
    return 0


def _import(arguments: list[str]) -> int:
    options = parsing.parse(ImportOptions, arguments, "objects import")
    _check_new(options.out)
    if not (0.0 < options.scale < 1e6 and 0 <= options.jobs <= 1024):
        raise BadArgumentsError("--scale must be positive, --jobs lie in 0 .. 1024")
    from csac_jax.objects import body, conversion, importing, library
    from csac_jax.scene import descriptions

    least, most = body.DENSITIES
    if not least <= options.density <= most:
        raise BadArgumentsError(f"--density: must lie in {least:g} .. {most:g} kg/m^3")
    for module in importing.MODULES:
        check_extra("objects import", module, "objects")
    with as_bad_arguments(ValueError):
        paths = importing.files(list(options.paths), descriptions.SUFFIXES)
    if len(paths) > library.MOST_OBJECTS:
        raise BadArgumentsError(f"{len(paths)} files: at most {library.MOST_OBJECTS} at a time")
    jobs, kept = options.jobs or processes.cores(), Path(f"{options.out}.partial")
    with _progress_bar() as show:
        readers = tuple((suffix, descriptions.read) for suffix in descriptions.SUFFIXES)
        how = conversion.How(options.scale, options.density, readers)
        found = importing.run(paths, how, jobs, kept, show)
    for line in found.refused:
        print(f"{PROGRAM}: {line}", file=sys.stderr)
    if not found.objects:
        raise FailedError(f"none of {len(paths)} files can be taken; nothing is written")
    _list(library.save(options.out, found.objects).objects)
    importing.forget(kept)
    for name, share in found.volumes.items():
        if not importing.SOUND[0] <= share <= importing.SOUND[1]:
            print(f"{name}: its parts have {share:.2f} of the mesh's volume; look at it")
    print(f"wrote {options.out}; {len(found.refused)} of {len(paths)} files left out")
    rows = [_row(one) | {"parts_volume": found.volumes[one.name]} for one in found.objects]
    output.write_result(options.json, {"objects": rows, "refused": found.refused})
    return 0


@contextlib.contextmanager
def _progress_bar() -> Iterator[Callable[[int, int, str], None]]:
    """A line on the terminal with the file just finished; nothing elsewhere."""
    bar = output.progress()
    task = bar.add_task("splitting into convex parts", total=None)
    with bar:
        yield lambda finished, total, name: bar.update(
            task, description=name, completed=finished, total=total
        )


def _check_new(folder: Path) -> None:
    if folder.exists():
        raise BadArgumentsError(f"--out: {folder} exists; give another name")


def _show(arguments: list[str]) -> int:
    options = parsing.parse(ShowOptions, arguments, "objects show")
    from csac_jax.objects import tables

    if options.png is not None:
        from csac_jax.render import media

        with as_bad_arguments(ValueError):
            media.check_suffix(options.png, media.PICTURES)
    objects = tables.find(options.library, "all").objects
    _list(objects)
    if options.png is not None:
        from csac_jax.render import sheet

        sheet.write(options.png, objects)
        print(f"wrote {options.png}")
    output.write_result(options.json, {"objects": [_row(one) for one in objects]})
    return 0


def _row(one: Any) -> dict[str, Any]:
    """What is said of an object."""

    size = one.bounds[1] - one.bounds[0]
    return {
        "name": one.name,
        "size_mm": [round(1e3 * float(side), 1) for side in size],
        "narrowest_mm": round(1e3 * one.narrowest, 1),
        "mass_g": round(1e3 * one.density * one.volume, 1),
        "parts": len(one.parts),
        "split": "held_out" if one.held_out else "train",
    }


def _list(objects: Any) -> None:
    """Prints the objects as a table, and which of them are too wide for the hand."""
    from rich.console import Console
    from rich.table import Table

    rows = [_row(one) for one in objects]
    table = Table("object", "size, mm", "narrowest, mm", "mass, g", "parts", "split")
    for row in rows:
        size = " x ".join(f"{side:.0f}" for side in row["size_mm"])
        numbers = (f"{row['narrowest_mm']:.0f}", f"{row['mass_g']:.0f}", str(row["parts"]))
        table.add_row(row["name"], size, *numbers, row["split"])
    Console(highlight=False).print(table)
    held_out = sum(row["split"] == "held_out" for row in rows)
    print(f"{len(rows)} objects, {held_out} of them held out")
    from csac_jax import grippers
    from csac_jax.config import SimConfig

    opening = 1e3 * grippers.load(SimConfig().gripper).opening[1]
    wide = [row["name"] for row in rows if row["narrowest_mm"] >= opening]
    if wide:
        print(f"wider than the hand opens, {opening:g} mm: {', '.join(wide)}")


COMMANDS = {"make": _make, "import": _import, "show": _show}
