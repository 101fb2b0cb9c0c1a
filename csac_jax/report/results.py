"""Recorded runs and evaluations, read from folders and archives. Needs neither JAX nor an
accelerator.

A run is a folder with `metrics.jsonl` and `config.json`. An evaluation is a JSON file that
`csac-jax eval --json` wrote. Other files are passed over.
"""

import contextlib
import dataclasses
import functools
import json
import lzma
import os
import tarfile
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csac_jax import algorithms, presets
from csac_jax.config import shown
from csac_jax.io import configs, files, renames

ARCHIVE = ".tar.xz"  # of folders of runs: hundreds of logs are alike, so it is small
RECORD = "train.json"  # device, versions and commit: in the folder of a run or above it
SKIPPED = ("checkpoints", "tensorboard", "wandb", "best")
NAMED = ("seed", "preset", "algo", "sim.physics")  # shown by themselves
HOST = ("format", "train.chunk", "train.save_every")  # settings that no result depends on
# What may be another in an evaluation.
VIEW = ("camera.", "sensor.", "heightmap.view", "sim.gripper", "sim.clearance")
_MOST = 6  # changes that name a variant
LENGTH = "train."  # settings of a run's length and shape do not make it another method
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
"""Sums of a training's log; of `outcomes` the lifts."""

Json = dict[str, Any]

_TEXT: Any = (str, type(None))
_NUMBER: Any = (int, float, type(None))
_SHARE = {"value": _NUMBER, "low": _NUMBER, "high": _NUMBER, "n": int}
_CONFIG = {"preset": str, "algo": str, "seed": int, "sim": {"physics": str, "robot": str}}
_RECORD = {"device": _TEXT, "versions": (dict, type(None)), "commit": _TEXT}
_RECORD |= {"wall_seconds": _NUMBER}
_COUNTS = dict.fromkeys(("episodes", "pushes", "grasps"), int)
_METRICS = {**dict.fromkeys(METRICS, _SHARE), "counts": _COUNTS, "failures": {}}
_EVALUATION = {"policy": str, "suite": str, "seed": int, "seconds": _NUMBER, "parts": {}}


@dataclasses.dataclass(frozen=True, order=True)
class Variant:
    """What runs have in common that differ in their seed alone."""

    preset: str
    algo: str
    changed: tuple[tuple[str, str], ...]  # settings that differ from the preset's, and their values
    source: str = dataclasses.field(default="", compare=False)  # name of the folder or file

    @property
    def is_long(self) -> bool:
        """There are too many changes to name a variant by: it is named by its source."""
        return len(self.changed) > _MOST and bool(self.source)

    @property
    def unchanged(self) -> bool:
        """The algorithm as the preset has it, whatever the run's length."""
        return all(name.startswith(LENGTH) for name, _ in self.changed)


class RecordedRun(NamedTuple):
    """One training run."""

    path: Path
    config: Json
    variant: Variant
    actions: np.ndarray  # [n] over all scenes
    success: np.ndarray  # [n] share of the last `grasps` grasps that lifted a block
    grasps: np.ndarray  # [n] at most GRASP_WINDOW
    seconds: np.ndarray  # [n] spent training since the run began, without compilation
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
    record: Json  # wall_seconds, device, versions, commit; None where not recorded


class Results(NamedTuple):
    """All that was found, and a line about each thing that is missing."""

    runs: list[RecordedRun]
    evaluations: list[Evaluation]
    notes: list[str]


def read(paths: Sequence[Path]) -> Results:
    """The runs and evaluations in folders, files and archives; an archive inside a folder is passed
    over. Raises ValueError for a path that is none of them."""
    results = Results([], [], [])
    for path in paths:
        before = len(results.runs) + len(results.evaluations)
        with _opened(path) as folder:
            for file in _files(folder):
                _add(file, results)
        if len(results.runs) + len(results.evaluations) == before:
            results.notes.append(f"{path}: holds no {files.METRICS} and no result of `eval --json`")
    results.notes.extend(_without_evaluation(results))
    return results


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Path]:
    """The path, or a folder that holds what an archive does, for as long as it is read."""
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
            raise ValueError(f"{path} is no archive of runs ({files.first_line(error)})") from None
        yield folder


def _unpack(archive: tarfile.TarFile, member: tarfile.TarInfo, folder: Path) -> None:
    """Writes a file of an archive; passes over what is none and what would lie elsewhere."""
    place = (folder / member.name).resolve()
    sound = member.isreg() and member.size <= files.LARGEST
    content = archive.extractfile(member) if sound else None
    if content is not None and place.is_relative_to(folder):
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content.read())


def _add(path: Path, results: Results) -> None:
    """Adds what a file holds, or a note that it is damaged."""
    try:
        if path.name == files.METRICS:
            _add_run(path, results)
        else:
            results.evaluations.extend(_evaluations(path))
    except (OSError, ValueError) as error:
        results.notes.append(f"{path}: damaged ({files.first_line(error)}); left out")


