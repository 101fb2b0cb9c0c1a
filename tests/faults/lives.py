"""Whole lives of runs, sweeps and policies, drawn at random and judged by a small model.

    python -m tests.faults.lives [--seconds N] [--seed N] [--jobs N] [--life N]

A life is a sequence of STEPS in a folder of its own; `--life` replays one. All of it is the
package's, but for the learner, which is that of `toy`. A kill is an exception before a call that
changes the disc, after which nothing changes it; then half-written files are torn.
"""

import argparse
import contextlib
import dataclasses
import functools
import itertools
import json
import logging
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import csac_jax  # noqa: F401  (before JAX: it sets up the thread pool)

import jax  # isort: skip
import numpy as np
import safetensors.numpy

from csac_jax import presets
from csac_jax.cli import output
from csac_jax.constants import GRASP_WINDOW
from csac_jax.errors import DataWarning, FailedError, SettingsError
from csac_jax.io import checkpoint, configs, files, lock, policy_file, renames
from csac_jax.io.checkpoint import CheckpointError
from csac_jax.io.lock import LockedError
from csac_jax.io.policy_file import PolicyFileError
from csac_jax.report import results
from csac_jax.runtime import provenance, signals
from csac_jax.sweeps import runner
from csac_jax.sweeps.grid import SweepPoint
from csac_jax.sweeps.runner import SweepPlan
from csac_jax.training import loop
from tests.faults import harness, toy
from tests.faults.harness import Tally
from tests.networks import random_params

CFG = presets.smoke()
REPORTED = (SettingsError, FailedError, OSError)  # what a command shows as one line
DRAFTS = re.compile(r"\.tmp$|\.saving|orbax-checkpoint-tmp")
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
CALLS = ("open", "os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate")
SWEPT = 2  # training steps of a sweep's runs
KILL = 140  # calls of a training that change the disc, about


class Killed(BaseException):
    """The end of a process that nobody asked."""


class _Hung(BaseException):
    """A step that does not end."""


class _Process:
    """The process that a step stands for: it may be killed before a call that changes the disc."""

    def __init__(self) -> None:
        self.left: int | None = None  # calls until it is killed
        self.saved: list[tuple[Path, int]] = []  # checkpoints whose save has returned
        self.locks: list[Any] = []

    def audit(self, event: str, arguments: tuple) -> None:
        if self.left is None or event not in CALLS or not _changes(event, arguments):
            return
        if self.left <= 0:
            # Orbax waits for threads that end by other exceptions.
            main = threading.current_thread() is threading.main_thread()
            raise Killed if main else OSError("killed")
        self.left -= 1

    def save(self, run_dir: Path, step: int, *rest: Any) -> Path:
        folder = _SAVE(run_dir, step, *rest)
        self.saved.append((run_dir, step))
        return folder

    def lock(self, path: Path) -> Any:
        self.locks.append(_LOCK(path))
        return self.locks[-1]


def _changes(event: str, arguments: tuple) -> bool:
    path, *rest = arguments
    if event == "open" and not (isinstance(rest[-1], int) and rest[-1] & WRITES):
        return False
    inside = isinstance(path, str | bytes | os.PathLike) and _ROOT in os.fsdecode(path)
    return inside or (event in ("os.remove", "os.rmdir") and rest[-1] != -1)


_SAVE, _LOCK, _ROOT = checkpoint.save, lock.filelock.FileLock, "csac-jax-lives-"
_process = _Process()


class _Program:
    """A compiled chunk of the toy, in the place of a jitted function."""

    def __init__(self, runs: int | None) -> None:
        chunk = toy.compile_chunk(1)
        states = jax.eval_shape(lambda: _states(range(runs)) if runs else toy.first_state())
        if runs:
            axes: Any = toy.State(key=0, step=None, total=0, packed=0)
            each = jax.vmap(toy.step, in_axes=(axes, None), out_axes=(axes, 0))
            chunk = jax.jit(lambda state: jax.lax.scan(each, state, length=1), donate_argnums=0)
        self._compiled = chunk.lower(states).compile()

    def lower(self, *_: Any) -> "_Program":
        return self

    def compile(self) -> Any:
        return self._compiled


_program = functools.cache(_Program)


