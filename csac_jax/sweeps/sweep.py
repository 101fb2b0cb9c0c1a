"""The host's side of a sweep: groups of settings in turn, all members of a group in one program.

SWEEP/sweep.json                what was asked for; a sweep is resumed from it
SWEEP/summary.json              every setting's grasp success over its seeds, and every member's
SWEEP/SETTING/seed-K/           a member, laid out like a run of `train`; its checkpoint is written at the end
SWEEP/groups/I/checkpoints/     the state of all members of group I, until they are done
SWEEP/groups/I/done             their checkpoints are written

A member is one setting with one seed. One whose loss is not finite is given up and named; the
others go on, whom it cannot reach.
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
from csac_jax.evaluation import statistics
from csac_jax.io import checkpoint, configs, files
from csac_jax.runtime import cluster
from csac_jax.runtime.signals import Stop
from csac_jax.sweeps.replicas import Engine, Group, group
from csac_jax.training import loop, memory

PLAN = "sweep.json"
SUMMARY = "summary.json"
DONE = "done"


class SweepError(Exception):
    """A sweep that cannot begin or go on; the message is one line with the remedy."""


class Setting(NamedTuple):
    """One combination of the varied values."""

    name: str  # of its folder
    values: dict[str, str]  # varied setting -> value, as given
    cfg: Config  # with the first seed


class Plan(NamedTuple):
    """What a sweep runs: every setting with seeds cfg.seed, cfg.seed + 1, ..."""

    seeds: int
    settings: list[Setting]


class Member(NamedTuple):
    """One run of a sweep."""

    setting: str
    cfg: Config


class Progress(NamedTuple):
    """What the host carries for a member from chunk to chunk."""

    run: loop.Progress
    failed: int | None  # step of the chunk in which a loss was not finite


class Result(NamedTuple):
    """How a sweep ended."""

    summary: dict[str, Any]  # as in summary.json
    compile_seconds: list[float]  # of each group that was compiled
    stopped_by: int | None  # number of the signal; None if all is done


def run(
    plan: Plan,
    folder: Path,
    engine: Callable[[Group], Engine],
    reporter: loop.Reporter,
    stop: Stop,
    resume: bool = False,
) -> Result:
    """Runs what is left of a sweep, or until `stop.signal` is set; saves in both cases.

    Args: folder, made unless `resume`; engine, gives the program of a group, once per group that is
    not done. Raises SweepError if a chunk is left that no member can go on with, CheckpointError if
    a checkpoint is damaged.
    """
    cluster.wait("sweep")  # all have looked whether there is such a folder
    if not resume and cluster.is_first():
        folder.mkdir(parents=True)
        files.replace(folder / PLAN, plan_text(plan))
    sweep = _Sweep(plan, folder, reporter, stop)
    compiled = []
    for index, (given, each) in enumerate(sweep.groups):
        if not sweep.stopping() and not (sweep.group_folder(index) / DONE).exists():
            compiled += sweep.run_group(index, given, each, engine(given))
    summary = summarise(plan, folder)
    if cluster.is_first():
        files.write_json(folder / SUMMARY, summary)
    reporter.say(_ending(folder, sweep.stopped))
    return Result(summary, compiled, sweep.stopped)


def read_plan(folder: Path) -> Plan:
    """The plan of a sweep's folder. Raises SweepError if there is none that can be read."""
    try:
        stored = json.loads((folder / PLAN).read_text())
        settings = [
            Setting(one["name"], one["values"], configs.from_dict(one["config"]))
            for one in stored["settings"]
        ]
        return Plan(stored["seeds"], settings)
    except FileNotFoundError:
        raise SweepError(f"there is no {PLAN} in {folder}; give the folder of a sweep") from None
    except (ValueError, KeyError, TypeError) as error:
        raise SweepError(f"{folder / PLAN} cannot be read ({error}); begin a new sweep") from None


def plan_text(plan: Plan) -> str:
    """What `read_plan` reads, as JSON."""
    settings = [
        {"name": one.name, "values": one.values, "config": configs.to_dict(one.cfg)}
        for one in plan.settings
    ]
    return json.dumps({"seeds": plan.seeds, "settings": settings}, indent=2) + "\n"


def members_of(plan: Plan) -> list[Member]:
    """Every setting with every seed."""
    return [
        Member(one.name, dataclasses.replace(one.cfg, seed=one.cfg.seed + k))
        for one in plan.settings
        for k in range(plan.seeds)
    ]


def member_folder(folder: Path, one: Member) -> Path:
    """Where a member's log and checkpoint lie."""
    return folder / one.setting / f"seed-{one.cfg.seed}"


def groups_of(plan: Plan) -> list[tuple[Group, list[Member]]]:
    """What runs together, each with its members in order."""
    left = {one.cfg: one for one in members_of(plan)}
    if len(left) < plan.seeds * len(plan.settings):
        raise SweepError("--vary: two settings have the same values; leave one of them out")
    return [(given, [left[cfg] for cfg in given.configs]) for given in group(list(left))]


