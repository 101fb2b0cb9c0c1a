"""Files of a run, written so that they are never seen half-written. Needs no JAX.

RUN/config.json     the config, for people; the checkpoint holds its own copy
RUN/metrics.jsonl   one `loop.Record` per chunk
RUN/checkpoints/    see `checkpoint`
"""

import contextlib
import json
import os
from pathlib import Path
from typing import Any

from csac_jax.io import renames

CONFIG = "config.json"
METRICS = "metrics.jsonl"


def replace(path: Path, content: str | bytes) -> None:
    """Writes a file such that it appears all at once; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    with temporary.open("wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())  # else a power failure may leave it empty
    temporary.replace(path)


def write_json(path: Path, content: Any) -> None:
    """Writes a file of indented JSON; see `replace`."""
    replace(path, json.dumps(content, indent=2) + "\n")


def read_log(path: Path) -> list[dict[str, Any]]:
    """The lines of a metrics.jsonl by today's names, without one that was cut off in writing."""
    lines = []
    for line in path.read_text().splitlines():
        with contextlib.suppress(ValueError):
            lines.append(renamed(json.loads(line)))
    return lines


def renamed(content: Any) -> Any:
    """A line of a log, or an evaluation without its config, with today's names of metrics."""
    if not isinstance(content, dict):
        return content
    return {renames.METRICS.get(name, name): renamed(value) for name, value in content.items()}


def truncate_log(path: Path, step: int) -> None:
    """Keeps the lines of steps up to `step`."""
    lines = read_log(path) if path.exists() else []
    replace(path, "".join(json.dumps(line) + "\n" for line in lines if line["step"] <= step))
