"""A training that compiles in a moment, and processes that run it.

They are forked from one that has imported JAX but not started it: that saves the seconds of
imports.
"""

import contextlib
import dataclasses
import functools
import json
import multiprocessing
import os
import resource
import threading
import time
import warnings
from pathlib import Path
from typing import Any

import csac_jax  # noqa: F401  (before JAX: it sets up the thread pool)

import jax  # isort: skip
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax import presets
from csac_jax.config import Config, TrainConfig
from csac_jax.errors import FailedError, SettingsError
from csac_jax.io import checkpoint
from csac_jax.runtime import signals
from csac_jax.training import loop
from csac_jax.training.callbacks import Record, Summary
from csac_jax.training.transitions import StepMetrics
from tests.metrics import step_metrics

E = 3  # scenes
LONG = 10_000 * E  # actions that no try comes to the end of


@struct.dataclass
class State:
    key: jax.Array
    step: jax.Array
    total: jax.Array  # [4] float32
    packed: jax.Array  # [64, 64] uint16


def config(actions: int = LONG, seed: int = 5) -> Config:
    train = TrainConfig(scenes=E, actions=actions, learning_starts=4 * E, chunk=1, save_every=1)
    return presets.smoke().change(train=dataclasses.asdict(train), seed=seed)


def first_state(seed: int = 5) -> State:
    zeros = jnp.zeros(4, jnp.float32), jnp.zeros((64, 64), jnp.uint16)
    return State(jax.random.key(seed), jnp.int32(0), *zeros)


def abstract_state() -> Any:
    return jax.eval_shape(first_state)


def step(state: State, _: None) -> tuple[State, StepMetrics]:
    outcome = (jnp.arange(E, dtype=jnp.int32) + state.step) % 5
    total = state.total + state.step.astype(jnp.float32)
    packed = 3 * state.packed + jnp.arange(64, dtype=jnp.uint16)[None]
    shown = {"outcome": outcome, "reward": outcome.astype(jnp.float32)}
    metrics = step_metrics(E, loss=jnp.float32(1.0), primitive=jnp.ones(E, jnp.int32), **shown)
    return State(state.key, state.step + 1, total, packed), metrics


def compile_chunk(num_steps: int) -> Any:
    return jax.jit(lambda state: jax.lax.scan(step, state, length=num_steps), donate_argnums=0)


class Quiet:
    """A reporter that shows nothing and sets the stop flag after `stop_after` chunks."""

    def __init__(self, stop: signals.Stop, stop_after: int) -> None:
        self._stop, self._left = stop, stop_after

    def log(self, text: str) -> None:
        pass

    def progress(self, record: Record, total_actions: int, eta: float | None) -> None:
        self._left -= 1
        if self._left == 0:
            self._stop.signal = 15


def train(
    run_dir: Path, steps: int, resume: bool = False, seed: int = 5, stop: signals.Stop | None = None
) -> Summary:
    """Trains in this process for `steps` more steps, of a run that has no end."""
    cfg, stop = config(seed=seed), stop or signals.Stop()
    begin, reporter = functools.partial(first_state, seed), Quiet(stop, steps)
    return loop.run(cfg, run_dir, begin, compile_chunk, reporter, stop, resume)


def bits(state: State) -> bytes:
    leaves = jax.random.key_data(state.key), state.step, state.total, state.packed
    return b"".join(np.asarray(leaf).tobytes() for leaf in leaves)


class Reference:
    """The states and records of an uninterrupted run, by step."""

    def __init__(self, seed: int = 5) -> None:
        self._chunk, self._state = compile_chunk(1), first_state(seed)
        self.states = [bits(self._state)]
        self.outcomes: list[dict[str, int]] = []

    def state(self, step: int) -> bytes:
        while len(self.states) <= step:
            self._state, metrics = self._chunk(self._state)
            self.states.append(bits(self._state))
            progress = loop.LoopState(0.0, [])
            record = loop.record_chunk(config(), len(self.states), metrics, progress, 1.0)[1]
            self.outcomes.append(record.outcomes)
        return self.states[step]


def fault_of(run_dir: Path, reference: Reference, saved: int) -> str | None:
    """Returns the fault of a run that saved step `saved`: that or a newer one must come back, bit
    for bit, and the log must reach as far."""
    if saved == 0 and checkpoint.latest_step(run_dir) is None:
        return None
    try:
        state, _ = checkpoint.restore(run_dir, abstract_state())
    except checkpoint.CheckpointError as error:
        return f"step {saved} cannot be restored: {error}"
    step = int(state.step)
    if step < saved:
        return f"step {saved} was saved, {step} is restored"
    if bits(state) != reference.state(step):
        return f"the state of step {step} differs"
    return _log_fault(run_dir / "metrics.jsonl", reference, step)


