"""The host's loop of a sweep: its groups in turn, all runs of a group in one program.

SWEEP/sweep.json                the plan; a sweep is resumed from it
SWEEP/summary.json              grasp success of every point over its seeds, and of every run
SWEEP/POINT/seed-K/             a run of one point with one seed, laid out like one of `train`
SWEEP/POINT/seed-K/eval.json    evaluation of its final policy, where the plan has `episodes`
SWEEP/groups/I/checkpoints/     the state of all runs of group I, until they are done
SWEEP/groups/I/done             their checkpoints are written

A run whose loss is not finite ends; the others continue.
"""

import contextlib
import dataclasses
import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from csac_jax.config import Config
from csac_jax.errors import FailedError, SettingsError
from csac_jax.evaluation import statistics
from csac_jax.evaluation.metrics import NO_CASES
from csac_jax.io import checkpoint, configs, files, lock, renames
from csac_jax.runtime import cluster
from csac_jax.runtime.signals import Stop
from csac_jax.section import require, shown
from csac_jax.sweeps import grid
from csac_jax.sweeps.replicas import ProgramGroup, SweepProgram, group_configs
from csac_jax.training import loop, memory
from csac_jax.training.callbacks import Record
from csac_jax.training.progress import Terminal

SUMMARY = "summary.json"
DIGEST = "sha256"  # key of the plan's own digest
GROUPS = "groups"
RESERVED = (GROUPS, files.SWEEP_PLAN, SUMMARY, "train.json")  # in the sweep's folder
_NAME = re.compile(rf"[^./\\][^/\\]{{0,{grid.LONGEST - 1}}}")  # of a folder inside the sweep
MOST_EPISODES = 100_000  # of an evaluation, ours: more is a slip of the pen
_NO_LINE = {"step": 0, "actions": 0, "grasp_success": None, "grasps_counted": 0}


class SweepError(FailedError):
    """A sweep that cannot begin or continue."""


class SweepPlan(NamedTuple):
    """The runs of a sweep: every point with seeds cfg.seed, cfg.seed + 1, ..."""

    seeds: int
    points: list[grid.SweepPoint]
    episodes: int = 0  # that every final policy is evaluated in
    together: int = 0  # runs in one program, at most; 0: all that can be


class SweepResult(NamedTuple):
    """The end of a sweep."""

    summary: dict[str, Any]  # as in summary.json
    compile_seconds: list[float]  # of each group that was compiled
    stopped_by: int | None  # number of the signal; None if all is done


def run(
    plan: SweepPlan,
    folder: Path,
    make_program: Callable[[ProgramGroup], SweepProgram],
    reporter: Terminal,
    stop: Stop,
    resume: bool = False,
) -> SweepResult:
    """Runs what is left of a sweep, or until `stop.signal` is set; saves in both cases.

    Args: folder, made unless `resume`; make_program, called for each group that is not done. Raises
    CheckpointError if a checkpoint is damaged.
    """
    checkpoint.check_path(folder)
    cluster.wait("sweep")  # all have looked whether there is such a folder
    if not resume and cluster.is_first():
        folder.mkdir(parents=True)
        files.replace(folder / files.SWEEP_PLAN, plan_text(plan))
    sweep = _Sweep(folder, groups_of(plan), reporter, stop)
    with lock.exclusive(folder) if cluster.is_first() else contextlib.nullcontext():
        for index, (group, _) in enumerate(sweep.groups):
            group_folder = files.inside(folder, GROUPS, str(index))
            if not sweep.stopping() and not (group_folder / "done").exists():
                sweep.train_group(index, group_folder, make_program(group))
        summary = summarise(plan, folder)
        if cluster.is_first():
            files.write_json(folder / SUMMARY, summary)
    done = f"done; saved in {folder}, results in {folder / SUMMARY}"
    stopped = f"stopped and saved; continue with: csac-jax sweep --resume {folder}"
    reporter.log(done if sweep.stopped is None else stopped)
    return SweepResult(summary, sweep.compiled, sweep.stopped)