def _states(seeds: Any) -> toy.State:
    """Stacks the first states of several runs, which share the step."""
    states = [toy.first_state(seed) for seed in seeds]
    stacked = jax.tree.map(lambda *leaves: jax.numpy.stack(leaves), *states)
    return stacked.replace(step=states[0].step)


@functools.cache
def _reference(seed: int) -> toy.Reference:
    return toy.Reference(seed)


_params = functools.cache(functools.partial(random_params, CFG))


class _Reporter(toy.Quiet):
    """Stops a training after some chunks; calls `meanwhile` at the first."""

    def __init__(self, stop: signals.Stop, chunks: int, meanwhile: Callable[[], object]) -> None:
        super().__init__(stop, chunks)
        self._meanwhile: Callable[[], object] | None = meanwhile

    def progress(self, *arguments: Any) -> None:
        super().progress(*arguments)
        if self._meanwhile is not None:
            self._meanwhile, meanwhile = None, self._meanwhile
            meanwhile()


def _train(run: "Run", chunks: int, meanwhile: Callable[[], object] = lambda: None) -> None:
    resume = checkpoint.latest_step(run.path) is not None
    if not resume:  # killed before its first save: there is nothing to lose
        shutil.rmtree(run.path, ignore_errors=True)
    stop = signals.Stop()
    begin = functools.partial(toy.first_state, run.seed)
    reporter: Any = _Reporter(stop, chunks, meanwhile)
    cfg = toy.config(seed=run.seed)
    loop.run(cfg, run.path, begin, lambda _: _program(None), reporter, stop, resume)


@dataclasses.dataclass
class Run:
    """A run as it must be."""

    path: Path
    seed: int
    sound: list[int] = dataclasses.field(default_factory=list)  # steps that must be there
    damaged: set[int] = dataclasses.field(default_factory=set)  # inodes of steps to be refused
    log_whole: bool = True

    def saved(self, steps: list[int], killed: bool) -> None:
        """Takes the steps whose save has returned; after a kill an older one may be removed."""
        self.sound = (self.sound + steps)[-1 if killed else -2 :]

    def inode(self, step: int) -> int:
        """Returns the number of a step's folder, which it keeps where it is moved."""
        return (self.path / checkpoint.FOLDER / str(step)).stat().st_ino

    def drafts(self) -> set[tuple[Path, int]]:
        """Returns the half-written files and folders, each with its inode."""
        found = [path for path in self.path.rglob("*") if DRAFTS.search(path.name)]
        return {(path, path.stat().st_ino) for path in found}

    def judge(self, tally: Tally, about: str) -> None:
        """Counts what is lost or wrong of a run."""
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            try:
                state, extra = checkpoint.restore(self.path, toy.abstract_state())
            except CheckpointError as error:
                tally.check(not self.sound, "lost", f"{about}: {error}")
                return
        step, reference = int(state.step), _reference(self.seed)
        tally.check(step >= max(self.sound, default=0), "lost", f"{about}: step {step} is restored")
        whole = self.inode(step) not in self.damaged
        right = toy.bits(state) == reference.state(step) and whole
        right = right and len(extra["grasps"]) == min(toy.E * step, GRASP_WINDOW)
        tally.check(right, "silent", f"{about}: step {step} is restored with other numbers")
        newest = checkpoint.latest_step(self.path) == step
        warned = any(issubclass(one.category, DataWarning) for one in told)
        tally.check(newest or warned, "silent", f"{about}: went back to {step} without a word")
        if self.log_whole:
            fault = toy._log_fault(self.path / files.METRICS, reference, step)
            tally.sound(fault, "lost", about)


