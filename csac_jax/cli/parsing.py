"""Command line -> dataclass, by tyro, whose boxed complaints become one line."""

import argparse
import contextlib
import io
import os
import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, TypeVar

import tyro

from csac_jax.cli.failures import PROGRAM, BadArgumentsError
from csac_jax.config import SimConfig
from csac_jax.grippers import Gripper

Kind = TypeVar("Kind")
SHORT_HELP = {"-h", "--help"}


def parse(
    kind: type[Kind], arguments: list[str], command: str, default: Any = tyro.MISSING_NONPROP
) -> Kind:
    """`arguments` of `command` as a `kind`; settings come with a `default`. Prints help and exits
    if it is asked for. Raises BadArgumentsError for bad ones."""
    prog = f"{PROGRAM} {command}"
    if asks_help(arguments):
        with _registry():
            tyro.cli(kind, prog=prog, args=["--help"], default=default)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint), _wide_terminal(), _registry():
            return tyro.cli(kind, prog=prog, args=arguments, default=default)
    except SystemExit:
        help_flag = "--help" if default is tyro.MISSING_NONPROP else "--help-all"
        raise BadArgumentsError(_one_line(complaint.getvalue(), f"{prog} {help_flag}")) from None


def inherited(kind: Any, text: str) -> Any:
    """The type of a setting that is the policy's unless it is given, with its help."""
    return Annotated[kind, tyro.conf.arg(help=text, help_behavior_hint="(default: the policy's)")]


def _registry() -> tyro.constructors.ConstructorRegistry:
    """Adds to tyro that a gripper is given by its name or folder."""
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

    return registry


def asks_help(arguments: Sequence[str]) -> bool:
    """Whether help is asked for, which comes before all else."""
    return not {*SHORT_HELP, "--help-all"}.isdisjoint(arguments)


def take(arguments: Sequence[str], option: str) -> tuple[str | None, list[str]]:
    """The last value of an option, None without one, and all other arguments."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(option, dest="value", nargs="?")
    found, rest = parser.parse_known_args(arguments)
    return found.value, rest


@contextlib.contextmanager
def _wide_terminal() -> Iterator[None]:
    """Keeps tyro from breaking its messages into lines."""
    before = dict(os.environ)
    os.environ["COLUMNS"] = "1000"
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        os.environ.update(before)


def _one_line(box: str, help_command: str) -> str:
    """The message in tyro's box, between its first two rules, and its first suggestion."""
    plain = re.sub(r"\x1b\[[0-9;]*m|│", "", box)
    parts = re.split(r"(?m)^(?:[╭╰].*| *[─-]{3,} *)$", plain)
    message = " ".join(parts[1].split()).rstrip(".") if len(parts) > 1 else ""
    message = re.sub(r"^Error parsing [\w.]+: (?=[\w.]+: )", "", message)
    hint = re.search(r"Perhaps you meant:\s+(\S+)", plain)
    meant = f"; perhaps you meant {hint[1]}" if hint else ""
    return f"{message or 'the arguments cannot be read'}{meant}; see {help_command}"
