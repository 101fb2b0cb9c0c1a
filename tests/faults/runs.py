"""Faults of running trainings and of their folders."""

import contextlib
import functools
import itertools
import os
import re
import shutil
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import presets
from csac_jax.errors import DataWarning
from csac_jax.io import checkpoint, files
from csac_jax.sweeps import runner
from csac_jax.sweeps.grid import SweepPoint
from csac_jax.training import loop, programs, step, transitions
from csac_jax.training.loop import TrainingError
from tests.faults import harness, toy, toy_cli
from tests.faults.harness import MissingToolError, Tally, fault

WORK = 60.0  # s: what starting a process and its saves may take on a busy machine
CALLS = "openat,mkdir,rename,unlink,unlinkat,rmdir,write,pwrite64,fsync,ftruncate"


class _Run:
    """A run that processes resume again and again, and what is known of it."""

    def __init__(self, folder: Path, tally: Tally, seed: int = 5) -> None:
        self.folder, self.tally, self.seed, self.saved = folder, tally, seed, 0
        self._reference = toy.Reference(seed)

    def order(self, **more: object) -> toy.Order:
        """An order to go on."""
        begun = checkpoint.latest_step(self.folder) is not None
        if not begun:  # killed before its first save: there is nothing to lose
            shutil.rmtree(self.folder, ignore_errors=True)
        return toy.Order(self.folder, begun, self.seed, **more)

    def judge(
        self, child: toy.Child, about: str, refused: bool = False, killed: bool = False
    ) -> None:
        """Counts what came of a process that has ended; whether it may have refused, was killed."""
        self.tally.tries += 1
        self.saved = max(self.saved, child.saved)
        if problem := child.problem(refused, killed):
            self.tally.count("tracebacks", f"{about}: {problem}")
        if found := toy.fault_of(self.folder, self._reference, self.saved):
            self.tally.count("lost", f"{about}: {found}")

    def left_over(self, about: str) -> None:
        """Counts what a save that failed has left."""
        drafts = re.compile(r"\.tmp$|\.saving|orbax-checkpoint-tmp")
        for path in self.folder.rglob("*"):
            if drafts.search(path.name):
                self.tally.count("lost", f"{about}: left {path}")


