"""How a command ends badly: one line on stderr and an exit code."""

import contextlib
import sys
from collections.abc import Iterator

PROGRAM = "csac-jax"


class BadArgumentsError(Exception):
    """What was asked for cannot be done; exit code 2. The message is one line with the remedy."""


class FailedError(Exception):
    """What was asked for has failed; exit code 1. The message is one line with the remedy."""


@contextlib.contextmanager
def as_bad_arguments(*kinds: type[Exception]) -> Iterator[None]:
    """Errors of these kinds in the block are BadArgumentsErrors of the same message."""
    try:
        yield
    except kinds as error:
        raise BadArgumentsError(str(error)) from None


@contextlib.contextmanager
def as_failure(*kinds: type[Exception]) -> Iterator[None]:
    """Errors of these kinds in the block are FailedErrors of the same message."""
    try:
        yield
    except kinds as error:
        raise FailedError(str(error)) from None


def complain(code: int, error: object) -> int:
    """Prints the one line; returns the exit code."""
    print(f"{PROGRAM}: {' '.join(str(error).split())}", file=sys.stderr)
    return code
