"""What commands write: lines that a closed pipe cannot stop, JSON with its provenance."""

import contextlib
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
    """A stream that falls silent once `head`, which reads it, has had enough, or a disc is full."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        return self._tried(lambda: self._stream.write(text)) or len(text)

    def flush(self) -> None:
        self._tried(self._stream.flush)

    def _tried(self, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _nowhere(number: int) -> TextIO:
    """A stream in place of stdout or stderr that the process began without. It takes their number,
    else the next file that is opened would get what libraries print."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), number)
    return open(number, "w", closefd=False)


@contextlib.contextmanager
def unbroken() -> Iterator[None]:
    """In the block a closed pipe silences stdout or stderr, and the work goes on."""
    sys.stdout, sys.stderr = sys.stdout or _nowhere(1), sys.stderr or _nowhere(2)
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(BrokenPipeGuard, before)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before


def progress() -> "Progress":
    """Lines on the terminal of what is in work and how far it is; nothing elsewhere."""
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
