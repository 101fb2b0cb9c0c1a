"""The host's side of a sweep: its groups in turn, all runs of a group in one program.

SWEEP/sweep.json                what was asked for; a sweep is resumed from it
SWEEP/summary.json              grasp success of every point over its seeds, and of every run
SWEEP/POINT/seed-K/             a run, laid out like one of `train`; its checkpoint comes at the end
SWEEP/groups/I/checkpoints/     the state of all runs of group I, until they are done
SWEEP/groups/I/done             their checkpoints are written

A run is one point with one seed. One whose loss is not finite is given up and named; it cannot
reach the others, which go on.
"""

import contextlib
import dataclasses
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import jax
import numpy as np

from csac_jax.config import WARP_WORLDS, Config
from csac_jax.errors import FailedError
from csac_jax.evaluation import statistics
from csac_jax.io import checkpoint, configs, files
from csac_jax.runtime import cluster
from csac_jax.runtime.signals import Stop
from csac_jax.sweeps.grid import SweepPoint
from csac_jax.sweeps.replicas import ProgramGroup, SweepProgram, group_configs
from csac_jax.training import loop, memory

PLAN = "sweep.json"
SUMMARY = "summary.json"
DONE = "done"


class SweepError(FailedError):
    """A sweep that cannot begin or go on; the message is one line with the remedy."""


class SweepPlan(NamedTuple):
    """What a sweep runs: every point with seeds cfg.seed, cfg.seed + 1, ..."""

    seeds: int
    points: list[SweepPoint]


class SweepRun(NamedTuple):
    """One run of a sweep."""

    point: str
    cfg: Config

    @property
    def folder(self) -> Path:
        """Where its log and checkpoint lie, within the sweep's folder."""
        return Path(self.point) / f"seed-{self.cfg.seed}"


class RunProgress(NamedTuple):
    """What the host carries for a run from chunk to chunk."""

    progress: loop.Progress
    failed: int | None  # step of the chunk in which a loss was not finite


class SweepResult(NamedTuple):
    """How a sweep ended."""

    summary: dict[str, Any]  # as in summary.json
    compile_seconds: list[float]  # of each group that was compiled
    stopped_by: int | None  # number of the signal; None if all is done


def run(
    plan: SweepPlan,
    folder: Path,
    make_program: Callable[[ProgramGroup], SweepProgram],
    reporter: loop.Reporter,
    stop: Stop,
    resume: bool = False,
) -> SweepResult:
    """Runs what is left of a sweep, or until `stop.signal` is set; saves in both cases.

    Args: folder, made unless `resume`; make_program, called once for each group that is not done.
    Raises CheckpointError if a checkpoint is damaged.
    """
    cluster.wait("sweep")  # all have looked whether there is such a folder
    if not resume and cluster.is_first():
        folder.mkdir(parents=True)
        files.replace(folder / PLAN, plan_text(plan))
    sweep = _Sweep(folder, groups_of(plan), reporter, stop)
    compiled = []
    for index, (group, _) in enumerate(sweep.groups):
        if not sweep.stopping() and not (sweep.group_folder(index) / DONE).exists():
            compiled += sweep.train_group(index, make_program(group))
    summary = summarise(plan, folder)
    if cluster.is_first():
        files.write_json(folder / SUMMARY, summary)
    reporter.say(_ending(folder, sweep.stopped))
    return SweepResult(summary, compiled, sweep.stopped)


def read_plan(folder: Path) -> SweepPlan:
    """The plan of a sweep's folder. Raises SweepError if there is none that can be read."""
    try:
        stored = json.loads((folder / PLAN).read_text())
        points = [
            SweepPoint(point["name"], point["values"], configs.from_dict(point["config"]))
            for point in stored["settings"]
        ]
        return SweepPlan(stored["seeds"], points)
    except FileNotFoundError:
        raise SweepError(f"there is no {PLAN} in {folder}; give the folder of a sweep") from None
    except (ValueError, KeyError, TypeError) as error:
        raise SweepError(f"{folder / PLAN} cannot be read ({error}); begin a new sweep") from None


def plan_text(plan: SweepPlan) -> str:
    """What `read_plan` reads, as JSON."""
    points = [
        {"name": point.name, "values": point.values, "config": configs.to_dict(point.cfg)}
        for point in plan.points
    ]
    return json.dumps({"seeds": plan.seeds, "settings": points}, indent=2) + "\n"


def runs_of(plan: SweepPlan) -> list[SweepRun]:
    """Every point with every seed."""
    return [
        SweepRun(point.name, dataclasses.replace(point.cfg, seed=point.cfg.seed + k))
        for point in plan.points
        for k in range(plan.seeds)
    ]


def groups_of(plan: SweepPlan) -> list[tuple[ProgramGroup, list[SweepRun]]]:
    """What runs together, each with its runs in order. Raises SweepError if points are equal."""
    runs = {run.cfg: run for run in runs_of(plan)}
    if len(runs) < plan.seeds * len(plan.points):
        raise SweepError("--vary: two settings have the same values; leave one of them out")
    return [(group, [runs[cfg] for cfg in group.configs]) for group in group_configs(list(runs))]