@dataclasses.dataclass
class Sweep:
    """A sweep as it must be."""

    path: Path
    seed: int
    saved: dict[str, int] = dataclasses.field(default_factory=dict)  # steps by folder

    @property
    def plan(self) -> SweepPlan:
        cfg = toy.config(SWEPT * toy.E, self.seed)
        other = cfg.change(replay={"sampler": "uniform"}, seed=self.seed + 1)
        return SweepPlan(1, [SweepPoint("a", {}, cfg), SweepPoint("b", {}, other)])

    def run(self, chunks: int) -> runner.SweepResult:
        """Begins or resumes the sweep, for some chunks at most."""
        resume, stop = (self.path / files.SWEEP_PLAN).exists(), signals.Stop()
        if not resume:  # killed before its plan was written
            shutil.rmtree(self.path, ignore_errors=True)
        plan = runner.read_plan(self.path) if resume else self.plan
        reporter: Any = toy.Quiet(stop, chunks)
        return runner.run(plan, self.path, _sweep_program, reporter, stop, resume)

    def judge(self, tally: Tally, about: str) -> None:
        for name, step in self.saved.items():
            folder = self.path / name
            kept = (folder / "done").exists() or (checkpoint.latest_step(folder) or 0) >= step
            tally.check(kept, "lost", f"{about}: {name} lost step {step}")

    def judge_whole(self, tally: Tally, about: str) -> None:
        """Counts a run of the finished sweep that is not one of `train`."""
        for name, cfg in runner.runs_of(self.plan).items():
            fault = toy.fault_of(self.path / name, _reference(cfg.seed), SWEPT)
            tally.sound(fault, "lost", f"{about}: {name}")


def _sweep_program(group: Any) -> Any:
    init = functools.partial(_states, [cfg.seed for cfg in group.configs])
    return SimpleNamespace(
        init=init,
        abstract=lambda: jax.eval_shape(init),
        compile_chunk=lambda _: _program(len(group.configs)),
        replica=lambda state, i: toy.State(
            state.key[i], state.step, state.total[i], state.packed[i]
        ),
    )


@dataclasses.dataclass
class Policy:
    """A policy file as it must be."""

    path: Path
    number: int  # of its networks
    damaged: bool = False
    digest: bool = True

    def judge(self, tally: Tally, about: str) -> None:
        try:
            cfg, params = policy_file.load(self.path)
        except PolicyFileError as error:
            tally.check(self.damaged, "lost", f"{about}: {error}")
            return
        wrong = self.damaged and self.digest
        tally.check(not wrong, "silent", f"{about}: damage is unnoticed")
        same = jax.tree.map(np.array_equal, params, _params(self.number))
        right = cfg == CFG and all(jax.tree.leaves(same))
        tally.check(right or self.damaged, "silent", f"{about}: another policy is read")


class Life:
    """One life: its folder, what must be in it, and the dice."""

    def __init__(self, folder: Path, rng: np.random.Generator, tally: Tally) -> None:
        self.folder, self.rng, self.tally = folder, rng, tally
        self.runs: list[Run] = []
        self.sweeps: list[Sweep] = []
        self.policies: list[Policy] = []
        self.names = (f"{kind}{number}" for number in itertools.count() for kind in ("a", "b c"))
        self.past: list[str] = []
        self.late = 0.0  # s that the clock was put back

    def about(self) -> str:
        return " > ".join(self.past)

    def pick(self, items: list[Any]) -> Any:
        return items[int(self.rng.integers(len(items)))]

    def new(self, suffix: str = "") -> Path:
        return self.folder / f"{next(self.names)}{suffix}"

    def call(self, work: Callable[[], Any], refused: bool = False, kill: int = 0) -> bool:
        """Carries out the work of a process; returns True if it was killed or refused.

        It is killed at one of the first `kill` calls, if it comes so far. Counts an answer that is
        no single line, one where none may be, and one that never comes.
        """
        _process.left, _process.saved = int(self.rng.integers(kill)) if kill else None, []
        error: BaseException | None = None
        signal.setitimer(signal.ITIMER_REAL, 3.0 * harness.HANG)
        begun = time.monotonic()
        try:
            work()
        except (Exception, Killed, _Hung) as caught:
            error = caught.with_traceback(None)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            took = time.monotonic() - begun
            if isinstance(error, Killed):
                self._settle()
            _process.left = None
            for one in _process.locks:
                one.release(force=True)
            _process.locks.clear()
        slow = isinstance(error, _Hung) or took > harness.HANG
        self.tally.check(not slow, "hangs", f"{self.about()}: hung")
        self._judge_answer(error, refused)
        return error is not None

    def _settle(self) -> None:
        """Waits for threads of a killed process, whose next call fails, to end."""
        looks: list[Any] = []
        for _ in range(100):
            looks.append([files for _, *files in os.walk(self.folder)])
            if looks[-3:] == 3 * looks[-1:]:
                return
            time.sleep(0.02)

    def _judge_answer(self, error: BaseException | None, refused: bool) -> None:
        if error is None or isinstance(error, Killed | _Hung):
            return
        line = isinstance(error, REPORTED) and "\n" not in str(error) and refused
        about = f"{self.about()}: {type(error).__name__}: {error}"
        self.tally.check(line, "tracebacks", about)

    def run_or_new(self) -> Run:
        if not self.runs or self.rng.random() < 0.2:
            self.runs.append(Run(self.new(), int(self.rng.integers(2))))
        return self.pick(self.runs)

    def train(self, run: Run, chunks: int = 0, **how: Any) -> bool:
        """Trains some chunks more; a run without a sound step may be refused."""
        chunks = chunks or int(self.rng.integers(1, 3))
        meanwhile = how.pop("meanwhile", lambda: None)
        gone = not run.sound and checkpoint.latest_step(run.path) is not None
        how["refused"] = how.get("refused", False) or gone
        ended = self.call(lambda: _train(run, chunks, meanwhile), **how)
        run.saved([step for path, step in _process.saved if path == run.path], ended)
        return ended

    def tear(self, run: Run) -> None:
        """Tears what a killed process was writing: drafts, and a line that no save covers."""
        for path in self.folder.rglob("*"):
            if DRAFTS.search(str(path)) and path.is_file() and self.rng.random() < 0.5:
                os.truncate(path, int(self.rng.integers(path.stat().st_size + 1)))
        log = run.path / files.METRICS
        saved = checkpoint.latest_step(run.path) or 0
        if log.is_file() and log.read_bytes().count(b"\n") > saved:
            os.truncate(log, log.stat().st_size - int(self.rng.integers(1, 20)))


