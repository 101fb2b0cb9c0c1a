"""Writes the index of the recorded results, build/pages/records.md: `python -m experiments.index`.

A record says what it shows by its key `about`; an archive by the file about.json in it.
"""

import functools
import json
import re
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from csac_jax.io import files
from csac_jax.report import result_tables, results, variants
from csac_jax.report.results import Results

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "experiments" / "results"
STUDY = RESULTS / "study"
ABOUT = "about.json"
COMMANDS = (
    "Commands of benchmarks are those of the record's commit: settings and benchmarks may have had "
    "other names then. Commands of runs and evaluations are those of today, with the settings that "
    "have become constants."
)


@functools.cache
def contents(archive: Path) -> dict[str, bytes]:
    """Reads the files of an archive by name."""
    with tarfile.open(archive) as opened:
        return {one.name: opened.extractfile(one).read() for one in opened}  # type: ignore[union-attr]


def record(name: str) -> Any:
    """Reads a JSON record of a family of runs, such as `quick/csac_beta/seed-0/eval.json`."""
    family = name.partition("/")[0]
    return json.loads(contents(RESULTS / f"{family}{results.ARCHIVE}")[name])


def page() -> str:
    """Returns the index: a row per folder of runs and per benchmark."""
    rows = [*_folders(), *_benchmarks()]
    return f"# Recorded results\n\n{COMMANDS}\n\n{result_tables.table_text(rows)}\n"


def _folders() -> Iterator[dict[str, str]]:
    for archive in sorted(RESULTS.glob(f"*{results.ARCHIVE}")):
        recorded = results.read([archive])
        for folder, about in json.loads(contents(archive)[ABOUT]).items():
            found = _below(recorded, archive / folder)
            devices = [one.record.get("device") for one in (*found.runs, *found.evaluations)]
            device = next(filter(None, devices), "not recorded")
            yield _row(about, f"{archive.name}: {folder}", "; ".join(_commands(found)), device)
    for archive in sorted(RESULTS.glob(f"study/*{results.ARCHIVE}")):
        (about,) = json.loads(contents(archive)[ABOUT]).values()
        runs = sum(name.endswith(files.METRICS) for name in contents(archive))
        yield _row(about, f"study/{archive.name}", f"{runs:,} runs, see docs/study.md", "H200")


def _below(recorded: Results, folder: Path) -> Results:
    runs, evaluations = (
        [one for one in every if one.path.is_relative_to(folder)] for every in recorded[:2]
    )
    return Results(runs, evaluations, [])


def _commands(found: Results) -> list[str]:
    """Returns how the runs of a folder were trained, then evaluated."""
    commands = (variants.train_command(run.config) for run in found.runs)
    trained = {re.sub(r"--seed \d+", "--seed K", command) for command in commands}
    config = found.runs[0].config if found.runs else None
    measured = dict.fromkeys(one.command(config) for one in found.evaluations)
    return [f"`{command}`" for command in (*sorted(trained), *measured)]


def _benchmarks() -> Iterator[dict[str, str]]:
    for path in sorted(RESULTS.glob("bench/*.json")):
        for name, one in json.loads(path.read_text()).items():
            device = one.get("device", "not recorded")
            yield _row(one["about"], f"bench/{path.name}: {name}", f"`{one['command']}`", device)


def _row(about: str, place: str, command: str, device: str) -> dict[str, str]:
    return {"about": about, "record": place, "command": command, "device": device}


if __name__ == "__main__":
    files.replace(ROOT / "build" / "pages" / "records.md", page())
