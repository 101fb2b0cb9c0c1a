"""The host's side of a run: call the compiled chunk, log, save, stop."""

import collections
import dataclasses
import json
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from csac_jax.config import Config
from csac_jax.constants import GRASP_WINDOW, OUTCOMES, Outcome, Primitive
from csac_jax.errors import FailedError, SettingsError
from csac_jax.io import checkpoint, configs, files, lock
from csac_jax.runtime import cache, compiler
from csac_jax.runtime.signals import Stop
from csac_jax.training import memory
from csac_jax.training.callbacks import Callback, Record, RunInfo, Summary
from csac_jax.training.progress import Terminal
from csac_jax.training.transitions import LOSSES

SUMS = (
    *("cleared", "blocks_lost", "terminated", "truncated"),
    *("gap_disagrees", "contact_overflow", "physics_diverged", "unreachable"),
)
DIVERGED_SHARE = 1e-3  # of a chunk's actions: more diverged physics is logged; 1e-5 is common


class TrainingError(FailedError):
    """A run that cannot continue."""


class LoopState(NamedTuple):
    """The host's state from chunk to chunk; the checkpoint holds it in its JSON."""

    seconds: float  # spent in chunks
    grasps: list[int]  # the last GRASP_WINDOW grasps, oldest first: 1 for a lift, else 0


class _Start(NamedTuple):
    """The beginning of a run. XLA compiles the initial state while Python traces the chunk."""

    step: int
    loop_state: LoopState
    saved: int | None  # step of the newest checkpoint
    shapes: Any  # of the state
    state: Future[Any]


def total_steps(cfg: Config) -> int:
    """Returns the training steps of a run, in whole chunks, so that one program serves all."""
    return math.ceil(cfg.train.steps / cfg.train.chunk) * cfg.train.chunk


def run(
    cfg: Config,
    run_dir: Path,
    init: Callable[[], Any],
    compile_chunk: Callable[[int], Any],
    reporter: Terminal,
    stop: Stop,
    resume: bool = False,
    at: int | None = None,
    callbacks: Sequence[Callback] = (),
) -> Summary:
    """Trains until the config's actions are done or `stop.signal` is set; saves in both cases.

    Args: run_dir, exists if `resume`, else is made; init, creates the initial state in a thread of
    its own, a pytree with `step` [] int32 that is 0; compile_chunk, takes the number of steps and
    gives a jitted function state -> (state, StepMetrics [T, ...]) that may use up its argument.
    For the rest and the errors see `api.train`.
    """
    checkpoint.check_path(run_dir)
    if not resume:
        run_dir.mkdir(parents=True)
    with lock.exclusive(run_dir), ThreadPoolExecutor(1) as thread:
        start = _begin(cfg, run_dir, init, resume, at, thread)
        if resume:
            actions = start.step * cfg.train.scenes
            reporter.log(f"resumed {run_dir} at step {start.step} ({actions} actions)")
        for callback in callbacks:
            callback.begin(RunInfo(cfg, run_dir, start.step))
        summary = None
        try:
            summary = _train(cfg, run_dir, start, compile_chunk, reporter, stop, callbacks)
            return summary
        finally:
            for callback in callbacks:
                callback.end(summary)


def _train(
    cfg: Config,
    run_dir: Path,
    start: _Start,
    compile_chunk: Callable[[int], Any],
    reporter: Terminal,
    stop: Stop,
    callbacks: Sequence[Callback],
) -> Summary:
    step, loop_state, saved = start.step, start.loop_state, start.saved
    total, scenes = total_steps(cfg), cfg.train.scenes
    chunk, compile_seconds, warned = None, 0.0, False
    while step < total and stop.signal is None:
        if chunk is None:
            chunk, compile_seconds = compile_program(cfg, compile_chunk, start.shapes, reporter)
            state = start.state.result()
            continue  # a signal may have come meanwhile
        state, metrics, seconds = timed(chunk, state)
        step += cfg.train.chunk
        if name := not_finite(metrics):
            raise TrainingError(_not_finite_text(run_dir, name, step))
        # The first chunk waits for what still compiles, or for Warp to build its kernels.
        first = loop_state is start.loop_state
        eta = None if first else seconds * (total - step) / cfg.train.chunk
        loop_state, record = record_chunk(cfg, step, metrics, loop_state, seconds)
        append(run_dir, record)
        reporter.progress(record, total * scenes, eta)
        if not warned and (warning := _physics_warning(cfg, record)):
            warned = True
            reporter.log(warning)
        if step % (cfg.train.save_every * cfg.train.chunk) == 0:
            checkpoint.save(run_dir, step, state, cfg, loop_state._asdict())
            saved = step
        for callback in callbacks:
            callback.chunk(record, state)
    if saved != step:
        state = start.state.result() if chunk is None else state
        checkpoint.save(run_dir, step, state, cfg, loop_state._asdict())
    stopped = f"stopped and saved at step {step}; continue with: csac-jax train --resume {run_dir}"
    done = f"done: {step * scenes} actions; saved in {run_dir}"
    reporter.log(done if stop.signal is None else stopped)
    took, grasps = (loop_state.seconds, compile_seconds), loop_state.grasps
    return Summary(step, step * scenes, *took, mean(grasps), len(grasps), stop.signal)