def train(life: Life) -> None:
    """Trains a run, new or resumed, and stops it."""
    run = life.run_or_new()
    life.train(run)
    run.judge(life.tally, life.about())


def kill(life: Life) -> None:
    """Kills a training at any call that changes the disc."""
    run = life.run_or_new()
    if life.train(run, kill=KILL):
        life.tear(run)
    run.judge(life.tally, life.about())


def fill_disc(life: Life) -> None:
    """Lets files grow to some size only, from a moment of a training on."""
    run, limits = life.run_or_new(), resource.getrlimit(resource.RLIMIT_FSIZE)
    before = run.drafts()
    largest = int(10 ** life.rng.uniform(0.0, 4.0)) - 1
    full = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (largest, limits[1]))  # noqa: E731
    try:
        life.train(run, chunks=3, meanwhile=full, refused=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    run.judge(life.tally, life.about())
    left = run.drafts() - before
    life.tally.check(not left, "lost", f"{life.about()}: left {sorted(left)}")


def two_at_once(life: Life) -> None:
    """Trains a run twice at once: the second is refused, the first continues."""
    run, answers = life.run_or_new(), []

    def second() -> None:
        try:
            resume = functools.partial(toy.first_state, run.seed)
            stop, chunk = signals.Stop(), lambda _: _program(None)
            cfg, quiet = toy.config(seed=run.seed), toy.Quiet(stop, 1)
            loop.run(cfg, run.path, resume, chunk, quiet, stop, True)  # type: ignore[arg-type]
        except LockedError as error:
            answers.append(error)

    ended = life.train(run, meanwhile=second)
    life.tally.check(answers or ended, "silent", f"{life.about()}: both train")
    run.judge(life.tally, life.about())


def corrupt(life: Life) -> None:
    """Damages a file of the newest checkpoint, or the log."""
    runs = [run for run in life.runs if checkpoint.latest_step(run.path) is not None]
    if not runs:
        return
    run, kind = life.pick(runs), life.pick(list(harness.DAMAGES))
    step = checkpoint.latest_step(run.path) or 0
    folder = run.path / checkpoint.FOLDER / str(step)
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.stat().st_size]
    log = run.path / files.METRICS
    if life.rng.random() < 0.2 and log.stat().st_size:
        run.log_whole = False
        paths = [log]
    # Arrays lie in files with random names.
    path = life.pick(sorted(paths, key=lambda path: (path.parent, path.stat().st_size, path.name)))
    harness.damage(life.rng, kind, path)
    if path.name != files.METRICS:
        run.sound = [one for one in run.sound if one != step]
        if path.name != checkpoint.MANIFEST:  # it may say the same in other letters
            run.damaged.add(run.inode(step))
    run.judge(life.tally, life.about())