def read_plan(folder: Path) -> SweepPlan:
    """Reads the plan of a sweep's folder. Raises SweepError if it cannot be read."""
    path = folder / files.SWEEP_PLAN
    try:
        plan = _parse_plan(files.read_object(path))
        check_plan(plan)
        _check_unchanged(plan, folder)
    except FileNotFoundError:
        raise SweepError(
            f"there is no {path.name} in {folder}; give the folder of a sweep"
        ) from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        reason = files.first_line(error)
        raise SweepError(f"{path} cannot be read ({reason}); begin a new sweep") from None
    return plan


def _parse_plan(stored: dict[str, Any]) -> SweepPlan:
    if stored.pop(DIGEST, None) not in (None, _digest(stored)):  # old ones have none
        raise ValueError("it was changed after it had been written")
    if stored.keys() - {"episodes", "together"} != {"seeds", "settings"}:
        raise ValueError("it is no plan of a sweep")
    points = []
    for point in stored["settings"]:
        values = dict(renames.current_setting(*pair) for pair in point["values"].items())
        points.append(grid.SweepPoint(point["name"], values, configs.from_dict(point["config"])))
    return SweepPlan(stored["seeds"], points, stored.get("episodes", 0), stored.get("together", 0))


def plan_text(plan: SweepPlan) -> str:
    """Returns the JSON that `read_plan` reads."""
    points = [
        {"name": point.name, "values": point.values, "config": configs.to_dict(point.cfg)}
        for point in plan.points
    ]
    numbers = {"episodes": plan.episodes, "together": plan.together}
    content = {"seeds": plan.seeds, "settings": points, **numbers}
    return json.dumps({**content, DIGEST: _digest(content)}, indent=2) + "\n"


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def check_plan(plan: SweepPlan) -> None:
    """Raises SettingsError for too many runs or episodes, or an unsafe folder name."""
    if type(plan.seeds) is not int or not 1 <= plan.seeds * len(plan.points) <= grid.MOST_RUNS:
        raise SettingsError(f"seeds: 1 to {grid.MOST_RUNS} runs in all, seeds times settings")
    fits = type(plan.episodes) is int and 0 <= plan.episodes <= MOST_EPISODES
    require(fits, f"episodes: 0 to {MOST_EPISODES}")
    fits = type(plan.together) is int and plan.together >= 0
    require(fits, "together: at least 1, or 0 for all side by side")
    for name in (names := [point.name for point in plan.points]):
        if not isinstance(name, str) or not _NAME.fullmatch(name) or not name.isprintable():
            raise SettingsError(f"{shown(name)} is no name of a folder")
        require(name not in RESERVED, f"the name '{name}' is taken by the sweep's own files")
    require(len(set(names)) == len(names), "two settings have the same name")


def _check_unchanged(plan: SweepPlan, folder: Path) -> None:
    """Raises ValueError if a run has begun with another config than the plan's, or elsewhere."""
    for run, cfg in runs_of(plan).items():
        if (path := files.inside(folder, run, files.CONFIG)).exists():
            stored = configs.from_dict(files.read_object(path))
            if names := configs.differences(stored, cfg):
                raise ValueError(f"{run} has other values of {', '.join(names)}")


def runs_of(plan: SweepPlan) -> dict[Path, Config]:
    """Returns every point with every seed: the config by the run's folder in the sweep's."""
    return {
        Path(name, f"seed-{cfg.seed + k}"): dataclasses.replace(cfg, seed=cfg.seed + k)
        for name, _, cfg in plan.points
        for k in range(plan.seeds)
    }


def groups_of(plan: SweepPlan) -> list[tuple[ProgramGroup, list[Path]]]:
    """Groups the runs of a plan, in order. Raises SettingsError if points are equal."""
    runs = {cfg: run for run, cfg in runs_of(plan).items()}
    if len(runs) < plan.seeds * len(plan.points):
        raise SettingsError("vary: two settings have the same values; leave one of them out")
    most = plan.together or len(runs)
    groups = [
        group._replace(configs=group.configs[first : first + most])
        for group in group_configs(list(runs))
        for first in range(0, len(group.configs), most)
    ]
    return [(group, [runs[cfg] for cfg in group.configs]) for group in groups]


