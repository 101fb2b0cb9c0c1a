"""Output of commands: lines that a closed pipe cannot stop, JSON with its provenance."""

import contextlib
import io
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from csac_jax.config import Config
from csac_jax.io import files

if TYPE_CHECKING:
    from rich.progress import Progress


class BrokenPipeGuard:
    """A stream that ignores a closed pipe, as of `head`, and a full disc."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        return self._attempt(lambda: self._stream.write(text)) or len(text)

    def flush(self) -> None:
        self._attempt(self._stream.flush)

    def _attempt(self, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _null_stream(number: int) -> TextIO:
    """Opens a stream in place of a missing stdout or stderr, with its number.

    Otherwise the next opened file would receive what libraries print.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), number)
    return open(number, "w", closefd=False)


@contextlib.contextmanager
def unbroken() -> Iterator[None]:
    """Lets the work in the block continue if stdout or stderr is closed."""
    sys.stdout, sys.stderr = sys.stdout or _null_stream(1), sys.stderr or _null_stream(2)
    before = sys.stdout, sys.stderr
    for stream in before:
        if isinstance(stream, io.TextIOWrapper):  # what it cannot encode appears with escapes
            stream.reconfigure(errors="backslashreplace")
    sys.stdout, sys.stderr = map(BrokenPipeGuard, before)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before


def progress() -> "Progress":
    """Returns a progress display for terminals; it prints nothing elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

    console = Console(stderr=True)
    columns = ("{task.description}", BarColumn(20), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def write_result(path: Path | None, result: dict[str, Any], cfg: Config | None = None) -> None:
    """Writes a result with its config and provenance, if there is a path."""
    if path is None:
        return
    from csac_jax.io import configs
    from csac_jax.runtime import provenance

    config = {} if cfg is None else {"config": configs.to_dict(cfg)}
    files.write_json(path, {**result, **config, **provenance.record()})