def put_clock_back(life: Life) -> None:
    """Puts the clock back or forward by up to some years."""
    life.late = float(life.rng.uniform(-1e8, 1e8))


def move(life: Life) -> None:
    """Renames a folder, or moves it to another one."""
    things = [*life.runs, *life.sweeps, *life.policies]
    if things := [one for one in things if one.path.exists()]:
        one = life.pick(things)
        target = life.new(one.path.suffix)
        if life.rng.random() < 0.5:
            target = target.with_name("moved") / target.name
            target.parent.mkdir(exist_ok=True)
        one.path.rename(target)
        one.path = target
        one.judge(life.tally, life.about())


def upgrade(life: Life) -> None:
    """Turns the newest checkpoint, or a policy, into one of a former version."""
    for run in [run for run in life.runs if run.sound][:1]:
        folder = checkpoint.sound(run.path)
        record = folder / "extra" / "metadata"
        content = json.loads(record.read_text())
        for name in ("run", "step", "versions"):
            content.pop(name, None)
        record.write_text(json.dumps(content))
        files.write_json(folder / checkpoint.MANIFEST, {})
        files.write_json(folder / checkpoint.MANIFEST, checkpoint._digests(folder))
        (folder.parent / "run").unlink(missing_ok=True)
        run.judge(life.tally, life.about())
    for policy in [one for one in life.policies if not one.damaged][:1]:
        tensors = safetensors.numpy.load_file(policy.path)
        stored = {"config": json.dumps(_former(configs.to_dict(CFG)))}
        safetensors.numpy.save_file(tensors, policy.path, stored)
        policy.digest = False
        policy.judge(life.tally, life.about())


def _former(config: dict[str, Any]) -> dict[str, Any]:
    """Gives settings their former names."""
    for old, new in renames.SETTINGS.items():
        section, field = (new or ".").split(".")
        if field in config.get(section, {}):
            former, name = old.split(".")
            config[former][name] = config[section].pop(field)
    return config


def sweep(life: Life) -> None:
    """Begins or resumes a sweep; it is stopped, killed or done."""
    if not life.sweeps or life.rng.random() < 0.2:
        life.sweeps.append(Sweep(life.new(), int(life.rng.integers(2))))
    one = life.pick(life.sweeps)
    _run_sweep(life, one, int(life.rng.integers(1, 5)), 3 * KILL * int(life.rng.integers(2)))
    one.judge(life.tally, life.about())


def _run_sweep(life: Life, one: Sweep, chunks: int, kill: int = 0) -> None:
    life.call(lambda: one.run(chunks), kill=kill)
    for path, step in _process.saved:
        if path.is_relative_to(one.path):
            one.saved[str(path.relative_to(one.path))] = step


def export(life: Life) -> None:
    """Writes a policy into a new file; it may be killed."""
    policy = Policy(life.new(".safetensors"), int(life.rng.integers(4)))
    save = functools.partial(policy_file.save, policy.path, _params(policy.number), CFG)
    killed = life.call(save, kill=6)  # it makes three calls
    if not killed or policy.path.exists():
        life.policies.append(policy)
        policy.judge(life.tally, life.about())


def finetune(life: Life) -> None:
    """Reads a policy and writes another one beside it."""
    for policy in [one for one in life.policies if not one.damaged][-1:]:
        tuned = Policy(life.new(".safetensors"), (policy.number + 1) % 4)
        cfg, _ = policy_file.load(policy.path)
        params = _params(tuned.number)
        if not life.call(functools.partial(policy_file.save, tuned.path, params, cfg)):
            life.policies.append(tuned)
            tuned.judge(life.tally, life.about())
        policy.judge(life.tally, life.about())


def corrupt_policy(life: Life) -> None:
    """Damages a policy."""
    for policy in [one for one in life.policies if not one.damaged][:1]:
        harness.damage(life.rng, life.pick(list(harness.DAMAGES)), policy.path)
        policy.damaged = True
        policy.judge(life.tally, life.about())