def _files(path: Path) -> Iterator[Path]:
    if not path.exists():
        raise ValueError(f"there is no file or folder {path}; give folders of runs or eval results")
    if path.is_file():
        yield path
    for folder, names, contents in os.walk(path):
        names[:] = sorted(set(names) - set(SKIPPED))
        kept = (name for name in sorted(contents) if name.endswith((files.METRICS, ".json")))
        yield from (Path(folder, name) for name in kept)


def _read_json(path: Path) -> Json:
    """The object in a file; empty where it holds none."""
    with contextlib.suppress(OSError, ValueError):
        return files.read_object(path)
    return {}


def _check(content: Any, shape: Json, name: str) -> None:
    """Raises ValueError where an object has these items, but of other kinds."""
    if not isinstance(content, dict):
        raise ValueError(f"{name} is no object")
    for key, kind in shape.items():
        if isinstance(kind, dict):
            _check(content.get(key, {}), kind, key)
        elif key in content and not (isinstance(content[key], kind) and _is_small(content[key])):
            raise ValueError(f"{key} is {shown(content[key])}")


def _is_small(value: Any) -> bool:
    return not isinstance(value, int) or abs(value) < 2**53  # beyond, it may be no float


def _add_run(path: Path, results: Results) -> None:
    """Adds the run of a log; a note where it has no config or no grasp yet."""
    config = _read_json(path.parent / files.CONFIG)
    _check(config, _CONFIG, files.CONFIG)
    with warnings.catch_warnings(record=True) as damage:
        warnings.simplefilter("always")
        every = files.read_log(path)
    results.notes.extend(str(warning.message) for warning in damage)
    lines = [line for line in every if line.get("grasp_success") is not None]
    if not config:
        results.notes.append(f"{path}: no readable {files.CONFIG} in its folder; left out")
    elif not lines:
        results.notes.append(f"{path}: no grasp is recorded yet; left out")
    else:
        names = ("actions", "grasp_success", "grasps_counted", "seconds")
        columns = [np.array([line[name] for line in lines], float) for name in names]
        record = {"wall_seconds": float(columns[-1][-1]), **_record(path.parent, config)}
        fields = (path, config, _variant(path, config), *columns, record, _totals(every))
        results.runs.append(RecordedRun._make(fields))


def _totals(lines: Sequence[Json]) -> dict[str, int]:
    """What all lines together count: of TOTALS what every line has."""
    rows = [line | {"lifted": (line.get("outcomes") or {}).get("lifted")} for line in lines]
    kept = [name for name in TOTALS if all(type(row.get(name)) is int for row in rows)]
    return {name: sum(row[name] for row in rows) for name in kept}


def _record(folder: Path, config: Json) -> Json:
    """What `train` wrote in this folder, or `sweep` above a `seed-K`; empty where neither did."""
    above = folder.resolve().parents[:2] if folder.name.startswith("seed-") else ()
    for place in (folder, *above):
        record = _read_json(place / RECORD)
        _check(record, _RECORD, RECORD)
        if record and record.get("config", config) == config:
            return record
    return {}


def _evaluations(path: Path) -> list[Evaluation]:
    content = files.parse(files.read_bytes(path), "the file")
    kinds = [{"policy", "config", name} for name in ("parts", "grasp_success")]
    if not isinstance(content, dict) or not any(kind <= content.keys() for kind in kinds):
        return []
    _check(content, _EVALUATION, "the file")
    suite = str(renames.METRICS.get(content.get("suite", "own"), content.get("suite")))
    parts = files.renamed(content.get("parts") or {Path(suite).stem: content})
    record = {name: content.get(name) for name in ("device", "versions", "commit")}
    record["wall_seconds"] = content.get("seconds")
    _check(content["config"], _CONFIG, "config")
    _check(record, _RECORD, "the file")
    for one in parts.values():
        _check(one, _METRICS, "a part")
        shares = [one[name] for name in METRICS if one.get(name)]
        for share in [*shares, *one.get("failures", {}).values()]:
            _check(share, _SHARE, "a share")
            if not _SHARE.keys() <= share.keys():
                raise ValueError("a share lacks its interval")
    config, policy, seed = content["config"], content["policy"], content.get("seed", 0)
    asked = path, config, _variant(path, config), policy, suite
    return [
        Evaluation(*asked, part, seed, _per_episode(found) | found, record)
        for part, found in parts.items()
    ]


def _per_episode(metrics: Json) -> Json:
    """Actions and pushes per episode by the counts alone, without intervals: older records have
    nothing else."""
    counts = metrics.get("counts", {})
    if not (counts.keys() >= _COUNTS.keys() and counts["episodes"] > 0):
        return {}
    n, pushes = counts["episodes"], counts["pushes"]
    sums = {"actions_per_episode": pushes + counts["grasps"], "pushes_per_episode": pushes}
    return {name: {"value": s / n, "low": None, "high": None, "n": n} for name, s in sums.items()}


def _without_evaluation(results: Results) -> Iterator[str]:
    """A line for each run that still has its networks and that nothing has measured."""
    learned = [one for one in results.evaluations if one.policy == "learned"]
    measured = {(one.variant, one.config.get("seed")) for one in learned}
    for run in results.runs:
        folder, own = run.path.parent, (run.variant, run.config.get("seed"))
        if (folder / "checkpoints").exists() and own not in measured:
            yield f"{folder}: not evaluated; run: csac-jax eval {folder} --json {folder}/eval.json"