def check_room(plan: SweepPlan, devices: int) -> None:
    """Raises ValueError where the runs of a group, divided among `devices`, exceed what a device
    has room for: its memory, or the scenes of Warp's contacts."""
    for group, _ in groups_of(plan._replace(seeds=1)):
        cfg, runs = group.configs[0], -(-len(group.configs) * plan.seeds // devices)
        if cfg.sim.physics == "warp" and runs * cfg.train.scenes > WARP_WORLDS:
            raise ValueError(
                f"--seeds: {runs} runs of {cfg.train.scenes} scenes side by side, Warp has room "
                f"for {WARP_WORLDS} scenes; lower --seeds or --train.scenes, or take "
                "--sim.physics mjx"
            )
        memory.check(cfg, runs)


class _Sweep:
    """A sweep on its way."""

    def __init__(
        self,
        folder: Path,
        groups: list[tuple[ProgramGroup, list[SweepRun]]],
        reporter: loop.Reporter,
        stop: Stop,
    ) -> None:
        self.folder, self.groups, self.reporter, self.stop = folder, groups, reporter, stop
        self.stopped: int | None = None  # number of the signal that all processes know of

    def stopping(self) -> bool:
        """Whether a signal has come to any process. All must ask at once."""
        self.stopped = cluster.agree(self.stop.signal)
        return self.stopped is not None

    def group_folder(self, index: int) -> Path:
        return self.folder / "groups" / str(index)

    def train_group(self, index: int, program: SweepProgram) -> list[float]:
        """Trains a group to its end or to a signal; returns the time of its compilation, s, if
        there was one."""
        runs = self.groups[index][1]
        training = _GroupTraining(self.folder, self.group_folder(index), runs, program)
        self.reporter.say(self._title(index, training))
        compiled: list[float] = []
        chunk = None
        with training.open_logs() as logs:
            while not training.over() and not self.stopping():
                if chunk is None:
                    chunk, seconds = loop.compile_program(
                        training.cfg, program.chunk, training.state, self.reporter
                    )
                    compiled.append(seconds)
                    continue  # a signal may have come meanwhile
                records = training.advance(chunk, logs, self.reporter)
                if records:
                    self._show(index, records)
        if checkpoint.latest_step(training.folder) != training.step:
            training.save()
        if self.stopped is None:
            training.finish()
        return compiled

    def _title(self, index: int, training: "_GroupTraining") -> str:
        names = list(dict.fromkeys(run.point for run in training.runs))
        shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        since = f", resumed at step {training.step}" if training.step else ""
        number = f"group {index + 1} of {len(self.groups)}"
        return f"{number}: {len(training.runs)} runs, {shown}{since}"

    def _show(self, index: int, records: list[loop.Record]) -> None:
        """One line about all runs: their actions and speed together, means of the rest."""
        actions = [_actions(group.configs) for group, _ in self.groups]
        done = sum(actions[:index]) + records[0].actions * len(self.groups[index][1])
        speed = sum(record.actions_per_second for record in records)
        shown = dataclasses.replace(
            records[0],
            actions=done,
            actions_per_second=speed,
            grasp_success=_mean([record.grasp_success for record in records]),
            grasps_counted=sum(record.grasps_counted for record in records),
            critic_loss=_mean([record.critic_loss for record in records]),
            actor_loss=_mean([record.actor_loss for record in records]),
        )
        total = sum(actions)
        self.reporter.progress(shown, total, (total - done) / max(speed, 1e-9))


class _GroupTraining:
    """A group on its way: its state and what the host carries for each run."""

    def __init__(
        self, sweep_folder: Path, folder: Path, runs: list[SweepRun], program: SweepProgram
    ) -> None:
        """Goes on from the newest checkpoint, if there is one; logs are cut to it."""
        self.folder, self.runs, self.program = folder, runs, program
        self.cfg = runs[0].cfg
        self.paths = [sweep_folder / run.folder for run in runs]
        if checkpoint.latest_step(folder) is None:
            self.state, self.step = program.init(), 0
            self.progress = [RunProgress(loop.Progress(0.0, []), None)] * len(runs)
        else:
            self.state, extra = checkpoint.restore(folder, program.abstract())
            self.step = int(self.state.step)
            stored = extra["runs"] if "runs" in extra else extra["members"]  # its older name
            self.progress = [RunProgress(loop.Progress(*own), failed) for own, failed in stored]
        if cluster.is_first():
            for run, path in zip(runs, self.paths, strict=True):
                path.mkdir(parents=True, exist_ok=True)
                files.write_json(path / files.CONFIG, configs.to_dict(run.cfg))
                files.truncate_log(path / files.METRICS, self.step)

    def over(self) -> bool:
        """Whether all runs are done or given up."""
        lost = all(own.failed is not None for own in self.progress)
        return lost or self.step >= loop.total_steps(self.cfg)

    @contextlib.contextmanager
    def open_logs(self) -> Iterator[list[TextIO]]:
        """The runs' logs, to be added to; only the first process has them."""
        with contextlib.ExitStack() as stack:
            names = [path / files.METRICS for path in self.paths]
            names = names if cluster.is_first() else [Path(os.devnull)] * len(names)
            yield [stack.enter_context(name.open("a")) for name in names]

    def advance(
        self, chunk: Callable[[Any], Any], logs: list[TextIO], reporter: loop.Reporter
    ) -> list[loop.Record]:
        """Runs a chunk, writes the line of every run that is not given up, and saves now and then.
        Returns the lines."""
        begun = time.perf_counter()
        self.state, metrics = chunk(self.state)
        metrics = jax.device_get(metrics)
        self.step += self.cfg.train.chunk
        seconds = time.perf_counter() - begun
        records = []
        for i, log in enumerate(logs):
            if self.progress[i].failed is None:
                own = jax.tree.map(lambda leaf, i=i: leaf[:, i], metrics)
                records += self._record(i, own, seconds, log, reporter)
        if self.step % (self.cfg.train.save_every * self.cfg.train.chunk) == 0:
            self.save()
        return records

    def _record(
        self, i: int, metrics: Any, seconds: float, log: TextIO, reporter: loop.Reporter
    ) -> list[loop.Record]:
        """Writes the line of run i, whose `metrics` are [T, ...]; none if it is given up now."""
        run, before = self.runs[i], self.progress[i]
        if not loop.is_finite(metrics):
            self.progress[i] = before._replace(failed=self.step)
            reason = f"given up at step {self.step}, a loss is not finite"
            reporter.say(f"{run.point}, seed {run.cfg.seed}: {reason}")
            return []
        after, record = loop.record_chunk(run.cfg, self.step, metrics, before.progress, seconds)
        self.progress[i] = before._replace(progress=after)
        log.write(json.dumps(dataclasses.asdict(record)) + "\n")
        log.flush()
        return [record]

    def save(self) -> None:
        """Writes a checkpoint of the group."""
        runs = [[list(own.progress), own.failed] for own in self.progress]
        checkpoint.save(self.folder, self.step, self.state, self.cfg, {"runs": runs})

    def finish(self) -> None:
        """Writes a checkpoint for every run, then removes the group's own. An interrupted call is
        repeated when the sweep is resumed."""
        for i, (run, own) in enumerate(zip(self.runs, self.progress, strict=True)):
            if own.failed is None:
                _remove(self.paths[i] / checkpoint.FOLDER)
                state, extra = self.program.replica(self.state, i), own.progress._asdict()
                checkpoint.save(self.paths[i], self.step, state, run.cfg, extra)
        if cluster.is_first():
            files.replace(self.folder / DONE, "")
        _remove(self.folder / checkpoint.FOLDER)


def _remove(folder: Path) -> None:
    """Removes a folder, once, and returns when it is gone for all processes."""
    if cluster.is_first():
        shutil.rmtree(folder, ignore_errors=True)
    cluster.wait(f"removed {folder}")


def _actions(configs: Sequence[Config]) -> int:
    return sum(loop.total_steps(cfg) * cfg.train.scenes for cfg in configs)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def _ending(folder: Path, stopped: int | None) -> str:
    if stopped is None:
        return f"done; saved in {folder}, results in {folder / SUMMARY}"
    return f"stopped and saved; go on with: csac-jax sweep --resume {folder}"


def summarise(plan: SweepPlan, folder: Path) -> dict[str, Any]:
    """Grasp success over the last grasps of every run and, over the seeds of each point, its
    interquartile mean.

    Read off the logs of the runs; a run with another number of steps than the plan's does not
    count.
    """
    points: list[dict[str, Any]] = []
    for point in plan.points:
        rows = [_row(folder, run) for run in runs_of(plan._replace(points=[point]))]
        done = [row["grasp_success"] for row in rows if row["complete"]]
        success = _over_seeds([value for value in done if value is not None])
        named = {"name": point.name, "values": point.values}
        points.append({**named, "grasp_success": success, "runs": rows})
    complete = all(row["complete"] for point in points for row in point["runs"])
    return {"seeds": plan.seeds, "complete": complete, "settings": points}


def _over_seeds(values: Sequence[float]) -> dict[str, Any]:
    """Interquartile mean and its band; no value of no seed."""
    if not values:
        return {"value": None, "low": None, "high": None, "n": 0}
    return statistics.band([np.array(values)])._asdict()


_NOTHING = {"step": 0, "actions": 0, "grasp_success": None, "grasps_counted": 0}


def _row(folder: Path, run: SweepRun) -> dict[str, Any]:
    log = folder / run.folder / files.METRICS
    lines = files.read_log(log) if log.exists() else []
    last = lines[-1] if lines else _NOTHING
    return {
        "seed": run.cfg.seed,
        "run_dir": run.folder.as_posix(),
        "complete": last["step"] == loop.total_steps(run.cfg),
        **{name: last[name] for name in _NOTHING},
    }