def evaluate(life: Life) -> None:
    """Writes an evaluation beside a run's log and reports both."""
    for run in [run for run in life.runs if run.sound][:1]:
        path, share = run.path / "eval.json", {"value": 0.5, "low": 0.4, "high": 0.6, "n": 9}
        table = {"grasp_success": share, "policy": "learned", "suite": "random"}
        cfg = toy.config(seed=run.seed)
        life.call(functools.partial(output.write_result, path, table, cfg))
        found = results.read([run.path])
        whole = len(found.evaluations) == 1 and (len(found.runs) == 1 or not run.log_whole)
        life.tally.check(whole, "lost", f"{life.about()}: {found.notes}")


STEPS: dict[Callable[[Life], None], float] = {
    train: 3.0,
    kill: 4.0,
    fill_disc: 1.0,
    two_at_once: 1.0,
    corrupt: 2.0,
    put_clock_back: 1.0,
    move: 2.0,
    upgrade: 1.0,
    sweep: 1.5,
    export: 1.0,
    finetune: 1.0,
    corrupt_policy: 0.5,
    evaluate: 1.0,
}
"""The steps of a life, and how often they come."""


def live(number: int, seed: int = 0) -> Tally:
    """Lives the life of this number; its steps are the same at every call."""
    tally, rng = Tally(), np.random.default_rng([seed, number])
    share = np.array(list(STEPS.values())) / sum(STEPS.values())
    with tempfile.TemporaryDirectory(prefix=_ROOT, dir=_memory()) as name, _staged() as clock:
        life = Life(Path(name), rng, tally)
        clock.life = life
        for index in tally.each(rng.choice(len(STEPS), int(rng.integers(3, 9)), p=share)):
            step = list(STEPS)[index]
            life.past.append(step.__name__)
            step(life)
        life.past.append("end")
        for one in life.sweeps:
            _run_sweep(life, one, 10)
            one.judge_whole(tally, life.about())
        for run in life.runs:
            life.train(run, chunks=1)
            run.judge(tally, life.about())
        for policy in life.policies:
            policy.judge(tally, life.about())
        tally.remarks = [f"life {number}: {one.replace(name, '')}" for one in tally.remarks]
    return tally


def _memory() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


@contextlib.contextmanager
def _staged() -> Iterator[SimpleNamespace]:
    """Puts the toy in the place of the learner, and the life's clock in that of the machine's."""
    now, clock = time.time, SimpleNamespace(life=SimpleNamespace(late=0.0))

    def hang(*_: object) -> None:
        raise _Hung

    before = signal.signal(signal.SIGALRM, hang)
    versions = provenance.versions()
    with (
        mock.patch.object(checkpoint, "save", _process.save),
        mock.patch.object(lock.filelock, "FileLock", _process.lock),
        mock.patch.object(provenance, "versions", return_value=versions),
        mock.patch.object(loop.memory, "compiled_text", return_value=""),
        mock.patch.object(time, "time", side_effect=lambda: now() - clock.life.late),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        _audit()
        try:
            yield clock
        finally:
            signal.signal(signal.SIGALRM, before)


@functools.cache
def _audit() -> None:
    sys.addaudithook(_process.audit)  # for good: there is no way to remove it


def _live_part(part: int, jobs: int, seconds: float, seed: int) -> list[Tally]:
    logging.disable()  # of Orbax, whose threads end like those of a killed process
    end, tallies = time.monotonic() + seconds, []
    for number in itertools.count(part, jobs):
        if time.monotonic() > end:
            return tallies
        tallies.append(live(number, seed))
        print("".join(f"{remark}\n" for remark in tallies[-1].remarks), end="", flush=True)
    raise AssertionError


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--life", type=int)
    given = parser.parse_args()
    if given.life is not None:
        tallies = [live(given.life, given.seed)]
        print(*tallies[0].remarks, sep="\n")
    else:
        with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
            asked = (given.jobs, given.seconds, given.seed)
            parts = [pool.submit(_live_part, part, *asked) for part in range(given.jobs)]
            tallies = [tally for part in parts for tally in part.result()]
    names = ("tries", "lost", "silent", "tracebacks", "hangs")
    sums = {name: sum(getattr(tally, name) for tally in tallies) for name in names}
    counts = ", ".join(f"{count} {name}" for name, count in sums.items())
    print(f"{len(tallies)} lives: {counts.replace('tries', 'steps')}")
    return int(any(tally.bad for tally in tallies))


if __name__ == "__main__":
    sys.exit(main())