@fault("SIGKILL at a random time", tries=100)
def sigkill(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """Runs of ten processes, each killed within its first second or so; the next one resumes."""
    tally = Tally()
    for number in range(-(-tries // 10)):
        run = _Run(folder / str(number), tally)
        for _ in range(min(10, tries - tally.tries)):
            child = toy.Child(run.order())
            about = f"try {tally.tries}"
            if rng.random() < 0.8:
                child.listen(WORK, saves=int(rng.integers(1, 4)))
            child.listen(float(rng.uniform(0.0, 0.4)))
            child.kill()
            run.judge(child, about, killed=True)
    return tally


@fault("SIGTERM", tries=20)
def sigterm(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """A run that is told to stop saves and ends, complete to the step that its log ends with."""
    tally = Tally()
    run = _Run(folder / "run", tally)
    for number in range(tries):
        child = toy.Child(run.order())
        child.listen(WORK, saves=1)
        child.listen(float(rng.uniform(0.0, 0.3)))
        child.process.terminate()
        if not child.end(harness.HANG):
            tally.count("hangs", f"try {number}: did not end")
        run.judge(child, f"try {number}")
        steps = len((run.folder / "metrics.jsonl").read_text().splitlines())
        if steps != run.saved or not child.done:
            tally.count("lost", f"try {number}: ends at step {steps}, saved {run.saved}")
    return tally


def _calls(folder: Path) -> list[tuple[str, int]]:
    """The system calls that write, of a chunk and its save: (name, number of it in a thread)."""
    log = folder / "calls"
    child = toy.Child(toy.Order(folder / "counted", steps=2, held=True))
    child.listen(WORK, saves=1)
    with _strace(child.process.pid, "-o", str(log), "-e", f"trace={CALLS}"):
        child.go()
        child.end(WORK)
    counts: dict[tuple[str, str], int] = {}
    calls: set[tuple[str, int]] = set()
    for thread, name, rest in re.findall(r"^(\d+) +(\w+)\((.*)$", log.read_text(), re.MULTILINE):
        counts[thread, name] = counts.get((thread, name), 0) + 1
        if name != "openat" or "O_CREAT" in rest:
            calls.add((name, counts[thread, name]))
    return sorted(calls)


@contextlib.contextmanager
def _strace(process: int, *arguments: str):
    """In the block all threads of a process are traced."""
    if shutil.which("strace") is None:
        raise MissingToolError("strace is not installed")
    command = ["strace", "-f", "-p", str(process), *arguments]
    tracer = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        assert tracer.stderr is not None
        said = tracer.stderr.readline()
        if "not permitted" in said:  # else it has ended already, and is judged
            raise MissingToolError(f"strace cannot trace: {said.strip()}")
        yield
    finally:
        tracer.terminate()
        tracer.communicate()


def _chosen(rng: np.random.Generator, calls: list, tries: int) -> list:
    """All of them, in turn, or as many as there are tries, at random."""
    if tries >= len(calls):
        return calls
    return [calls[i] for i in sorted(rng.choice(len(calls), tries, replace=False))]


@fault("SIGKILL at a system call of a save", tries=400, slow=True)
def sigkill_in_save(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """Every call that writes, of a chunk, its log and its save."""
    tally = Tally()
    run = _Run(folder / "run", tally)
    for name, number in _chosen(rng, _calls(folder), tries):
        child = toy.Child(run.order(held=True, steps=2))
        child.listen(WORK, saves=1)
        inject = f"inject={name}:signal=KILL:when={number}"
        with _strace(child.process.pid, "-o", "/dev/null", "-e", f"trace={name}", "-e", inject):
            child.go()
            child.end(WORK)
        run.judge(child, f"{name} {number}", killed=True)
    return tally


@fault("disc full from a system call on", tries=200)
def disc_full(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """ENOSPC from every call on that could need room, in turn; see `file_too_large` for `write`."""
    tally = Tally()
    run = _Run(folder / "run", tally)
    needs = ("mkdir", "openat", "pwrite64", "fsync", "ftruncate", "rename")
    calls = [call for call in _calls(folder) if call[0] in needs]
    for name, number in _chosen(rng, calls, tries):
        child = toy.Child(run.order(held=True, steps=2))
        child.listen(WORK, saves=1)
        since = "" if name == "openat" else "+"  # to clean up is to open folders
        inject = f"inject={name}:error=ENOSPC:when={number}{since}"
        with _strace(child.process.pid, "-o", "/dev/null", "-e", f"trace={name}", "-e", inject):
            child.go()
            ended = child.end(WORK)
        _judge_full(run, child, ended, f"{name} {number}")
    return tally


@fault("disc full in the middle of a file", tries=60)
def file_too_large(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """Writes beyond some size fail (RLIMIT_FSIZE), whatever the file."""
    tally = Tally()
    run = _Run(folder / "run", tally)
    for _ in range(tries):
        largest = int(10 ** rng.uniform(0.0, 4.0)) - 1
        child = toy.Child(run.order(largest=largest, steps=2))
        ended = child.end(WORK)
        _judge_full(run, child, ended, f"files up to {largest} bytes")
    return tally


def _judge_full(run: _Run, child: toy.Child, ended: bool, about: str) -> None:
    """A run on a disc that is full says so in one line, and leaves no drafts."""
    if not ended:
        run.tally.count("hangs", f"{about}: hung")
    run.judge(child, about, refused=True)
    run.left_over(about)


def _damaged(kind: str):
    """The fault of damage to one file among all under a run's checkpoints."""

    def inject(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
        tally = Tally()
        sound, copy = folder / "sound", folder / "copy"
        toy.train(sound, 3)
        reference = toy.Reference()
        names = [path for path in sorted(sound.rglob("checkpoints/**/*")) if path.is_file()]
        names = [path.relative_to(sound) for path in names if path.stat().st_size]
        for _ in range(tries):
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(sound, copy)
            name = names[int(rng.integers(len(names)))]
            about = harness.damage(rng, kind, copy / name)
            tally.tries += 1
            step = _judge_restored(tally, copy, reference, at_least=2, about=about)
            if step == 3 and name.parts[1] == "3" and name.name != checkpoint.MANIFEST:
                tally.count("silent", f"{about}: unnoticed")
        return tally

    fault(f"{kind} in a checkpoint", tries=200)(inject)


def _judge_restored(
    tally: Tally, run_dir: Path, reference: toy.Reference, at_least: int, about: str
) -> int | None:
    """Counts a run whose newest sound state is not right, or lies before step `at_least`; returns
    its step."""
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            cfg = checkpoint.load_config(run_dir)
            state, extra = checkpoint.restore(run_dir, toy.abstract_state())
    except Exception as error:
        tally.count("lost", f"{about}: {type(error).__name__}: {error}")
        return None
    step = int(state.step)
    right = toy.bits(state) == reference.state(step) and len(extra["grasps"]) == toy.E * step
    if not right or cfg != toy.config():
        tally.count("silent", f"{about}: step {step} is restored with other numbers")
    if step < at_least:
        tally.count("lost", f"{about}: step {step} is restored")
    newest = checkpoint.latest_step(run_dir)
    if step != newest and not any(issubclass(one.category, DataWarning) for one in caught):
        tally.count("silent", f"{about}: went back from step {newest} to {step} without a word")
    return step


for _kind in harness.DAMAGES:
    _damaged(_kind)


def _swapped(steps: Path, other: Path) -> dict[str, Callable[[], object]]:
    """What can happen to the folders of two runs, with steps 2 and 3."""

    def turn_round() -> None:
        (steps / "2").rename(steps / "x")
        (steps / "3").rename(steps / "2")
        (steps / "x").rename(steps / "3")

    def replace_newest() -> None:
        shutil.rmtree(steps / "3")
        shutil.copytree(other / "3", steps / "3")

    return {
        "newest one is another run's": replace_newest,
        "newer one is another run's": lambda: shutil.copytree(other / "3", steps / "4"),
        "newer one is a link to another run's": lambda: (steps / "4").symlink_to(other / "3"),
        "steps have each other's names": turn_round,
        "newest one has a newer name": lambda: (steps / "3").rename(steps / "9"),
        "older one has a newer name": lambda: (steps / "2").rename(steps / "9"),
        "newest one is missing": lambda: shutil.rmtree(steps / "3"),
        "state is missing": lambda: shutil.rmtree(steps / "3" / "state"),
        "extra is missing": lambda: shutil.rmtree(steps / "3" / "extra"),
        "manifest is missing": lambda: (steps / "3" / checkpoint.MANIFEST).unlink(),
        "file too many": lambda: (steps / "3" / "state" / "more").write_text("x"),
        "empty folder with a newer name": lambda: (steps / "9").mkdir(),
        "file with a newer name": lambda: (steps / "9").write_text("x"),
        "superscript digit": lambda: (steps / "\u00b2").mkdir(),
        "leading zero": lambda: shutil.copytree(other / "3", steps / "007"),
        "many digits": lambda: (steps / ("9" * 30)).mkdir(),
        "name of the run is missing": lambda: (steps / "run").unlink(),
        "name of the run is empty": lambda: (steps / "run").write_text(""),
        "log is a folder of the draft's name": lambda: (steps / ".saving").mkdir(),
    }


@fault("swapped, missing and foreign step folders", tries=19)
def swapped(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """The right steps remain, or those before them; the run goes on from there."""
    tally = Tally()
    for name, seed in (("sound", 5), ("other", 6)):
        toy.train(folder / name, 3, seed=seed)
    other, reference = folder / "other", toy.Reference()
    before = _content(other)
    cases = list(_swapped(folder, folder))
    for name in _chosen(rng, cases, tries):
        run_dir = folder / f"{tally.tries}"
        shutil.copytree(folder / "sound", run_dir)
        _swapped(run_dir / "checkpoints", other / "checkpoints")[name]()
        tally.tries += 1
        if name == "steps have each other's names":
            _put_names_right(tally, run_dir, name)
        _judge_restored(tally, run_dir, reference, at_least=2, about=name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _judge_resumed(tally, run_dir, reference, name)
    if _content(other) != before:
        tally.count("lost", "the other run has changed")
    return tally


def _put_names_right(tally: Tally, run_dir: Path, about: str) -> None:
    """Follows the message that refuses steps with each other's names."""
    try:
        checkpoint.sound(run_dir)
        tally.count("silent", f"{about}: taken")
    except checkpoint.CheckpointError as error:
        if "rename it to 2" not in str(error):
            tally.count("lost", f"{about}: {error}")
    steps = run_dir / "checkpoints"
    _swapped(steps, steps)["steps have each other's names"]()


def _judge_resumed(tally: Tally, run_dir: Path, reference: toy.Reference, about: str) -> None:
    """Counts a run that does not go on, or not to the right numbers."""
    try:
        summary = toy.train(run_dir, 2, resume=True)
    except Exception as error:
        tally.count("lost", f"{about}: resumed, {type(error).__name__}: {error}")
        return
    if found := toy.fault_of(run_dir, reference, summary.step):
        tally.count("lost", f"{about}: resumed, {found}")


def _content(folder: Path) -> dict[str, bytes]:
    """Every file of a folder."""
    paths = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@fault("two resumes at once", tries=10)
def two_at_once(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """The second is refused; once the first is killed, another one goes on."""
    tally = Tally()
    run = _Run(folder / "run", tally)
    for number in range(tries):
        first = toy.Child(run.order(held=True))
        first.listen(WORK, saves=1)
        second = toy.Child(run.order(steps=1))
        about = f"try {number}"
        if not second.end(WORK):
            tally.count("hangs", f"{about}: the second hung")
        if second.error is None or "in use by process" not in second.error:
            tally.count("silent", f"{about}: the second said {second.error!r}")
        if rng.random() < 0.5:
            first.go()
        first.kill()
        run.judge(first, about, killed=True)
    return tally


@fault("a loss or parameter that is not finite", tries=20)
def not_finite(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """Training stops; the last good checkpoint stays the newest, and is what is restored."""
    tally = Tally()
    reference = toy.Reference()
    for number in range(tries):
        run_dir, step = folder / str(number), int(rng.integers(1, 4))
        kind = ("loss", "parameter")[number % 2]
        bad = toy.Losses(**{kind: step})
        about = f"{kind} of step {step}"
        tally.tries += 1
        train = functools.partial(toy.train, run_dir, 6, bad=bad)
        harness.refused(tally, about, train, TrainingError)
        if found := toy.fault_of(run_dir, reference, step):
            tally.count("lost", f"{about}: {found}")
        if (newest := checkpoint.latest_step(run_dir)) != step:
            tally.count("silent", f"{about}: step {newest} was saved")
    return tally


@fault("clock that goes backwards", tries=10)
def clock(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """At each look the wall clock shows an earlier time; the run goes on and its log is whole."""
    tally = Tally()
    reference = toy.Reference()
    for number in range(tries):
        run_dir, about = folder / str(number), f"try {number}"

        now = itertools.accumulate(rng.exponential(600.0, 100_000), lambda a, b: a - b, initial=2e9)
        tally.tries += 1
        with mock.patch.object(time, "time", functools.partial(next, now)):
            try:
                toy.train(run_dir, 2)
                toy.train(run_dir, 2, resume=True)
            except Exception as error:
                tally.count("tracebacks", f"{about}: {type(error).__name__}: {error}")
        if found := toy.fault_of(run_dir, reference, 4):
            tally.count("lost", f"{about}: {found}")
        seconds = [line["seconds"] for line in files.read_log(run_dir / "metrics.jsonl")]
        if min(seconds) < 0.0 or seconds != sorted(seconds):
            tally.count("silent", f"{about}: the log's seconds are {seconds}")
    return tally


@fault("read-only folders", tries=12)
def read_only(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """A run that may not write says so in one line, and changes nothing."""
    tally = Tally()
    with tempfile.TemporaryDirectory() as name:  # pytest's own are closed to other users
        base = Path(name)
        base.chmod(0o755)
        toy.train(base / "run", 2)
        places = [base / "run", base / "run" / "checkpoints", base / "new"]
        user = 65534 if os.geteuid() == 0 else None  # root writes anywhere
        before = _content(base)
        for number in range(tries):
            place = places[number % len(places)]
            run_dir = place if place.name == "new" else base / "run"
            closed = base if place.name == "new" else place
            mode = closed.stat().st_mode
            closed.chmod(0o555)
            child = toy.Child(toy.Order(run_dir, place.name != "new", steps=1, user=user))
            ended = child.end(WORK)
            closed.chmod(mode)
            tally.tries += 1
            _judge_refusal(tally, child, ended, f"{place.name} is read-only")
        if _content(base) != before:
            tally.count("lost", "a file has changed")
    return tally


def _judge_refusal(tally: Tally, child: toy.Child, ended: bool, about: str) -> None:
    if not ended:
        tally.count("hangs", f"{about}: hung")
    elif problem := child.problem(refused=True):
        tally.count("tracebacks", f"{about}: {problem}")
    elif child.error is None:
        tally.count("silent", f"{about}: was not refused")


NAMES = (
    "a b",
    "it's",
    'say "so"',
    "\u5b66\u4e60",
    "\u00fcb\u00e9r",
    "\U0001f916",
    "$HOME;`x`",
    "-rf",
    "a#b%20&c",
    "a{b}|c<d>",
    "x" * 200,
)


REFUSED = ("[a-z]", "a*", "a?", "back\\slash", "\udcff")


@fault("paths with spaces, quotes and non-Latin letters", tries=len(NAMES) + len(REFUSED))
def odd_paths(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """A run in such a folder is trained, saved, resumed and restored as any other, or refused
    before anything is trained."""
    tally = Tally()
    reference = toy.Reference()
    for name in _chosen(rng, [*NAMES, *REFUSED], tries):
        run_dir = folder / name / "run"
        tally.tries += 1
        if name in REFUSED:
            train = functools.partial(toy.train, run_dir, 1)
            harness.refused(tally, ascii(name), train, checkpoint.CheckpointError)
            continue
        try:
            toy.train(run_dir, 1)
        except Exception as error:
            tally.count("tracebacks", f"{name}: {type(error).__name__}: {error}")
            continue
        _judge_resumed(tally, run_dir, reference, name)
    return tally


@fault("closed pipe, full or missing stdout", tries=12)
def closed_pipe(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """`train ... | head -1` and the like: the run goes on, is saved and its result is written."""
    tally = Tally()
    reference = toy.Reference()
    steps = 6
    ends = ["head", "true", "/dev/full", ">&-", "2>&-", "2>/dev/full"]
    for number in range(tries):
        end, run_dir = ends[number % len(ends)], folder / f"run {number}"
        tally.tries += 1
        answer = _with_stdout(end, run_dir, folder / f"{number}.json", steps)
        about = f"stdout is {end}"
        harness.judge(tally, answer, about)
        found = toy.fault_of(run_dir, reference, steps)
        written = (run_dir / "train.json", folder / f"{number}.json")
        if found is None and not all(path.is_file() for path in written):
            found = "there is no result"
        if found:
            tally.count("lost", f"{about}: {found}; {answer.code} {answer.errors[-300:]!r}")
    return tally


def _with_stdout(end: str, run_dir: Path, result: Path, steps: int) -> harness.Answer:
    """The command line's answer where its output ends so."""
    options = ["smoke", "--run-dir", str(run_dir), "--json", str(result), "--seed", "5"]
    options += ["--train.actions", str(steps * toy.E), *toy_cli.OPTIONS]
    arguments = ["-m", "tests.faults.toy_cli", "train", *options]
    if ">" in end:  # a shell closes it
        shell = ["sh", "-c", f'exec "$@" {end}', "sh"]
        return harness.command(arguments, WORK, prefix=shell)
    if end == "/dev/full":
        return harness.command(arguments, WORK, prefix=["sh", "-c", 'exec "$@" >/dev/full', "sh"])
    process = harness.start(arguments)
    assert process.stdout is not None
    if end == "head":
        process.stdout.readline()
    process.stdout.close()
    process.stdout = None
    return harness.wait(process, WORK)


IMPORT_IN_THREAD = """
import threading, warnings
found = []
def work():
    import csac_jax
    from tests.faults import toy
    from pathlib import Path
    found.append(toy.train(Path({run!r}), 2).step)
thread = threading.Thread(target=work)
thread.start()
thread.join()
print(found)
"""
FORK_BEFORE = """
import os
import csac_jax
from pathlib import Path
from tests.faults import toy
if os.fork() == 0:
    toy.train(Path({run!r}), 2)
    os._exit(0)
print([2] if os.wait()[1] == 0 else os.wait())
"""
FORK_AFTER = """
import os, sys
import csac_jax
from pathlib import Path
from tests.faults import toy
step = toy.train(Path({run!r}), 2).step
sys.stdout.flush()
if os.fork() == 0:
    os._exit(0)
assert os.wait()[1] == 0
toy.train(Path({run!r}), 1, resume=True)
print([step])
"""


@fault("fork, and import in a thread", tries=6)
def fork_and_thread(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """Training works in a thread that imports the package, and in a child forked before JAX has
    started; a child forked later, that leaves JAX alone, does no harm."""
    tally = Tally()
    sources = [IMPORT_IN_THREAD, FORK_BEFORE, FORK_AFTER]
    for number in range(tries):
        run_dir = folder / str(number)
        source = sources[number % len(sources)].format(run=str(run_dir))
        tally.tries += 1
        answer = harness.command(["-c", source], WORK)
        about = ("import in a thread", "fork before", "fork after")[number % len(sources)]
        harness.judge(tally, answer, about)
        if answer.code != 0 or "[2]" not in answer.output:
            tally.count("lost", f"{about}: {answer.code} {answer.errors[-300:]!r}")
        elif found := toy.fault_of(run_dir, toy.Reference(), 2):
            tally.count("lost", f"{about}: {found}")
    return tally


VICTIMS = (
    "../victim",
    "..",
    ".",
    "",
    "/",
    "../victim/",
    "a/../../victim",
    "{root}/victim",
    "a\0b",
    None,
    7,
    ["a"],
    "groups",
    "sweep.json",
    "link",
    "..\\victim",
)


@fault("names of sweeps that lead elsewhere", tries=len(VICTIMS))
def sweep_names(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """`sweep --resume` refuses a sweep.json with such a name, whatever its digest, or stays within
    its own folder."""
    tally = Tally()
    for name in _chosen(rng, list(VICTIMS), tries):
        own = folder / str(tally.tries)
        victim, sweep = own / "victim", own / "sweep"
        for seed in (5, 6):
            toy.train(victim / f"seed-{seed}", 3, seed=seed)
        sweep.mkdir()
        (sweep / "link").symlink_to(victim)
        before = _content(victim)
        shown = name.format(root=own) if isinstance(name, str) else name
        point = SweepPoint(shown, {}, toy.config())  # type: ignore[arg-type]
        (sweep / "sweep.json").write_text(runner.plan_text(runner.SweepPlan(2, [point])))
        tally.tries += 1
        about = f"name {name!r}"

        def resume(sweep: Path = sweep) -> None:
            plan = runner.read_plan(sweep)
            reporter = toy.Quiet(stop_after=2)
            runner.run(plan, sweep, _sweep_program, reporter, reporter.stop, resume=True)

        harness.refused(tally, about, resume, runner.SweepError)
        if _content(victim) != before:
            tally.count("lost", f"{about}: the victim has changed")
    return tally


def _sweep_program(group: object) -> SimpleNamespace:
    """In place of a `SweepProgram`, of two seeds."""

    def init() -> toy.State:
        states = [toy.first_state(seed) for seed in (5, 6)]
        both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
        return both.replace(step=jnp.int32(0))

    axes = toy.State(key=0, step=None, total=0, packed=0)  # type: ignore[arg-type]

    def compile_chunk(num_steps: int) -> object:
        one = toy.compile_chunk(num_steps)
        return jax.jit(jax.vmap(one, in_axes=(axes,), out_axes=(axes, 1)))

    def replica(state: toy.State, index: int) -> toy.State:
        return toy.State(state.key[index], state.step, state.total[index], state.packed[index])

    return SimpleNamespace(
        init=init,
        compile_chunk=compile_chunk,
        replica=replica,
        abstract=lambda: jax.eval_shape(init),
    )


@fault("NaN in one of 64 scenes, a reward, a gradient, a weight", tries=20, slow=True)
def nan_in_training(rng: np.random.Generator, tries: int, folder: Path) -> Tally:
    """The real training step. A scene's NaN stays there and is counted; NaN that reaches the
    networks is told at once."""
    tally = Tally()
    cfg = presets.smoke().change(
        sim={"physics": "c"},
        replay={"capacity": 128},
        train={"scenes": 64, "learning_starts": 64, "actions": 6400},
    )
    program = programs.make(cfg)
    compiled = programs.compile_chunk(program, 1).lower(start := programs.init(program)).compile()

    def run(state: step.TrainState) -> tuple[step.TrainState, transitions.StepMetrics]:
        state, metrics = compiled(jax.tree.map(jnp.copy, state))
        return state, jax.device_get(metrics)

    start, _ = run(start)
    for number in range(tries):
        kind = ("scene", "reward", "gradient", "weight")[number % 4]
        tally.tries += 1
        state, told = start, None
        for _ in range(100 if kind == "reward" else 1):  # until it is drawn
            state, metrics = run(_poisoned(rng, state, kind))
            if told := loop.not_finite(metrics):
                break
        sound = _finite(state.learner) and _finite(state.scenes)
        expected = told is None if kind == "scene" else told is not None
        diverged = int(metrics.physics_diverged.sum())
        if sound != (told is None) or not expected or (kind == "scene" and diverged != 1):
            tally.count("silent", f"NaN in a {kind}: told {told}, sound {sound}, {diverged} scenes")
    return tally


def _poisoned(rng: np.random.Generator, state: step.TrainState, kind: str) -> step.TrainState:
    """The state with one NaN more."""

    def spoilt(leaf: jax.Array) -> jax.Array:
        flat = np.array(leaf)
        flat.reshape(-1)[rng.integers(flat.size)] = np.nan
        return jnp.asarray(flat)

    if kind == "scene":
        scene = state.scenes.scene
        spoilt_scene = scene.replace(velocity=spoilt(scene.velocity))
        return state.replace(scenes=state.scenes.replace(scene=spoilt_scene))
    if kind == "reward":
        items = state.replay.items
        items = items.replace(reward=items.reward.at[int(rng.integers(128))].set(jnp.nan))
        return state.replace(replay=state.replay.replace(items=items))
    # Adam's moments keep what a gradient was
    part = "critic_optimiser" if kind == "gradient" else str(rng.choice(["online", "target"]))
    leaves, structure = jax.tree.flatten(getattr(state.learner, part))
    floats = [i for i, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    chosen = int(rng.choice(floats))
    leaves[chosen] = spoilt(leaves[chosen])
    poisoned = {part: jax.tree.unflatten(structure, leaves)}
    return state.replace(learner=state.learner.replace(**poisoned))


def _finite(tree: object) -> bool:
    leaves = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return all(bool(jnp.isfinite(leaf).all()) for leaf in leaves)