def _begin(
    cfg: Config,
    run_dir: Path,
    init: Callable[[], Any],
    resume: bool,
    at: int | None,
    thread: ThreadPoolExecutor,
) -> _Start:
    """Starts to create the initial state, or restores a checkpoint and cuts the log to it."""
    if resume:
        check_resumable(cfg, run_dir, at)
    files.write_json(run_dir / files.CONFIG, configs.to_dict(cfg))
    log = files.inside(run_dir, files.METRICS)
    shapes = jax.eval_shape(init)
    if not resume:
        files.truncate_log(log, 0)
        return _Start(0, LoopState(0.0, []), None, shapes, thread.submit(init))
    state, extra = checkpoint.restore(run_dir, shapes, at)
    step = int(state.step)
    checkpoint.set_aside_after(run_dir, step)
    files.truncate_log(log, step)
    loop_state = LoopState(extra["seconds"], extra["grasps"])
    return _Start(step, loop_state, step, shapes, thread.submit(lambda: state))


def check_resumable(cfg: Config, run_dir: Path, at: int | None = None) -> None:
    """Raises SettingsError if the run has other settings, CheckpointError if there is no run."""
    stored = checkpoint.load_config(run_dir, at)
    if stored.parts != cfg.parts:
        was, now = (one.parts or "no parts of one's own" for one in (stored, cfg))
        raise SettingsError(f"{run_dir} was trained with {was}, not with {now}; give the same")
    longer = stored.change(train={"actions": max(stored.train.actions, cfg.train.actions)})
    if names := ", ".join(configs.differences(longer, cfg)):
        remedy = "leave them out, or begin a new run; only train.actions may grow"
        raise SettingsError(f"{run_dir} was trained with other values of {names}; {remedy}")


def compile_program(
    cfg: Config, compile_chunk: Callable[[int], Any], state: Any, reporter: Terminal
) -> tuple[Any, float]:
    """Compiles a chunk for states like this; returns it and the seconds that it took."""
    reporter.log("compiling the training program; this takes a while, once")
    if cfg.sim.physics == "warp":
        reporter.log("then Warp builds its kernels, on a new machine for minutes")
    if cfg.sim.physics == "mjx" and jax.default_backend() == "cpu":
        reporter.log(
            "MJX compiles for minutes on a CPU; physics c or auto does not: --sim.physics c"
        )
    begun, hits = time.perf_counter(), cache.hits()
    program = compiler.lower(compile_chunk(cfg.train.chunk), state).compile()
    seconds = time.perf_counter() - begun
    source = " (from the cache)" if cache.hits() > hits else ""
    reporter.log(f"compiled in {seconds:.1f} s{source}; {memory.compiled_text(program)}")
    return program, seconds


def timed(chunk: Callable[[Any], Any], state: Any) -> tuple[Any, Any, float]:
    """Runs a chunk; returns the next state, metrics on the host, and the seconds it took."""
    begun = time.perf_counter()
    state, metrics = chunk(state)
    metrics = jax.device_get(metrics)
    return state, metrics, time.perf_counter() - begun


def not_finite(metrics: Any) -> str | None:
    """Returns the name of the first non-finite loss, or None; those of the warm-up do not count."""
    for name in ("critic_loss", "actor_loss"):
        if not np.isfinite(getattr(metrics, name)[metrics.learned]).all():
            return name
    return None if metrics.finite.all() else "a parameter"


def _not_finite_text(run_dir: Path, name: str, step: int) -> str:
    last = checkpoint.latest_step(run_dir)
    kept = "no checkpoint was saved" if last is None else f"the checkpoint of step {last} is kept"
    where = f"{name} is not finite in the chunk that ended at step {step}"
    return f"{where}; {kept}; lower learn.learning_rate and train again"


def _physics_warning(cfg: Config, record: Record) -> str | None:
    """Returns a warning if physics diverged in too many actions of a chunk."""
    diverged, actions = record.physics_diverged, cfg.train.chunk * cfg.train.scenes
    if diverged <= max(DIVERGED_SHARE * actions, 1.0):
        return None
    fault = f"physics failed in {diverged} of the last {actions} actions, whose scenes were dropped"
    return f"{fault}; before you trust this run, try another sim.physics than {cfg.sim.physics}"


def record_chunk(
    cfg: Config, step: int, metrics: Any, before: LoopState, seconds: float
) -> tuple[LoopState, Record]:
    """Summarises a chunk with `metrics` [T, E] that took `seconds`."""
    grasped = metrics.primitive == Primitive.GRASP
    outcomes = metrics.outcome[grasped]  # in order of time, then of scene
    window = collections.deque(before.grasps, maxlen=GRASP_WINDOW)
    window.extend((outcomes == Outcome.LIFTED).astype(int).tolist())
    counts = np.bincount(outcomes, minlength=len(OUTCOMES)).tolist()
    sums: Any = {name: int(getattr(metrics, name).sum()) for name in SUMS}
    means: Any = {name: mean(getattr(metrics, name)[metrics.learned]) for name in LOSSES}
    record = Record(
        step=step,
        actions=step * cfg.train.scenes,
        seconds=round(before.seconds + seconds, 3),
        actions_per_second=round(grasped.size / seconds, 3),
        grasp_success=mean(window),
        grasps_counted=len(window),
        pushes=int((~grasped).sum()),
        grasps=int(grasped.sum()),
        outcomes=dict(zip(OUTCOMES, counts, strict=True)),
        pushes_better=int(metrics.push_better.sum()),
        reward=float(metrics.reward.mean()),
        **sums,
        **means,
    )
    return LoopState(before.seconds + seconds, list(window)), record


def mean(values: Sequence[float] | np.ndarray) -> float | None:
    """Returns the mean, or None of no values."""
    return float(np.mean(values)) if len(values) else None


def append(run_dir: Path, record: Record) -> None:
    """Adds a line to the log of a run."""
    files.append(run_dir / files.METRICS, json.dumps(dataclasses.asdict(record)))
