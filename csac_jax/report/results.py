"""Recorded runs and evaluations, read from folders and archives without JAX.

A run is a folder with `metrics.jsonl` and `config.json`. An evaluation is a JSON file that
`csac-jax eval` wrote. A record is a file of experiments/results/bench. Other files are skipped.
"""

import contextlib
import dataclasses
import lzma
import os
import tarfile
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csac_jax import reading
from csac_jax.errors import FailedError, SettingsError
from csac_jax.io import files, renames, seal
from csac_jax.report import variants
from csac_jax.report.variants import Json, Variant
from csac_jax.section import require, shown

ARCHIVE = ".tar.xz"  # of folders of runs
SKIPPED = ("checkpoints", "tensorboard", "wandb", "best")
METRICS = {
    "grasp_success": "grasp success",
    "completion": "completion",
    "completion_reachable": "completion, reachable blocks",
    "action_efficiency": "blocks / actions",
    "action_efficiency_completed": "blocks / actions, completed episodes",
    "action_efficiency_grasps": "lifted / grasps, mean of episodes",
    "actions_per_episode": "actions / episode",
    "pushes_per_episode": "pushes / episode",
}
"""Metric -> its title in tables; `evaluation.metrics` defines them."""
TOTALS = ("pushes", "grasps", "lifted", "cleared", "terminated", "truncated")
"""Sums of a training log; `lifted` is one of `outcomes`."""

# What a record may hold: key -> the types of its value, or the shape of an object.
_TEXT: Any = str | None
_NUMBER: Any = int | float | None
_SHARE = {"value": _NUMBER, "low": _NUMBER, "high": _NUMBER, "n": int}
_CONFIG = {"preset": str, "algo": str, "seed": int, "sim": {"physics": str, "robot": str}}
_RECORD = {"device": _TEXT, "versions": dict | None, "commit": _TEXT, "wall_seconds": _NUMBER}
_RECORD |= {"modules": dict | None, "config": _CONFIG}
_COUNTS = dict.fromkeys(("episodes", "pushes", "grasps"), int)
_METRICS = {**dict.fromkeys((*METRICS, "declutter_rate"), _SHARE), "counts": _COUNTS}
_EVALUATION = {"policy": str, "suite": str, "seed": int, "config": _CONFIG, "parts": {}}
_EVALUATION |= {"name": str, "episodes": int, "sha256": str}


class RecordedRun(NamedTuple):
    """One training run."""

    path: Path  # of its log; inside an archive it begins with the archive's path
    config: Json
    variant: Variant
    actions: np.ndarray  # [n] over all scenes
    success: np.ndarray  # [n] share of the last `grasps` grasps that lifted a block
    grasps: np.ndarray  # [n] at most GRASP_WINDOW
    seconds: np.ndarray  # [n] of training, without compilation
    record: Json  # wall_seconds; device, versions and commit if `train` wrote them
    totals: dict[str, int]  # sums over the run, those of TOTALS that were recorded


class Evaluation(NamedTuple):
    """One part of a suite, measured once."""

    path: Path
    config: Json
    variant: Variant
    policy: str
    suite: str
    part: str
    seed: int  # of the evaluation
    metrics: Json
    record: Json  # wall_seconds, device, versions, commit, modules; None where not recorded

    def command(self, trained: Json | None = None) -> str:
        """Returns the command of this evaluation for a policy with the config `trained`."""
        episodes = self.metrics.get("counts", {}).get("episodes")
        asked = f"--policy {self.policy} --suite {self.suite} --episodes {episodes}"
        asked += f" --seed {self.seed}"
        return variants.eval_command(asked, self.config, trained or self.config)


class Results(NamedTuple):
    """All recorded runs and evaluations, and a line about each thing that is missing."""

    runs: list[RecordedRun]
    evaluations: list[Evaluation]
    notes: list[str]  # also a line about each benchmark's record
    suites: Sequence[Json] = ()  # evaluations with a digest, and those of records


