"""Command line -> dataclass, by tyro; a bad argument is one line."""

import argparse
import contextlib
import dataclasses
import difflib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import tyro

from csac_jax.algorithms import unknown
from csac_jax.config import SimConfig
from csac_jax.errors import SettingsError
from csac_jax.grippers import Gripper
from csac_jax.section import require

try:
    from tyro._errors import on_parse_error
except ImportError:  # another version: it prints the error in a box and exits with 2
    on_parse_error = contextlib.nullcontext  # type: ignore[assignment]

PROGRAM = "csac-jax"
Kind = TypeVar("Kind")
_OUTPUTS = ("json", "markdown", "png", "video")  # options that name a file to write
SHORT_HELP = {"-h", "--help"}


def parse(
    kind: type[Kind],
    arguments: Sequence[str],
    command: str,
    default: Any = tyro.MISSING_NONPROP,
    description: str | None = None,
) -> Kind:
    """Parses the arguments of a command as a `kind`; settings come with a `default`.

    Prints help and exits if it is asked for. Raises SettingsError for bad arguments.
    """
    prog = f"{PROGRAM} {command}"
    more = f"{prog} {'--help' if default is tyro.MISSING_NONPROP else '--help-all'}"

    def refuse(event: Any) -> None:
        if text := _message(event, kind):
            raise SettingsError(f"{text}; see {more}")

    args = ["--help"] if asks_help(arguments) else list(arguments)
    with on_parse_error(refuse), _registry():
        parsed = tyro.cli(kind, prog=prog, args=args, default=default, description=description)
    _check_outputs(vars(parsed))
    return parsed


def _check_outputs(options: dict[str, Any]) -> None:
    """Raises SettingsError for a file to write that cannot be written."""
    for name in _OUTPUTS:
        if isinstance(path := options.get(name), Path):
            require(not path.is_dir(), f"--{name}: {path} is a folder; give the name of a file")
            above = next(folder for folder in path.absolute().parents if folder.exists())
            writable = above.is_dir() and os.access(above, os.W_OK)
            require(writable, f"--{name}: {above} is no folder that you may write; give another")


def _message(event: Any, kind: Any) -> str | None:
    """Returns one line about tyro's error event, None for an event of an unknown kind."""
    argument = getattr(event, "argument", None)
    flag = f"{argument.display_name()}: " if argument is not None else ""
    match type(event).__name__:
        case "UnrecognizedArgs":
            near = difflib.get_close_matches(event.tokens[0].split("=")[0], _flags(kind), 1)
            meant = f"; perhaps you meant {near[0]}" if near else ""
            return f"unknown arguments: {' '.join(event.tokens)}{meant}"
        case "MissingArgs":
            missing = [one.arg.display_name() for one in event.missing_arguments]
            return f"these arguments are missing: {', '.join(missing)}"
        case "InvalidChoice":
            return f"{flag}'{event.value}' is not one of: {', '.join(event.choices)}"
        case "BadValue":
            return f"{flag}a value is missing"
        case "InstantiationFailure":
            return f"{flag}{event.message}"
    return None


def _flags(kind: Any, prefix: str = "--") -> list[str]:
    flags: list[str] = []
    for field in dataclasses.fields(kind):
        name = prefix + field.name.replace("_", "-")
        is_section = dataclasses.is_dataclass(field.type)
        flags += _flags(field.type, f"{name}.") if is_section else [name]
    return flags


@contextlib.contextmanager
def _registry() -> Iterator[None]:
    registry = tyro.constructors.ConstructorRegistry()

    @registry.primitive_rule
    def gripper(info: Any) -> Any:
        if info.type != SimConfig.__annotations__["gripper"]:
            return None
        return tyro.constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="NAME|DIR",
            instance_from_str=lambda given: given[0],
            is_instance=lambda value: isinstance(value, str | Gripper),
            str_from_instance=lambda value: [str(value)],
        )

    with registry:
        yield


def subcommand(
    group: str, commands: Mapping[str, Callable[[list[str]], int]], arguments: list[str]
) -> int:
    """Runs the command of a group that the arguments name; returns the exit code."""
    name, *rest = arguments or [""]
    if name in ("", *SHORT_HELP):
        known = ", ".join(commands)
        print(f"usage: {PROGRAM} {group} COMMAND ..., with COMMAND one of: {known}")
        return 0 if name else 2
    require(name in commands, f"{group}: {unknown('command', name, commands)}")
    return commands[name](rest)


def asks_help(arguments: Sequence[str]) -> bool:
    """Returns whether help is asked for, which comes before all else."""
    return not {*SHORT_HELP, "--help-all"}.isdisjoint(arguments)


def take(arguments: Sequence[str], option: str) -> tuple[str | None, list[str]]:
    """Returns the last value of an option that decides how the others are read, and the others."""
    values, rest = take_all(arguments, option)
    return values[-1] if values else None, rest


def take_all(arguments: Sequence[str], option: str) -> tuple[list[str | None], list[str]]:
    """Returns the values of an option that decides how the others are read, and the others."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(option, dest="values", nargs="?", action="append", default=[])
    parsed, rest = parser.parse_known_args(arguments)
    return parsed.values, rest
