"""Command line -> dataclass, by tyro, whose boxed complaints become one line."""

import contextlib
import io
import os
import re
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import tyro

from csac_jax.cli.failures import PROGRAM, BadArgumentsError

Arguments = TypeVar("Arguments")


def parse(
    kind: type[Arguments],
    arguments: Sequence[str],
    command: str,
    default: Any = tyro.MISSING_NONPROP,
    help_flag: str = "--help",
) -> Arguments:
    """`arguments` of `command` as a `kind`. Prints help and exits.

    Raises BadArgumentsError for bad ones; it points to the help that `help_flag` shows.
    """
    prog = f"{PROGRAM} {command}"
    if asks_help(arguments):
        tyro.cli(kind, prog=prog, args=["--help"], default=default)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint), _wide_terminal():
            return tyro.cli(kind, prog=prog, args=arguments, default=default)
    except SystemExit:
        raise BadArgumentsError(_one_line(complaint.getvalue(), f"{prog} {help_flag}")) from None
    except ValueError as error:  # a range check of the outermost dataclass
        raise BadArgumentsError(str(error)) from None


def asks_help(arguments: Sequence[str]) -> bool:
    """Whether help is asked for, which comes before all else."""
    return bool({"-h", "--help", "--help-all"} & set(arguments))


def asks_short_help(arguments: Sequence[str]) -> bool:
    """Whether the short help of a command with many settings is asked for."""
    return asks_help(arguments) and "--help-all" not in arguments


def value_of(flags: Sequence[str], name: str) -> str | None:
    """What follows the option `name` on the command line: some options decide the defaults of all
    the rest."""
    found = None
    for i, flag in enumerate(flags):
        if flag == name and i + 1 < len(flags):
            found = flags[i + 1]
        elif flag.startswith(f"{name}="):
            found = flag.removeprefix(f"{name}=")
    return found  # the last one, as the parser takes it


def without(arguments: Sequence[str], name: str) -> list[str]:
    """The arguments without the option `name` and its value."""
    kept, skip = [], False
    for word in arguments:
        if not skip and word != name and not word.startswith(f"{name}="):
            kept.append(word)
        skip = word == name
    return kept


@contextlib.contextmanager
def _wide_terminal() -> Iterator[None]:
    """Keeps tyro from breaking its messages into lines."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "1000"
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before


def _one_line(box: str, help_command: str) -> str:
    """The message in tyro's box of several lines, with its first suggestion."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", box)
    lines = [line.strip("│ ") for line in plain.splitlines() if not line.startswith(("╭", "╰"))]
    rules = [i for i, line in enumerate(lines) if re.fullmatch("[─-]{3,}", line)]
    if (
        "╭" not in plain and rules
    ):  # drawn without corners: the title stands on a line of its own, over a rule
        lines, rules = lines[rules[0] + 1 :], [i - rules[0] - 1 for i in rules[1:]]
    message = " ".join(lines[: rules[0] if rules else None]).strip().rstrip(".")
    message = re.sub(r"^Error parsing [\w.]+: (?=[\w.]+: )", "", message)
    hint = (
        lines[lines.index("Perhaps you meant:") + 1].split()[0]
        if "Perhaps you meant:" in lines
        else None
    )
    meant = f"; perhaps you meant {hint}" if hint else ""
    return f"{message or 'the arguments cannot be read'}{meant}; see {help_command}"