def check_room(plan: SweepPlan, devices: int) -> None:
    """Raises SettingsError if a group's runs, divided among `devices`, exceed their memory."""
    for group, _ in groups_of(plan._replace(seeds=1, together=0)):
        runs = len(group.configs) * plan.seeds
        memory.check(group.configs[0], -(-min(runs, plan.together or runs) // devices))


@dataclasses.dataclass
class _Sweep:
    """A sweep that runs."""

    folder: Path
    groups: list[tuple[ProgramGroup, list[Path]]]
    reporter: Terminal
    stop: Stop
    stopped: int | None = None  # number of the signal that all processes know of
    compiled: list[float] = dataclasses.field(default_factory=list)  # s, of each group

    def stopping(self) -> bool:
        """Returns True if a signal has come to any process. All must ask at once."""
        self.stopped = cluster.agree(self.stop.signal)
        return self.stopped is not None

    def train_group(self, index: int, folder: Path, program: SweepProgram) -> None:
        """Trains a group, which has `folder` to itself, to its end or to a signal."""
        training = _GroupTraining(self.folder, folder, *self.groups[index], program)
        self.reporter.log(f"group {index + 1} of {len(self.groups)}: {training.title()}")
        chunk = None
        while not training.over() and not self.stopping():
            if chunk is None:
                chunk, seconds = loop.compile_program(
                    training.cfg, program.compile_chunk, training.state, self.reporter
                )
                self.compiled.append(seconds)
            elif records := training.advance(chunk, self.reporter):
                self._show(index, records)
        if training.saved != training.step:
            training.save()
        if self.stopped is None:
            training.finish()

    def _show(self, index: int, records: list[Record]) -> None:
        """Shows sums of all runs' actions and speed, and means of the rest."""

        def mean(name: str) -> float | None:
            values = [getattr(record, name) for record in records]
            return loop.mean([value for value in values if value is not None])

        cfgs = [group.configs for group, _ in self.groups]
        actions = [sum(loop.total_steps(cfg) * cfg.train.scenes for cfg in group) for group in cfgs]
        done = sum(actions[:index]) + records[0].actions * len(cfgs[index])
        total, speed = sum(actions), sum(record.actions_per_second for record in records)
        shown: Any = {
            **{name: mean(name) for name in ("grasp_success", "critic_loss", "actor_loss")},
            "actions": done,
            "actions_per_second": speed,
            "grasps_counted": sum(record.grasps_counted for record in records),
        }
        record = dataclasses.replace(records[0], **shown)
        self.reporter.progress(record, total, (total - done) / max(speed, 1e-9))


class _GroupTraining:
    """A group that trains: its state and the host's state of each run."""

    def __init__(
        self, sweep: Path, folder: Path, group: ProgramGroup, runs: list[Path], program: Any
    ) -> None:
        """Restores the newest checkpoint, if there is one, and cuts the logs to it."""
        self.folder, self.runs, self.program = folder, runs, program
        self.cfgs, self.cfg = group.configs, group.configs[0]
        self.paths = [files.inside(sweep, run) for run in runs]
        self.loop_states = [loop.LoopState(0.0, [])] * len(runs)
        self.failed: list[int | None] = [None] * len(runs)  # step of a loss that is not finite
        if checkpoint.latest_step(folder) is None:
            self.state = program.init()
        else:
            self.state, extra = checkpoint.restore(folder, program.abstract())
            self.loop_states = [loop.LoopState(*loop_state) for loop_state, _ in extra["runs"]]
            self.failed = [failed for _, failed in extra["runs"]]
            if cluster.is_first():
                checkpoint.set_aside_after(folder, int(self.state.step))
        self.step = int(self.state.step)
        self.saved = self.step if self.step else None
        if cluster.is_first():
            for cfg, path in zip(self.cfgs, self.paths, strict=True):
                path.mkdir(parents=True, exist_ok=True)
                files.remove_drafts(path)
                files.write_json(path / files.CONFIG, configs.to_dict(cfg))
                files.truncate_log(files.inside(path, files.METRICS), self.step)

    def title(self) -> str:
        names = list(dict.fromkeys(run.parent.name for run in self.runs))
        more = f" and {len(names) - 4} more" if len(names) > 4 else ""
        since = f", resumed at step {self.step}" if self.step else ""
        return f"{len(self.runs)} runs, {', '.join(names[:4])}{more}{since}"

    def over(self) -> bool:
        """Returns True if all runs are done or have failed."""
        return None not in self.failed or self.step >= loop.total_steps(self.cfg)

    def advance(self, chunk: Callable[[Any], Any], reporter: Terminal) -> list[Record]:
        """Runs a chunk and saves if it is time; logs and returns a record of each sound run."""
        self.state, metrics, seconds = loop.timed(chunk, self.state)
        self.step += self.cfg.train.chunk
        records = []
        for i, cfg in enumerate(self.cfgs):
            run_metrics = jax.tree.map(lambda leaf, i=i: leaf[:, i], metrics)
            if self.failed[i] is None and (name := loop.not_finite(run_metrics)):
                self.failed[i] = self.step
                reason = f"given up at step {self.step}, {name} is not finite"
                reporter.log(f"{self.runs[i].parent}, seed {cfg.seed}: {reason}")
            if self.failed[i] is None:
                before = self.loop_states[i]
                after, record = loop.record_chunk(cfg, self.step, run_metrics, before, seconds)
                self.loop_states[i] = after
                records.append(record)
                if cluster.is_first():
                    loop.append(self.paths[i], record)
        if self.step % (self.cfg.train.save_every * self.cfg.train.chunk) == 0:
            self.save()
        return records

    def save(self) -> None:
        runs = list(zip(self.loop_states, self.failed, strict=True))
        checkpoint.save(self.folder, self.step, self.state, self.cfg, {"runs": runs})
        self.saved = self.step

    def finish(self) -> None:
        """Writes the runs' checkpoints, then removes the group's; a resumed sweep repeats it."""
        for i, path in enumerate(self.paths):
            if self.failed[i] is None:
                state, extra = self.program.replica(self.state, i), self.loop_states[i]._asdict()
                checkpoint.save(path, self.step, state, self.cfgs[i], extra)
        if cluster.is_first():
            files.replace(self.folder / "done", "")
            checkpoint.remove(self.folder)
        cluster.wait(f"finished {self.folder}")


def summarise(plan: SweepPlan, folder: Path) -> dict[str, Any]:
    """Returns grasp success of every run, by its log, and its interquartile mean over the seeds. A
    run with another number of steps than the plan's does not count."""
    points: list[dict[str, Any]] = []
    for point in plan.points:
        runs = runs_of(plan._replace(points=[point]))
        rows = [_row(folder, run, cfg) for run, cfg in runs.items()]
        done = [row["grasp_success"] for row in rows if row["complete"]]
        known = np.array([value for value in done if value is not None])
        success = statistics.band([known])._asdict() if known.size else dict(NO_CASES)
        named = {"name": point.name, "values": point.values}
        points.append({**named, "grasp_success": success, "runs": rows})
    complete = all(row["complete"] for point in points for row in point["runs"])
    return {"seeds": plan.seeds, "complete": complete, "settings": points}


def _row(folder: Path, run: Path, cfg: Config) -> dict[str, Any]:
    log = files.inside(folder, run, files.METRICS)
    last = [_NO_LINE, *(files.read_log(log) if log.exists() else [])][-1]
    complete = last["step"] == loop.total_steps(cfg)
    known = {"seed": cfg.seed, "run_dir": run.as_posix(), "complete": complete}
    return known | {name: last[name] for name in _NO_LINE}