def read(paths: Iterable[Path]) -> Results:
    """Reads folders, files and archives; of a folder also the archives that lie directly in it.
    Raises SettingsError for a path that is none of them, FailedError for an evaluation that does
    not fit its digest."""
    suites: list[Json] = []
    results = Results([], [], [], suites)
    for path in paths:
        archives = sorted(path.glob(f"*{ARCHIVE}")) if path.is_dir() else []
        before = len(results.runs) + len(results.evaluations) + len(suites)
        for source in (path, *archives):
            with _opened(source) as folder:
                for file in _files(folder):
                    _add(file, source / file.relative_to(folder), results, suites)
        if len(results.runs) + len(results.evaluations) + len(suites) == before:
            results.notes.append(f"{path}: holds no {files.METRICS} and no result of `eval --json`")
    results.notes.extend(_without_evaluation(results))
    return results


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Path]:
    """Yields the path, or for an archive a temporary folder with its files."""
    if not (path.name.endswith(ARCHIVE) and path.is_file()):
        yield path
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        try:
            with tarfile.open(path) as archive:
                for member in archive:
                    _unpack(archive, member, folder)
        except (OSError, EOFError, tarfile.TarError, lzma.LZMAError) as error:
            raise SettingsError(
                f"{path} is no archive of runs ({files.first_line(error)})"
            ) from None
        yield folder


def _unpack(archive: tarfile.TarFile, member: tarfile.TarInfo, folder: Path) -> None:
    """Writes a regular file of an archive; skips links and what would lie elsewhere."""
    place = (folder / member.name).resolve()
    sound = member.isreg() and member.size <= reading.LARGEST and place.is_relative_to(folder)
    if sound and (content := archive.extractfile(member)):
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content.read())


def _files(path: Path) -> Iterator[Path]:
    remedy = "give folders of runs or eval results"
    require(path.exists(), f"there is no file or folder {path}; {remedy}")
    if path.is_file():
        yield path
    for folder, names, contents in os.walk(path):
        names[:] = sorted(set(names) - set(SKIPPED))
        for name in sorted(contents):
            if name.endswith((files.METRICS, ".json")):
                yield Path(folder, name)


def _add(file: Path, path: Path, results: Results, suites: list[Json]) -> None:
    """Adds the content of a file under the name `path`, or a note that it is damaged."""
    try:
        if file.name == files.METRICS:
            _add_run(file, path, results)
            return
        content = files.parse(reading.read_bytes(file, files.LARGEST_JSON), "the file")
        found = _evaluations(content, file, path) if isinstance(content, dict) else []
        results.evaluations.extend(found)
        if found and seal.SHA256 in content:
            suites.append(_intact(content, path))
        elif not found and isinstance(content, dict):
            recorded = list(_recorded(content))
            suites.extend(recorded)
            abouts = {row["record"]: row["about"] for row in recorded}
            results.notes.extend(f"record {name}: {text}" for name, text in abouts.items() if text)
    except (OSError, ValueError) as error:
        results.notes.append(f"{path}: damaged ({files.first_line(error)}); left out")


def _read_json(path: Path) -> Json:
    """Reads the object in a file; empty where it holds none."""
    try:
        return files.read_object(path)
    except (OSError, ValueError):
        return {}


def _run_config(folder: Path) -> Json:
    """Reads the config of the run in a folder; empty where there is none."""
    config = _read_json(folder / files.CONFIG)
    _check(config, _CONFIG, files.CONFIG)
    return config


def _check(content: Any, shape: Json, name: str) -> None:
    """Raises SettingsError where an object has a key of `shape` with a value of another type."""
    if not isinstance(content, dict):
        raise ValueError(f"{name} is no object")
    for key, kind in shape.items():
        if isinstance(kind, dict):
            _check(content.get(key, {}), kind, key)
        elif key in content and not (isinstance(content[key], kind) and _is_small(content[key])):
            raise ValueError(f"{key} is {shown(content[key])}")


def _is_small(value: Any) -> bool:
    return not isinstance(value, int) or abs(value) < 2**53  # a larger one may be no float


def _add_run(file: Path, path: Path, results: Results) -> None:
    """Adds the run of a log, or a note where it has no config or no grasp yet."""
    config = renames.current(_run_config(file.parent))
    with warnings.catch_warnings(record=True) as damage:
        warnings.simplefilter("always")
        lines = files.read_log(file)
    results.notes.extend(str(warning.message).replace(str(file), str(path)) for warning in damage)
    grasped = [line for line in lines if line.get("grasp_success") is not None]
    if not (config and grasped):
        lacking = "no grasp is recorded yet" if config else f"no readable {files.CONFIG} next to it"
        results.notes.append(f"{path}: {lacking}; left out")
        return
    names = ("actions", "grasp_success", "grasps_counted", "seconds")
    columns = [np.array([line[name] for line in grasped], float) for name in names]
    record = {"wall_seconds": float(columns[-1][-1]), **training_record(file.parent, config)}
    fields = (path, config, _variant(file, path, config), *columns, record, _totals(lines))
    results.runs.append(RecordedRun._make(fields))


