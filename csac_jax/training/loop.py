"""The host's side of a run: call the compiled chunk, log, save, stop."""

import collections
import dataclasses
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from csac_jax.config import Config
from csac_jax.constants import GRASP_WINDOW, OUTCOMES, Outcome, Primitive
from csac_jax.errors import FailedError, SettingsError
from csac_jax.io import checkpoint, configs, files
from csac_jax.runtime import cache, compiler
from csac_jax.runtime.signals import Stop
from csac_jax.training import memory

LOSSES = ("critic_loss", "actor_loss")
# Share of a chunk's actions beyond which diverged physics is reported; 1e-5 is common.
DIVERGED_SHARE = 1e-3


class TrainingError(FailedError):
    """A run that cannot go on; the message is one line with the remedy."""


@dataclasses.dataclass(frozen=True)
class Record:
    """One line of metrics.jsonl: what a chunk did, and how far the run is. Means are over the
    chunk."""

    step: int  # training steps done
    actions: int  # actions done, over all scenes
    seconds: float  # spent in chunks since the run began, resumed parts included, compilation not
    actions_per_second: float  # of this chunk
    grasp_success: (
        float | None
    )  # share of the last `grasps_counted` grasps that lifted a block; None before the first
    grasps_counted: int  # min(grasps so far, GRASP_WINDOW)
    pushes: int
    grasps: int
    outcomes: dict[str, int]  # grasps by what came of them
    pushes_better: int  # pushes that made the best grasp worth more
    cleared: int  # blocks taken from the table
    blocks_lost: int  # blocks that left the workspace
    terminated: int  # episodes that ended with a cleared table
    truncated: int  # episodes that were cut off
    reward: float
    gap_disagrees: int  # grasps whose outcome the finger gap alone names differently
    contact_overflow: int  # substeps in which contacts may have been dropped
    physics_diverged: int  # scenes whose physics failed
    critic_loss: float | None  # None during the warm-up, as the next three
    actor_loss: float | None
    td_error: float | None
    q_mean: float | None


class Summary(NamedTuple):
    """How a run ended."""

    step: int
    actions: int
    seconds: float  # as in `Record`
    compile_seconds: float  # 0 if nothing was compiled
    grasp_success: float | None  # as in `Record`
    grasps_counted: int
    stopped_by: int | None  # number of the signal; None if the run is complete


class Reporter(Protocol):
    """Shows a run to somebody."""

    def say(self, text: str) -> None:
        """One line about something that happened."""

    def progress(self, record: Record, total_actions: int, eta: float) -> None:
        """After each chunk; `eta` is the time the rest will take, s."""


class Progress(NamedTuple):
    """What the host carries from chunk to chunk, and the checkpoint in its JSON."""

    seconds: float  # spent in chunks
    grasps: list[
        int
    ]  # 1 for a lift, 0 for another outcome, of the last GRASP_WINDOW grasps, oldest first


def total_steps(cfg: Config) -> int:
    """Training steps of a run: those of the config, rounded up to whole chunks, so that one program
    serves all."""
    return math.ceil(cfg.train.steps / cfg.train.chunk) * cfg.train.chunk


def run(
    cfg: Config,
    run_dir: Path,
    init: Callable[[], Any],
    compile_chunk: Callable[[int], Any],
    reporter: Reporter,
    stop: Stop,
    resume: bool = False,
) -> Summary:
    """Trains until the config's actions are done or `stop.signal` is set; saves in both cases.

    The number of steps is rounded up to whole chunks: there is one compilation only.

    Args: run_dir, exists if `resume`, else is made; init, gives the first state, a pytree with
    `step` [] int32; compile_chunk, takes the number of steps and gives a jitted function state ->
    (state, StepMetrics [T, ...]) that may use up its argument. Raises TrainingError on a loss that
    is not finite, CheckpointError if there is nothing sound to resume from.
    """
    state, progress, step = _resume(cfg, run_dir, init) if resume else _begin(cfg, run_dir, init)
    if resume:
        reporter.say(f"resumed {run_dir} at step {step} ({step * cfg.train.scenes} actions)")
    compile_seconds = 0.0
    chunk, doubted = None, False
    with (run_dir / files.METRICS).open("a") as log:
        while step < total_steps(cfg) and stop.signal is None:
            if chunk is None:
                chunk, compile_seconds = compile_program(cfg, compile_chunk, state, reporter)
                continue  # a signal may have come meanwhile
            begun = time.perf_counter()
            state, metrics = chunk(state)
            metrics = jax.device_get(metrics)
            step += cfg.train.chunk
            _check_finite(run_dir, metrics, step)
            progress, record = record_chunk(
                cfg, step, metrics, progress, time.perf_counter() - begun
            )
            log.write(json.dumps(dataclasses.asdict(record)) + "\n")
            log.flush()
            reporter.progress(record, total_steps(cfg) * cfg.train.scenes, _eta(cfg, record))
            if (
                record.physics_diverged > max(DIVERGED_SHARE * (record.pushes + record.grasps), 1.0)
                and not doubted
            ):
                doubted = True
                reporter.say(_doubt(cfg, record))
            if step % (cfg.train.save_every * cfg.train.chunk) == 0:
                _save(cfg, run_dir, step, state, progress)
    if checkpoint.latest_step(run_dir) != step:
        _save(cfg, run_dir, step, state, progress)
    reporter.say(_ending(run_dir, step, cfg, stop))
    success = _share(progress.grasps)
    actions = step * cfg.train.scenes
    return Summary(
        step, actions, progress.seconds, compile_seconds, success, len(progress.grasps), stop.signal
    )


def _begin(cfg: Config, run_dir: Path, init: Callable[[], Any]) -> tuple[Any, Progress, int]:
    run_dir.mkdir(parents=True)
    files.write_json(run_dir / files.CONFIG, configs.to_dict(cfg))
    return init(), Progress(0.0, []), 0


