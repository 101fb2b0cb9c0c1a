"""`csac-jax objects make|import|show`: libraries of objects."""

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from csac_jax.algorithms import unknown
from csac_jax.cli import output, parsing
from csac_jax.cli.failures import PROGRAM, BadArgumentsError, check_seed


@dataclasses.dataclass(frozen=True)
class MakeOptions:
    """Makes a library of our own shapes, at random; it needs no file of anybody's."""

    out: Path
    """Folder to write, which must not exist."""
    seed: int = 0
    """Number that the shapes follow from."""
    count: int = 200
    """Objects, family by family in turn."""
    json: Path | None = None
    """File to write the list of objects to, as JSON."""


@dataclasses.dataclass(frozen=True)
class ShowOptions:
    """Lists the objects of a library; draws them if asked to."""

    library: tyro.conf.Positional[str]
    """The library: a folder, or made:SEED:COUNT."""
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
    made = library.save(options.out, families.draw(options.seed, options.count))
    _list(made.objects)
    print(f"wrote {options.out}")
    output.write_result(options.json, {"objects": [_row(one) for one in made.objects]})
    return 0


def _check_new(folder: Path) -> None:
    if folder.exists():
        raise BadArgumentsError(f"--out: {folder} exists; give another name")


def _show(arguments: list[str]) -> int:
    options = parsing.parse(ShowOptions, arguments, "objects show")
    from csac_jax.objects import tables

    if options.png is not None:
        from csac_jax.cli.failures import as_bad_arguments
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
    from csac_jax.objects import library

    size = one.bounds[1] - one.bounds[0]
    return {
        "name": one.name,
        "size_mm": [round(1e3 * float(side), 1) for side in size],
        "narrowest_mm": round(1e3 * one.narrowest, 1),
        "mass_g": round(1e3 * library.DENSITY * one.volume, 1),
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
    from csac_jax.constants import MAX_OPENING

    wide = [row["name"] for row in rows if row["narrowest_mm"] >= 1e3 * MAX_OPENING]
    if wide:
        print(f"wider than the hand opens, {1e3 * MAX_OPENING:g} mm: {', '.join(wide)}")


COMMANDS = {"make": _make, "show": _show}