def _totals(lines: Sequence[Json]) -> dict[str, int]:
    """Sums those of TOTALS that every line has."""
    rows = [line | {"lifted": (line.get("outcomes") or {}).get("lifted")} for line in lines]
    names = [name for name in TOTALS if all(type(row.get(name)) is int for row in rows)]
    return {name: sum(row[name] for row in rows) for name in names}


def training_record(folder: Path, config: Json) -> Json:
    """Reads what `train` wrote in this folder, or `sweep` above a `seed-K`; empty without it or for
    another config."""
    above = Path(os.path.realpath(folder)).parents[:2] if folder.name.startswith("seed-") else ()
    for place in (folder, *above):
        record = _read_json(place / files.RECORD)
        _check(record, _RECORD, files.RECORD)
        stored = record.get("config", config)
        if record and isinstance(stored, dict) and renames.current(stored) == config:
            return record
    return {}


def _intact(content: Json, path: Path) -> Json:
    if not seal.is_intact(content):
        fault = "was changed after it was measured: its sha256 does not fit"
        raise FailedError(f"{path}: {fault}; measure it again or leave it out")
    return content


def _recorded(content: Json) -> Iterator[Json]:
    """Yields the evaluations in a benchmark's records, by their suites and parts, each with its
    record's name and what it is `about`."""
    for name, record in content.items():
        rows = record.get("results") if isinstance(record, dict) else None
        for row in rows if isinstance(rows, list) else ():
            if isinstance(row, dict) and row.keys() >= {"suite", "policy", "episodes", "seed"}:
                _check_part(row)
                about = " ".join(str(record.get("about", "")).split())
                named = {"record": name, **row} | {"record": name, "about": about}
                yield {**named, "parts": {row["part"]: row}} if "part" in row else named


def _evaluations(content: Json, file: Path, path: Path) -> list[Evaluation]:
    kinds = [{"policy", "config", name} for name in ("parts", "grasp_success")]
    if not any(kind <= content.keys() for kind in kinds):
        return []
    _check(content, _EVALUATION, "the file")
    suite = str(renames.METRICS.get(content.get("suite", "own"), content.get("suite")))
    parts = files.renamed(content.get("parts") or {Path(suite).stem: content})
    record = {name: content.get(name) for name in ("device", "versions", "commit", "modules")}
    record["wall_seconds"] = content.get("seconds")
    _check(record, _RECORD, "the file")
    for part in parts.values():
        _check_part(part)
    config = renames.current(content["config"])
    fields = path, config, _variant(file, path, config), content["policy"], suite
    return [
        Evaluation(*fields, name, content.get("seed", 0), _per_episode(part) | part, record)
        for name, part in parts.items()
    ]


def _check_part(part: Any) -> None:
    _check(part, _METRICS, "a part")
    shares = [part[name] for name in (*METRICS, "declutter_rate") if part.get(name)]
    if not all(_SHARE.keys() <= share.keys() for share in shares):
        raise ValueError("a share lacks its interval")


def _per_episode(metrics: Json) -> Json:
    """Computes actions and pushes per episode from counts, for older records without them."""
    counts = metrics.get("counts", {})
    if not (counts.keys() >= _COUNTS.keys() and counts["episodes"] > 0):
        return {}
    n, pushes = counts["episodes"], counts["pushes"]
    sums = {"actions_per_episode": pushes + counts["grasps"], "pushes_per_episode": pushes}
    return {name: {"value": s / n, "low": None, "high": None, "n": n} for name, s in sums.items()}


def _without_evaluation(results: Results) -> Iterator[str]:
    """Yields a line for each run that still has its networks and was not evaluated."""
    learned = [one for one in results.evaluations if one.policy == "learned"]
    measured = {(one.variant, one.config.get("seed")) for one in learned}
    for run in results.runs:
        folder, run_key = run.path.parent, (run.variant, run.config.get("seed"))
        if (folder / "checkpoints").exists() and run_key not in measured:
            yield f"{folder}: not evaluated; run: csac-jax eval {folder} --json {folder}/eval.json"


def _variant(file: Path, path: Path, config: Json) -> Variant:
    """Builds the variant of a file. Its source is the folder; of several seeds, the one above. An
    evaluation's source also names its file. Its robot is that of the run."""
    folder = Path(os.path.realpath(path)).parent
    source = folder.parent.name if folder.name.startswith("seed-") else folder.name
    if path.name != files.METRICS:
        _, robot = variants.world(_run_config(file.parent))
        config = {**config, "sim": {**config.get("sim", {}), "robot": robot}}
        source = f"{source}, {path.stem}"
    return dataclasses.replace(variants.variant(config), source=source)