def check(plan: Plan) -> None:
    """Raises ValueError or SweepError for a plan that cannot be run whatever the devices."""
    groups_of(plan._replace(seeds=1))  # seeds never make a difference


def check_room(plan: Plan, devices: int) -> None:
    """Raises ValueError where the members of a group, spread over `devices`, are known to exceed
    what a device has room for: its memory, or the scenes that Warp's contacts are laid out for."""
    for given, _ in groups_of(plan._replace(seeds=1)):
        cfg, available, alike = given.configs[0], memory.limit(), not given.numbers
        members = -(-len(given.configs) * plan.seeds // devices)
        if cfg.sim.physics == "warp" and members * cfg.train.scenes > WARP_WORLDS:
            raise ValueError(
                f"--seeds: {members} members of {cfg.train.scenes} scenes side by side, Warp has room for "
                f"{WARP_WORLDS} scenes; lower --seeds or --train.scenes, or take --sim.physics mjx"
            )
        total = memory.sure(cfg, members, alike)
        if total > available:
            fit = sum(memory.sure(cfg, fewer, alike) <= available for fewer in range(1, members))
            raise ValueError(
                f"--seeds: {members} members side by side take {total / memory.GIB:.1f} GiB, there are "
                f"{available / memory.GIB:.1f}, enough for {fit}; lower --seeds or --replay.capacity, vary fewer "
                "numbers or raise --devices"
            )


class _Sweep:
    """A sweep on its way."""

    def __init__(self, plan: Plan, folder: Path, reporter: loop.Reporter, stop: Stop) -> None:
        self.folder, self.reporter, self.stop = folder, reporter, stop
        self.groups = groups_of(plan)
        self.stopped: int | None = None  # number of the signal that all processes know of
        self._total = sum(_actions(given.configs) for given, _ in self.groups)

    def stopping(self) -> bool:
        """Whether a signal has come to any process. All must ask at once."""
        self.stopped = cluster.agree(self.stop.signal)
        return self.stopped is not None

    def group_folder(self, index: int) -> Path:
        return self.folder / "groups" / str(index)

    def run_group(
        self, index: int, given: Group, each: list[Member], engine: Engine
    ) -> list[float]:
        """Trains a group to its end or to a signal; returns the time of its compilation, s, if
        there was one."""
        folder, cfg = self.group_folder(index), given.configs[0]
        state, progress, step = self._start(folder, each, engine)
        self.reporter.say(self._title(index, each, step))
        compiled: list[float] = []
        chunk = None
        with self._logs(each) as logs:
            while step < loop.total_steps(cfg) and not self.stopping():
                if all(one.failed is not None for one in progress):
                    break
                if chunk is None:
                    chunk, seconds = loop.compile_program(cfg, engine.chunk, state, self.reporter)
                    compiled.append(seconds)
                    continue  # a signal may have come meanwhile
                begun = time.perf_counter()
                state, metrics = chunk(state)
                metrics = jax.device_get(metrics)
                step += cfg.train.chunk
                progress = self._log(
                    logs, each, step, metrics, progress, time.perf_counter() - begun
                )
                if step % (cfg.train.save_every * cfg.train.chunk) == 0:
                    _save(folder, step, state, cfg, progress)
        if checkpoint.latest_step(folder) != step:
            _save(folder, step, state, cfg, progress)
        if self.stopped is None:
            self._finish(folder, step, each, engine, state, progress)
        return compiled

    def _start(
        self, folder: Path, each: list[Member], engine: Engine
    ) -> tuple[Any, list[Progress], int]:
        """State of the newest checkpoint, if there is one, else the first one; logs are cut to
        it."""
        if checkpoint.latest_step(folder) is None:
            state, progress, step = (
                engine.init(),
                [Progress(loop.Progress(0.0, []), None)] * len(each),
                0,
            )
        else:
            state, extra = checkpoint.restore(folder, engine.abstract())
            progress = [Progress(loop.Progress(*run), failed) for run, failed in extra["members"]]
            step = int(state.step)
        if cluster.is_first():
            for one in each:
                path = member_folder(self.folder, one)
                path.mkdir(parents=True, exist_ok=True)
                files.write_json(path / files.CONFIG, configs.to_dict(one.cfg))
                files.truncate_log(path / files.METRICS, step)
        return state, progress, step

    def _title(self, index: int, each: list[Member], step: int) -> str:
        names = list(dict.fromkeys(one.setting for one in each))
        shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        since = f", resumed at step {step}" if step else ""
        return f"group {index + 1} of {len(self.groups)}: {len(each)} members, {shown}{since}"

    @contextlib.contextmanager
    def _logs(self, each: list[Member]) -> Iterator[list[TextIO]]:
        with contextlib.ExitStack() as stack:
            paths = [member_folder(self.folder, one) / files.METRICS for one in each]
            yield [
                stack.enter_context(open(path if cluster.is_first() else os.devnull, "a"))
                for path in paths
            ]

    def _log(
        self,
        logs: list[TextIO],
        each: list[Member],
        step: int,
        metrics: Any,
        before: list[Progress],
        seconds: float,
    ) -> list[Progress]:
        """Writes every member's line of a chunk with `metrics` [T, S, ...], and shows them
        together."""
        after, records = [], []
        for i, (one, given) in enumerate(zip(each, before, strict=True)):
            own = jax.tree.map(lambda leaf, i=i: leaf[:, i], metrics)
            if given.failed is None and not loop.is_finite(own):
                self.reporter.say(
                    f"{one.setting}, seed {one.cfg.seed}: given up at step {step}, a loss is not finite"
                )
                given = given._replace(failed=step)
            if given.failed is None:
                run, record = loop.record_chunk(one.cfg, step, own, given.run, seconds)
                logs[i].write(json.dumps(dataclasses.asdict(record)) + "\n")
                logs[i].flush()
                given = given._replace(run=run)
                records.append(record)
            after.append(given)
        if records:
            self._show(each, records)
        return after

    def _show(self, each: list[Member], records: list[loop.Record]) -> None:
        """One line about all members: their actions and speed together, means of the rest."""
        first, index = (
            records[0],
            next(i for i, (_, other) in enumerate(self.groups) if other is each),
        )
        done = sum(
            _actions(given.configs) for given, _ in self.groups[:index]
        ) + first.actions * len(each)
        speed = sum(record.actions_per_second for record in records)
        shown = dataclasses.replace(
            first,
            actions=done,
            actions_per_second=speed,
            grasp_success=_mean([record.grasp_success for record in records]),
            grasps_counted=sum(record.grasps_counted for record in records),
            critic_loss=_mean([record.critic_loss for record in records]),
            actor_loss=_mean([record.actor_loss for record in records]),
        )
        self.reporter.progress(shown, self._total, (self._total - done) / max(speed, 1e-9))

    def _finish(
        self,
        folder: Path,
        step: int,
        each: list[Member],
        engine: Engine,
        state: Any,
        progress: list[Progress],
    ) -> None:
        """A checkpoint for every member, then the group's own makes room. Done again if it was
        interrupted."""
        for i, (one, given) in enumerate(zip(each, progress, strict=True)):
            if given.failed is None:
                path = member_folder(self.folder, one)
                _remove(path / checkpoint.FOLDER)
                checkpoint.save(path, step, engine.member(state, i), one.cfg, given.run._asdict())
        if cluster.is_first():
            files.replace(folder / DONE, "")
        _remove(folder / checkpoint.FOLDER)


def _remove(folder: Path) -> None:
    """Removes a folder, once, and returns when it is gone for all processes."""
    if cluster.is_first():
        shutil.rmtree(folder, ignore_errors=True)
    cluster.wait(f"removed {folder}")


def _actions(configs: Sequence[Config]) -> int:
    return sum(loop.total_steps(cfg) * cfg.train.scenes for cfg in configs)


def _save(folder: Path, step: int, state: Any, cfg: Config, progress: list[Progress]) -> None:
    checkpoint.save(
        folder, step, state, cfg, {"members": [[list(one.run), one.failed] for one in progress]}
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def _ending(folder: Path, stopped: int | None) -> str:
    if stopped is None:
        return f"done; saved in {folder}, results in {folder / SUMMARY}"
    return f"stopped and saved; go on with: csac-jax sweep --resume {folder}"


def summarise(plan: Plan, folder: Path) -> dict[str, Any]:
    """Grasp success over the last grasps of every member and, over the seeds of each setting, its
    interquartile mean.

    Read off the members' logs; one with another number of steps than the plan's does not count.
    """
    settings: list[dict[str, Any]] = []
    for one in plan.settings:
        rows = [_row(folder, member) for member in members_of(plan._replace(settings=[one]))]
        done = [
            row["grasp_success"]
            for row in rows
            if row["complete"] and row["grasp_success"] is not None
        ]
        settings.append(
            {
                "name": one.name,
                "values": one.values,
                "grasp_success": _over_seeds(done),
                "members": rows,
            }
        )
    complete = all(row["complete"] for one in settings for row in one["members"])
    return {"seeds": plan.seeds, "complete": complete, "settings": settings}


def _over_seeds(values: Sequence[float]) -> dict[str, Any]:
    """Interquartile mean and its band; no value of no seed."""
    if not values:
        return {"value": None, "low": None, "high": None, "n": 0}
    return statistics.band([np.array(values)])._asdict()


def _row(folder: Path, one: Member) -> dict[str, Any]:
    path = member_folder(folder, one)
    lines = files.read_log(path / files.METRICS) if (path / files.METRICS).exists() else []
    last = (
        lines[-1]
        if lines
        else {"step": 0, "actions": 0, "grasp_success": None, "grasps_counted": 0}
    )
    kept = {name: last[name] for name in ("step", "actions", "grasp_success", "grasps_counted")}
    run_dir = path.relative_to(folder).as_posix()
    return {
        "seed": one.cfg.seed,
        "run_dir": run_dir,
        "complete": last["step"] == loop.total_steps(one.cfg),
        **kept,
    }