def _log_fault(log: Path, reference: Reference, step: int) -> str | None:
    try:
        lines = [json.loads(line) for line in log.read_text().splitlines()[:step]]
    except ValueError:
        return "the log is damaged"
    wanted = [(i + 1, outcomes) for i, outcomes in enumerate(reference.outcomes[:step])]
    return None if [(r["step"], r["outcomes"]) for r in lines] == wanted else "the log differs"


@dataclasses.dataclass(frozen=True)
class Order:
    """Task of a process: to train without end, or `steps` steps."""

    run_dir: Path
    resume: bool = False
    steps: int = LONG
    held: bool = False  # waits after its first save until it is told to go on
    user: int | None = None  # whose rights it has
    largest: int | None = None  # bytes of a file, from the second save on


class Child:
    """A process that carries out an order, and its messages."""

    def __init__(self, order: Order) -> None:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])
        self._pipe, theirs = context.Pipe()
        self._stderr, their_stderr = context.Pipe()
        arguments = (theirs, their_stderr, order)
        self.process: Any = context.Process(target=_obey, args=arguments, daemon=True)
        self.process.start()
        theirs.close()
        their_stderr.close()
        self._errors = b""
        self._reader = threading.Thread(target=self._drain, daemon=True)
        self._reader.start()
        self.saved = 0  # the last step whose save has returned
        self.error: str | None = None  # the message of one that the command line shows in one line
        self.traceback: str | None = None
        self.done = False

    def listen(self, until: float, saves: int | None = None) -> None:
        """Takes what it says for `until` s, or until it has ended or saved so many times more."""
        end = time.monotonic() + until
        with contextlib.suppress(EOFError, ConnectionResetError):
            while (left := end - time.monotonic()) > 0 and saves != 0:
                if not self._pipe.poll(left):
                    return
                kind, value = self._pipe.recv()
                setattr(self, kind, value)
                if kind == "saved" and saves is not None:
                    saves -= 1

    def _drain(self) -> None:
        with contextlib.suppress(OSError):
            while part := os.read(self._stderr.fileno(), 65536):
                self._errors += part

    def problem(self, refused: bool, killed: bool = False) -> str | None:
        """Returns the fault of its answer, if any: a traceback, an error where none may be or of
        several lines, or silence."""
        if self.traceback is not None:
            return self.traceback
        if self.error is not None and ("\n" in self.error or not refused):
            return repr(self.error)
        self._reader.join(5.0)
        if b"Traceback" in self._errors:
            return self._errors.decode(errors="replace").strip().splitlines()[-1]
        said = self.done or self.error is not None or killed
        return None if said else f"ended with {self.process.exitcode} and said nothing"

    def go(self) -> None:
        with contextlib.suppress(BrokenPipeError):
            self._pipe.send(None)

    def end(self, limit: float) -> bool:
        """Listens to its end; returns whether that came within `limit` s. Kills it if not."""
        self.listen(limit)
        self.process.join(max(limit / 10, 1.0))
        hung = self.process.is_alive()
        self.kill()
        return not hung

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.listen(0.1)


def _obey(pipe: Any, stderr: Any, order: Order) -> None:
    """Carries out an order: the main function of such a process."""
    os.dup2(stderr.fileno(), 2)
    stderr.close()
    jax.config.update("jax_platforms", "cpu")
    stop = signals.install()
    if order.user is not None:
        os.setresuid(order.user, order.user, order.user)
    save, held = checkpoint.save, [order.held]

    def saving(run_dir: Path, step: int, *rest: Any) -> Path:
        folder = save(run_dir, step, *rest)
        pipe.send(("saved", step))
        if held.pop():
            pipe.recv()
        held.append(False)
        if order.largest is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (order.largest, resource.RLIM_INFINITY))
        return folder

    checkpoint.save = saving
    warnings.simplefilter("ignore")
    try:
        train(order.run_dir, order.steps, order.resume, stop=stop)
        pipe.send(("done", True))
    except (SettingsError, FailedError, OSError) as error:
        pipe.send(("error", str(error)))
    except BaseException as error:
        pipe.send(("traceback", f"{type(error).__name__}: {error}"))