def _resume(cfg: Config, run_dir: Path, init: Callable[[], Any]) -> tuple[Any, Progress, int]:
    """State of the newest checkpoint; lines of the log that are newer than it are dropped."""
    check_resumable(cfg, run_dir)
    files.write_json(run_dir / files.CONFIG, configs.to_dict(cfg))
    state, extra = checkpoint.restore(run_dir, jax.eval_shape(init))
    step = int(state.step)
    files.truncate_log(run_dir / files.METRICS, step)
    return state, Progress(extra["seconds"], extra["grasps"]), step


def check_resumable(cfg: Config, run_dir: Path) -> None:
    """Raises SettingsError where the run has other settings, CheckpointError where it is none."""
    stored = checkpoint.load_config(run_dir)
    longer = stored.change(train={"actions": max(stored.train.actions, cfg.train.actions)})
    if names := configs.differences(longer, cfg):
        raise SettingsError(
            f"{run_dir} was trained with other values of {', '.join(names)}; leave them out, or "
            "begin a new run; only train.actions may grow"
        )


def compile_program(
    cfg: Config, compile_chunk: Callable[[int], Any], state: Any, reporter: Reporter
) -> tuple[Any, float]:
    kernels = (
        "; then Warp builds its kernels, on a new machine for minutes"
        if cfg.sim.physics == "warp"
        else ""
    )
    reporter.say(f"compiling the training program; this takes a while, once{kernels}")
    begun, hits = time.perf_counter(), cache.hits()
    program = compiler.lower(compile_chunk(cfg.train.chunk), state).compile()
    seconds = time.perf_counter() - begun
    source = " (from the cache)" if cache.hits() > hits else ""
    reporter.say(f"compiled in {seconds:.1f} s{source}; {memory.compiled_text(program)}")
    return program, seconds


def _save(cfg: Config, run_dir: Path, step: int, state: Any, progress: Progress) -> None:
    checkpoint.save(run_dir, step, state, cfg, progress._asdict())


def _doubt(cfg: Config, record: Record) -> str:
    return (
        f"physics failed in {record.physics_diverged} of the last "
        f"{record.pushes + record.grasps} actions, whose scenes were dropped: see "
        f"`physics_diverged` in {files.METRICS}; try another --sim.physics than "
        f"{cfg.sim.physics} before you trust this run"
    )


def _check_finite(run_dir: Path, metrics: Any, step: int) -> None:
    """Raises TrainingError if a loss of the chunk that ended at `step` is not finite. Nothing is
    saved then."""
    for name in LOSSES:
        if not is_finite(metrics, (name,)):
            last = checkpoint.latest_step(run_dir)
            kept = (
                "no checkpoint was saved before"
                if last is None
                else f"the checkpoint of step {last} is kept"
            )
            raise TrainingError(
                f"{name} is not finite in the chunk that ended at step {step}; {kept}; "
                "lower learn.learning_rate and train again"
            )


def is_finite(metrics: Any, names: Sequence[str] = LOSSES) -> bool:
    """Whether the losses `names` of a run's chunk are all finite; those of the warm-up do not
    count."""
    learned = np.asarray(metrics.learned)
    return all(
        bool(np.all(np.isfinite(np.asarray(getattr(metrics, name))[learned]))) for name in names
    )


def record_chunk(
    cfg: Config, step: int, metrics: Any, before: Progress, seconds: float
) -> tuple[Progress, Record]:
    """The log's line for a chunk with `metrics` [T, E] that took `seconds`."""
    grasped = metrics.primitive == Primitive.GRASP
    outcomes = metrics.outcome[grasped]  # in order of time, then of scene
    window = collections.deque(before.grasps, maxlen=GRASP_WINDOW)
    window.extend((outcomes == Outcome.LIFTED).astype(int).tolist())
    after = Progress(before.seconds + seconds, list(window))
    counts = np.bincount(outcomes, minlength=len(OUTCOMES)).tolist()
    sums = (
        "cleared",
        "blocks_lost",
        "terminated",
        "truncated",
        "gap_disagrees",
        "contact_overflow",
        "physics_diverged",
    )
    means = ("critic_loss", "actor_loss", "td_error", "q_mean")
    totals: dict[str, Any] = {name: int(getattr(metrics, name).sum()) for name in sums}
    averages: dict[str, Any] = {
        name: _mean(getattr(metrics, name)[metrics.learned]) for name in means
    }
    record = Record(
        step=step,
        actions=step * cfg.train.scenes,
        seconds=round(after.seconds, 3),
        actions_per_second=round(grasped.size / seconds, 3),
        grasp_success=_share(after.grasps),
        grasps_counted=len(after.grasps),
        pushes=int((~grasped).sum()),
        grasps=int(grasped.sum()),
        outcomes=dict(zip(OUTCOMES, counts, strict=True)),
        pushes_better=int(metrics.push_better.sum()),
        reward=float(metrics.reward.mean()),
        **totals,
        **averages,
    )
    return after, record


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if values.size else None


def _share(values: list[int]) -> float | None:
    return sum(values) / len(values) if values else None


def _eta(cfg: Config, record: Record) -> float:
    """Time that the rest of the run will take, s, at the speed of this chunk."""
    return (
        (total_steps(cfg) - record.step) * cfg.train.scenes / max(record.actions_per_second, 1e-9)
    )


def _ending(run_dir: Path, step: int, cfg: Config, stop: Stop) -> str:
    if stop.signal is None:
        return f"done: {step * cfg.train.scenes} actions; saved in {run_dir}"
    return f"stopped and saved at step {step}; go on with: csac-jax train --resume {run_dir}"
