"""Recorded runs and evaluations as they lie in folders. Reads only; needs neither JAX nor an
accelerator.

A run is a `metrics.jsonl` with the `config.json` of its folder, or `NAME-metrics.jsonl` with the
config in a JSON file `NAME*.json` beside it. An evaluation is a file that `csac-jax eval --json`
wrote. What is neither is passed over.
"""

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csac_jax import algorithms, presets
from csac_jax.constants import RENAMED_SUITES
from csac_jax.io import configs, files

RECORD = "train.json"  # with device, versions and commit, in the folder of a run or of a sweep
SKIPPED = ("checkpoints", "tensorboard")
METRIC_NAMES = (
    "grasp_success",
    "completion",
    "completion_reachable",
    "action_efficiency",
    "action_efficiency_completed",
)
APART = (
    "seed",
    "preset",
    "algo",
    "sim.physics",
    "sim.robot",
)  # settings that are shown by themselves
HOST = ("train.chunk", "train.save_every")  # settings that no result depends on
SHAPE = "train."  # settings of a run's length and shape do not make it another method

Json = dict[str, Any]


class Variant(NamedTuple):
    """What runs that differ in nothing but their seed have in common."""

    preset: str
    algo: str
    changed: tuple[tuple[str, str], ...]  # settings away from the preset's, and their values

    @property
    def method(self) -> bool:
        """The algorithm as the preset has it, whatever the run's length."""
        return all(name.startswith(SHAPE) for name, _ in self.changed)


class Run(NamedTuple):
    """One training run."""

    path: Path
    config: Json
    actions: np.ndarray  # [n] over all scenes
    success: np.ndarray  # [n] share of the last `grasps` grasps that lifted a block
    grasps: np.ndarray  # [n] at most GRASP_WINDOW
    seconds: np.ndarray  # [n] spent training since the run began, without compilation
    record: Json  # device, versions, commit, wall_seconds if `train` wrote them


class Evaluation(NamedTuple):
    """One part of a suite, measured once."""

    path: Path
    config: Json
    policy: str
    suite: str
    part: str
    seed: int  # of the evaluation
    metrics: Json
    record: Json  # device, versions, commit, seconds


class Results(NamedTuple):
    """All that was found, and a line about each thing that is missing."""

    runs: list[Run]
    evaluations: list[Evaluation]
    notes: list[str]


def read(paths: Sequence[Path]) -> Results:
    """The runs and evaluations in these folders and files. Raises ValueError for a path that is
    none of both."""
    runs: dict[Path, Run] = {}
    evaluations: dict[Path, list[Evaluation]] = {}
    notes: list[str] = []
    for path in paths:
        found = 0
        for file in _files(path):
            if file.name.endswith(files.METRICS):
                run = _run(file, notes)
                runs |= {} if run is None else {file: run}
                found += run is not None
            else:
                several = _evaluations(file)
                evaluations |= {file: several} if several else {}
                found += len(several)
        if not found:
            notes.append(
                f"{path}: nothing is recorded there, neither {files.METRICS} nor a result of `eval --json`"
            )
    results = Results(
        list(runs.values()), [one for several in evaluations.values() for one in several], notes
    )
    notes.extend(_without_evaluation(results))
    return results


