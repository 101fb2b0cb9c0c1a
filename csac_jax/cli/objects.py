"""`csac-jax objects make|import|show`: libraries of objects."""

import dataclasses
import shutil
import sys
from pathlib import Path
from typing import Any

import tyro

from csac_jax.cli import output, parsing
from csac_jax.cli.failures import check_extra, check_seed
from csac_jax.cli.parsing import PROGRAM
from csac_jax.errors import FailedError
from csac_jax.runtime import processes
from csac_jax.section import require


@dataclasses.dataclass(frozen=True)
class MakeOptions:
    """Makes a library of random shapes; needs no mesh files."""

    out: Path
    """Folder to write, which must not exist."""
    seed: int = 0
    """Seed of the random shapes."""
    count: int = 200
    """Number of objects, one family after another."""
    mixed: bool = False
    """Make every other object an assembly of random blocks: more shapes to train on."""
    json: Path | None = None
    """File to write the list of objects to, as JSON."""


@dataclasses.dataclass(frozen=True)
class ImportOptions:
    """Makes a library of mesh files (.obj, .stl, .ply, .glb), URDF or MJCF. Shapes that are not
    convex are split, in seconds to a minute. Unusable files are named and left out."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Files, and folders of them."""
    out: Path
    """Folder to write, which must not exist. Until all is done, OUT.partial keeps finished objects,
    and the same command resumes from there."""
    scale: float = 1.0
    """Metres per unit of the files: 0.001 for millimetres."""
    density: float = 600.0
    """Density of the objects, kg/m^3. Scenes vary it by the same factor as the default 600."""
    jobs: int = 0
    """Files at a time; 0 for one per core."""
    json: Path | None = None
    """File to write the list of objects to, as JSON."""


@dataclasses.dataclass(frozen=True)
class ShowOptions:
    """Lists the objects of a library, and draws them with --png."""

    library: tyro.conf.Positional[str]
    """The library: a folder, procedural:SEED:COUNT or procedural+assemblies:SEED:COUNT."""
    png: Path | None = None
    """File to write a contact sheet to, with names and sizes: .png, .jpg, .webp or .gif."""
    json: Path | None = None
    """File to write the list to, as JSON."""


def run(arguments: list[str]) -> int:
    """Runs one of the commands; returns the exit code."""
    commands = {"make": _make, "import": _import, "show": _show}
    return parsing.subcommand("objects", commands, arguments)


def _make(arguments: list[str]) -> int:
    options = parsing.parse(MakeOptions, arguments, "objects make")
    check_seed(options.seed)
    from csac_jax.objects import library, shapes

    most = library.MOST_OBJECTS
    require(1 <= options.count <= most, f"--count: must lie in 1 .. {most}")
    _check_new(options.out)
    draw = shapes.draw_mixed if options.mixed else shapes.draw
    made = library.save(options.out, draw(options.seed, options.count)).objects
    _list(made)
    print(f"wrote {options.out}")
    output.write_result(options.json, {"objects": [_row(member) for member in made]})
    return 0


def _import(arguments: list[str]) -> int:
    options = parsing.parse(ImportOptions, arguments, "objects import")
    _check_new(options.out)
    fits = 0.0 < options.scale < 1e6 and 0 <= options.jobs <= 1024
    require(fits, "--scale must be positive, --jobs lie in 0 .. 1024")
    from csac_jax.objects import body, conversion, importing, library

    least, most = body.DENSITIES
    known = f"must lie in {least:g} .. {most:g} kg/m^3"
    require(least <= options.density <= most, f"--density: {known}")
    for module in importing.MODULES:
        check_extra("objects import", module, "objects")
    paths = importing.files(list(options.paths))
    many = f"{len(paths)} files: at most {library.MOST_OBJECTS} at a time"
    require(len(paths) <= library.MOST_OBJECTS, many)
    jobs, cache = options.jobs or processes.cores(), Path(f"{options.out}.partial")
    settings = conversion.ImportSettings(options.scale, options.density)
    with output.progress() as bar:
        task = bar.add_task("splitting into convex parts", total=None)

        def on_progress(finished: int, total: int, name: str) -> None:
            bar.update(task, description=name, completed=finished, total=total)

        converted, refused = importing.run(paths, settings, jobs, cache, on_progress)
    for line in refused:
        print(f"{PROGRAM}: {line}", file=sys.stderr)
    if not converted:
        raise FailedError(f"none of {len(paths)} files can be imported; nothing is written")
    _list(library.save(options.out, [member for member, _ in converted]).objects)
    shutil.rmtree(cache, ignore_errors=True)
    for member, share in converted:
        if not importing.SOUND[0] <= share <= importing.SOUND[1]:
            print(f"{member.name}: its parts have {share:.2f} of its shapes' volume; check it")
    print(f"wrote {options.out}; {len(refused)} of {len(paths)} files left out")
    rows = [_row(member) | {"parts_volume": share} for member, share in converted]
    output.write_result(options.json, {"objects": rows, "refused": refused})
    return 0


def _check_new(folder: Path) -> None:
    require(not folder.exists(), f"--out: {folder} exists; give another name")


def _show(arguments: list[str]) -> int:
    options = parsing.parse(ShowOptions, arguments, "objects show")
    from csac_jax.objects import tables

    if options.png is not None:
        from csac_jax.render import media

        media.check_suffix(options.png, media.PICTURES)
    objects = tables.find(options.library, "all").objects
    _list(objects)
    if options.png is not None:
        from csac_jax.render import sheet

        sheet.write(options.png, objects)
        print(f"wrote {options.png}")
    output.write_result(options.json, {"objects": [_row(member) for member in objects]})
    return 0


def _row(member: Any) -> dict[str, Any]:
    return {
        "name": member.name,
        "size_mm": [round(1e3 * float(side), 1) for side in member.bounds[1] - member.bounds[0]],
        "narrowest_mm": round(1e3 * member.narrowest, 1),
        "mass_g": round(1e3 * member.density * member.volume, 1),
        "parts": len(member.parts),
        "split": "held_out" if member.held_out else "train",
    }


def _list(objects: Any) -> None:
    from rich.console import Console
    from rich.table import Column, Table

    from csac_jax import grippers
    from csac_jax.config import SimConfig

    rows = [_row(member) for member in objects]
    name = Column("object", overflow="fold")  # whole names, on narrow terminals too
    table = Table(name, "size, mm", "narrowest, mm", "mass, g", "parts", "split")
    for name, sides, narrowest, mass, *rest in map(dict.values, rows):
        size = " x ".join(f"{side:.0f}" for side in sides)
        table.add_row(name, size, f"{narrowest:.0f}", f"{mass:.0f}", *map(str, rest))
    Console(highlight=False).print(table)
    held_out = sum(row["split"] == "held_out" for row in rows)
    print(f"{len(rows)} objects, {held_out} of them held out")
    opening = 1e3 * grippers.load(SimConfig().gripper).opening[1]
    wide = [row["name"] for row in rows if row["narrowest_mm"] >= opening]
    if wide:
        print(f"wider than the hand opens, {opening:g} mm: {', '.join(wide)}")