def _variant(path: Path, config: Json) -> Variant:
    """The variant of a file of a run's folder: by name the folder, of several seeds the one above,
    and the file where it is an evaluation, which may be with another robot than the run's."""
    folder = path.resolve().parent
    if path.name != files.METRICS:
        _, robot = world(_read_json(folder / files.CONFIG))
        config = {**config, "sim": {**config.get("sim", {}), "robot": robot}}
    name = folder.parent.name if folder.name.startswith("seed-") else folder.name
    source = name if path.name == files.METRICS else f"{name}, {path.stem}"
    return dataclasses.replace(variant(config), source=source)


def variant(config: Json) -> Variant:
    """What a recorded config is a variant of. Settings that the config lacks are passed over."""
    config = renames.current(config)
    preset, algo = config.get("preset", ""), config.get("algo", "csac_beta")
    base: Json = {}
    with contextlib.suppress(ValueError):  # a name that is no more
        base = _preset_settings(preset, algo)
    settings = configs.flat(config)
    with contextlib.suppress(ValueError):  # written by a version that knew other settings
        settings = _settings(json.dumps({**config, "seed": 0}))
    changed = tuple(
        (name, _text(value))
        for name, value in settings.items()
        if value != base.get(name, value) and name not in (*NAMED, *HOST)
    )
    return Variant(preset, algo, changed)


@functools.cache
def _preset_settings(preset: str, algo: str) -> Json:
    """Settings by their dotted names. Raises ValueError if one of the names is unknown."""
    cfg = presets.get(preset)
    if algo in algorithms.ALGORITHMS:  # one that is gone is described by its settings
        cfg = algorithms.configure(cfg, algo)
    return configs.flat(configs.to_dict(cfg))


@functools.lru_cache(maxsize=64)  # ours: a folder's runs mostly differ in their seed
def _settings(text: str) -> Json:
    """Those of a recorded config. Raises ValueError if they are not of this version."""
    return configs.flat(configs.to_dict(configs.from_dict(json.loads(text))))


def world(config: Json) -> tuple[str, str]:
    """Physics and robot of a config; the first records name neither."""
    sim = config.get("sim", {})
    return sim.get("physics", "mjx"), sim.get("robot", "hand")


def command(one: RecordedRun | Evaluation, trained: Json | None = None) -> str:
    """The command that makes such a run or evaluation, from what its record says; of a policy of
    the config `trained`, with the view and the objects that it was given in place of its own."""
    physics, robot = world(one.config)
    if isinstance(one, Evaluation):
        episodes = one.metrics.get("counts", {}).get("episodes")
        asked = f"--policy {one.policy} --suite {one.suite} --episodes {episodes} --seed {one.seed}"
        both = one.config, trained or one.config
        options = _objects(*both) + _decision(*both) + _flags(_view(*both))
        return f"csac-jax eval RUN {asked} --physics {physics} --robot {robot}{options}"
    variant = one.variant
    flags = _flags(variant.changed)
    seed = f"--seed {one.config.get('seed', 0)} --sim.physics {physics}"
    return f"csac-jax train {variant.preset} --algo {variant.algo} {seed}{flags}"


def _objects(config: Json, trained: Json) -> str:
    """Options of `eval` for a library other than `trained`'s and a split other than its default."""
    library, split = (config.get("scene", {}).get(name, "") for name in ("objects", "split"))
    if not library:
        return ""
    asked = "" if library == trained.get("scene", {}).get("objects") else f" --objects {library}"
    return asked if split == "held_out" else f"{asked} --split {split}"


def _decision(config: Json, trained: Json) -> str:
    """Options of `eval` for settings of `policy` other than `trained`'s; older files have none."""
    asked, own = (one.get("policy", {}) for one in (config, trained))
    options = ""
    if (mirrored := asked.get("augment", False)) != own.get("augment", False):
        options += f" --augment {'on' if mirrored else 'off'}"
    for name in ("height_bonus", "retry"):
        if (value := asked.get(name, 0.0)) != own.get(name, 0.0):
            options += f" --{name.replace('_', '-')} {value}"
    return options


def _view(config: Json, trained: Json) -> Iterator[tuple[str, str]]:
    """Names and texts of a config's settings of VIEW that are other than `trained`'s."""
    own = configs.flat(trained)
    for name, value in configs.flat(config).items():
        if name.startswith(VIEW) and value != own.get(name, value):
            yield name, _text(value)


def _text(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _flags(settings: Iterable[tuple[str, str]]) -> str:
    return "".join(f" {_flag(name, value)}" for name, value in settings)


def _flag(name: str, value: str) -> str:
    section, _, field = name.replace("_", "-").rpartition(".")
    switch = {"True": field, "False": f"no-{field}"}.get(value)
    return f"--{section}.{switch}" if switch else f"--{section}.{field} {value}"