def _files(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path
        return
    if not path.is_dir():
        raise ValueError(
            f"there is no file or folder {path}; give folders of runs or files of `eval --json`"
        )
    for folder, names, contents in os.walk(path):
        names[:] = sorted(name for name in names if name not in SKIPPED)
        yield from (
            Path(folder) / name
            for name in sorted(contents)
            if name.endswith((files.METRICS, ".json"))
        )


def _json(path: Path) -> Json:
    """The object in a file; empty where it holds none."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _run(path: Path, notes: list[str]) -> Run | None:
    """The run of a log; None, with a note, where it has no config or no grasp yet."""
    config, record = _config_of(path)
    if not config:
        notes.append(
            f"{path}: no config beside it ({files.CONFIG}, or a JSON file of the same name); left out"
        )
        return None
    lines = [line for line in _lines(path) if line.get("grasp_success") is not None]
    if not lines:
        notes.append(f"{path}: no grasp is recorded yet; left out")
        return None
    actions, success, grasps, seconds = (
        np.array([line[name] for line in lines], float)
        for name in ("actions", "grasp_success", "grasps_counted", "seconds")
    )
    return Run(path, config, actions, success, grasps, seconds, record)


def _lines(path: Path) -> Iterator[Json]:
    """The lines of a log; one that was cut off while being written is left out."""
    for text in path.read_text().splitlines():
        try:
            line = json.loads(text)
        except ValueError:
            continue
        if isinstance(line, dict) and "actions" in line:
            yield line


def _config_of(path: Path) -> tuple[Json, Json]:
    """Config and record of the run that a log belongs to, each empty where there is none."""
    stem = path.name.removesuffix(files.METRICS).rstrip("-")
    beside = [_json(file) for file in sorted(path.parent.glob(f"{stem}*.json"))]
    trained = [content for content in beside if "config" in content and "wall_seconds" in content]
    record = trained[0] if trained else {}
    if not stem:
        own = _json(path.parent / files.CONFIG)
        return own, _record_of(path.parent, own)
    configs = [content["config"] for content in trained + beside if "config" in content]
    return (configs[0] if configs else {}), record


def _record_of(folder: Path, config: Json) -> Json:
    """What `train` or, two folders up, `sweep` wrote about the run of this folder; empty where
    neither did."""
    for place in (folder, *folder.resolve().parents[1:2]):
        record = _json(place / RECORD)
        if record and record.get("config", config) == config:
            return record
    return {}


def _evaluations(path: Path) -> list[Evaluation]:
    content = _json(path)
    if (
        "policy" not in content
        or not ("parts" in content or "grasp_success" in content)
        or "config" not in content
    ):
        return []
    suite: str = content.get("suite", "own")
    suite = RENAMED_SUITES.get(suite, suite)
    parts = content.get("parts") or {Path(suite).stem: content}
    record = {name: content.get(name) for name in ("device", "versions", "commit", "seconds")}
    return [
        Evaluation(
            path,
            content["config"],
            content["policy"],
            suite,
            part,
            content.get("seed", 0),
            metrics,
            record,
        )
        for part, metrics in parts.items()
    ]


def _without_evaluation(results: Results) -> Iterator[str]:
    measured = {_identity(one.config) for one in results.evaluations if one.policy == "learned"}
    for run in results.runs:
        if _identity(run.config) not in measured:
            folder = run.path.parent
            yield f"{run.path}: not evaluated; run: csac-jax eval {folder} --json {folder / 'eval.json'}"


def _identity(config: Json) -> str:
    """The config without what an evaluation may choose anew."""
    return json.dumps(
        {
            name: value
            for name, value in flat(config).items()
            if name not in ("sim.physics", "sim.robot")
        }
    )


def flat(config: Json, prefix: str = "") -> Json:
    """A config's settings by their dotted names."""
    found: Json = {}
    for name, value in config.items():
        found |= (
            flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
        )
    return found


def variant(config: Json) -> Variant:
    """What a recorded config is a variant of; settings that only one of both knows, then or now,
    are passed over."""
    preset, algo = (
        config.get("preset", ""),
        config.get("algo", "csac_beta"),
    )  # the first records name no algorithm
    try:
        base = flat(configs.to_dict(algorithms.configure(presets.get(preset), algo)))
    except ValueError:  # a name that is no more
        base = {}
    own = flat(config)
    changed = [
        name
        for name in own
        if name in base and own[name] != base[name] and name not in (*APART, *HOST)
    ]
    return Variant(preset, algo, tuple((name, _text(own[name])) for name in changed))


def _text(value: Any) -> str:
    """A setting's value as on the command line."""
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def command(one: Run | Evaluation) -> str:
    """The command that makes such a run or evaluation, from what its record says."""
    if isinstance(one, Evaluation):
        sim, counts = one.config["sim"], one.metrics.get("counts", {})
        run = f"eval RUN --policy {one.policy} --suite {one.suite} --episodes {counts.get('episodes')}"
        robot = sim.get("robot", "hand")
        return f"csac-jax {run} --seed {one.seed} --physics {sim.get('physics', 'mjx')} --robot {robot}"
    its = variant(one.config)
    flags = "".join(f" {_flag(name, value)}" for name, value in its.changed)
    physics = one.config.get("sim", {}).get("physics", "mjx")
    return f"csac-jax train {its.preset} --algo {its.algo} --seed {one.config['seed']} --sim.physics {physics}{flags}"


def _flag(name: str, value: str) -> str:
    section, _, field = name.replace("_", "-").rpartition(".")
    if value in ("True", "False"):
        return f"--{section}.{'' if value == 'True' else 'no-'}{field}"
    return f"--{section}.{field} {value}"
