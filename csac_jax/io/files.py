"""Files of a run; each appears whole or not at all. Needs no JAX.

RUN/config.json     the config, for people; the checkpoint holds its own copy
RUN/metrics.jsonl   one `callbacks.Record` per chunk
RUN/checkpoints/    see `checkpoint`
RUN/best/, RUN/evaluations.jsonl    see `evaluation.monitor`
"""

import contextlib
import json
import os
import secrets
import sys
import time
import warnings
from pathlib import Path
from typing import Any

from csac_jax.errors import DataWarning, FailedError
from csac_jax.io import renames
from csac_jax.reading import read_bytes

CONFIG = "config.json"
METRICS = "metrics.jsonl"
RECORD = "train.json"  # device, versions and commit: in the folder of a run, or of its sweep
EVALUATIONS = "evaluations.jsonl"
SWEEP_PLAN = "sweep.json"
BEST = "best"
LARGEST_JSON = 2**27  # bytes of a file of one JSON value, whose objects take ten times as much
_LONGEST_LINE = 2**22  # bytes of a line of a log
STALE = 3600.0  # s without a change, after which a draft is that of a killed process
_DRAFT = ".csac-jax-{}.tmp"  # of a random number: two processes never share a draft


class LinkError(FailedError):
    """A path of a run or sweep that is a link."""


def inside(folder: Path, *names: str | Path) -> Path:
    """Returns a path below the folder of a run or sweep, which itself may be a link.

    Raises LinkError if there is a link below the folder.
    """
    path = folder
    for part in Path(*names).parts:
        path = path / part
        if part == ".." or path.is_symlink():
            raise LinkError(f"{path} is a link; put a folder or file of the run in its place")
    return path


def replace(path: Path, content: str | bytes) -> None:
    """Writes a file at once, or raises OSError and leaves nothing. Creates its folder.

    A link in its place is replaced and its target stays.
    """
    if isinstance(content, str):
        content = content.encode(errors="backslashreplace")  # names that are no UTF-8
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(_DRAFT.format(secrets.token_hex(8)))
    try:
        with draft.open("xb") as file:  # x follows no link
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # else a power failure may leave it empty
        draft.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            draft.unlink(missing_ok=True)
        raise


def append(path: Path, line: str) -> None:
    """Adds a line to a log. Raises OSError where the log is a link."""

    def opener(name: str, flags: int) -> int:
        return os.open(name, flags | os.O_NOFOLLOW, 0o666)

    with open(path, "a", opener=opener) as log:
        log.write(f"{line}\n")


def remove_drafts(folder: Path) -> None:
    """Removes drafts that killed processes left in a folder, once they are STALE."""
    for draft in folder.glob(_DRAFT.format("*")):
        with contextlib.suppress(OSError):
            if time.time() - draft.lstat().st_mtime > STALE:
                draft.unlink()


def sync_folder(folder: Path) -> None:
    """Waits until the names in a folder survive a power failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_json(path: Path, content: Any) -> None:
    """Writes a file of indented JSON; see `replace`."""
    replace(path, json.dumps(content, indent=2) + "\n")


def read_object(path: Path) -> dict[str, Any]:
    """Returns the JSON object of a file. Raises ValueError for other content, OSError."""
    content = parse(read_bytes(path, LARGEST_JSON), path.name)
    if not isinstance(content, dict):
        raise ValueError(f"{path.name} holds no JSON object")
    return content


def parse(text: str | bytes, name: str) -> Any:
    """Returns the content of JSON text. Raises ValueError, also for too deep nesting."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError(f"{name} is not readable JSON") from None


def first_line(error: BaseException) -> str:
    """Returns the first line of an error's message, without the rest of a trace."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:300]


def read_log(path: Path) -> list[dict[str, Any]]:
    """Returns the lines of a metrics.jsonl with the names of today. Warns of damaged lines.

    The last line may have been cut off in writing, which is no damage.
    """
    *lines, last = read_bytes(path).split(b"\n")
    records = [_record(line) for line in lines]
    if damaged := records.count(None):
        text = f"{path}: {damaged} of {len(lines)} lines are damaged and left out"
        warnings.warn(text, DataWarning, stacklevel=2)
    return [record for record in [*records, _record(last)] if record is not None]


def _record(line: bytes) -> dict[str, Any] | None:
    """Returns a line of a log, None if it is damaged or lacks a required number."""
    if len(line) > _LONGEST_LINE:
        return None
    try:
        record = renamed(parse(line, "line"))
    except (ValueError, RecursionError):
        return None
    if not isinstance(record, dict):
        return None
    numbers = [record.get(name) for name in ("step", "actions", "grasps_counted", "seconds")]
    success = record.get("grasp_success")
    numbers += [] if success is None else [success]  # None: no grasp yet
    return record if all(map(_is_number, numbers)) else None


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= sys.float_info.max


def renamed(content: Any) -> Any:
    """Renames the metrics of a line of a log, or of an evaluation without its config."""
    if not isinstance(content, dict):
        return content
    return {renames.METRICS.get(name, name): renamed(value) for name, value in content.items()}


def truncate_log(path: Path, step: int) -> None:
    """Keeps the lines of steps up to `step`; a log with damaged lines stays as a copy."""
    with warnings.catch_warnings(record=True) as damage:
        warnings.simplefilter("always")
        lines = read_log(path) if path.exists() else []
    for warning in damage:
        copy = path.with_suffix(".damaged.jsonl")
        replace(copy, path.read_bytes())
        warnings.warn(
            f"{warning.message}; the whole file is kept as {copy.name}", DataWarning, stacklevel=2
        )
    replace(path, "".join(json.dumps(line) + "\n" for line in lines if line["step"] <= step))
