"""Faults of running trainings and of their folders."""

import contextlib
import functools
import os
import re
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from csac_jax.errors import DataWarning
from csac_jax.io import checkpoint
from tests.faults import harness, toy, toy_cli
from tests.faults.harness import MissingToolError, Tally, fault

Rng = np.random.Generator
WORK = 60.0  # s: what starting a process and its saves may take on a busy machine
CALLS = "openat,mkdir,rename,unlink,unlinkat,rmdir,write,pwrite64,fsync,ftruncate"


class _Run:
    """A run that processes resume again and again, and its last saved step."""

    def __init__(self, folder: Path, tally: Tally) -> None:
        self.folder, self.tally, self.saved = folder, tally, 0
        self._reference = toy.Reference()

    def child(self, saves: int | None = None, wait: float = 0.0, **more: object) -> toy.Child:
        begun = checkpoint.latest_step(self.folder) is not None
        if not begun:  # killed before its first save: there is nothing to lose
            shutil.rmtree(self.folder, ignore_errors=True)
        child = toy.Child(toy.Order(self.folder, begun, **more))
        if saves:
            child.listen(WORK, saves=saves)
        if wait:
            child.listen(wait)
        return child

    def judge(self, child: toy.Child, about: str, refused: bool = False, kill: bool = False):
        self.saved = max(self.saved, child.saved)
        self.tally.sound(child.problem(refused, kill), "tracebacks", about)
        found = toy.fault_of(self.folder, self._reference, self.saved)
        self.tally.sound(found, "lost", about)

    def judge_full(self, child: toy.Child, ended: bool, about: str) -> None:
        self.tally.check(ended, "hangs", f"{about}: hung")
        self.judge(child, about, refused=True)
        drafts = re.compile(r"\.tmp$|\.saving|orbax-checkpoint-tmp")
        left = [path for path in self.folder.rglob("*") if drafts.search(path.name)]
        self.tally.check(not left, "lost", f"{about}: left {left}")


@fault("SIGKILL at a random time", tries=100)
def sigkill(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Kills ten processes of a run, each within its first second or so; the next one resumes."""
    for number in tally.each(range(tries)):
        if number % 10 == 0:
            run = _Run(folder / str(number), tally)
        saves = int(rng.integers(1, 4)) if rng.random() < 0.8 else None
        child = run.child(saves, float(rng.uniform(0.0, 0.4)))
        child.kill()
        run.judge(child, f"try {number}", kill=True)


@fault("SIGTERM", tries=20)
def sigterm(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Stops a run; it saves and ends, complete to the last step of its log."""
    run = _Run(folder / "run", tally)
    for number in tally.each(range(tries)):
        child = run.child(1, float(rng.uniform(0.0, 0.3)))
        child.process.terminate()
        tally.check(child.end(harness.HANG), "hangs", f"try {number}: did not end")
        run.judge(child, f"try {number}")
        steps = len((run.folder / "metrics.jsonl").read_text().splitlines())
        good = steps == run.saved and child.done
        tally.check(good, "lost", f"try {number}: ends at step {steps}, saved {run.saved}")


def _calls(folder: Path) -> list[tuple[str, int]]:
    log = folder / "calls"
    child = toy.Child(toy.Order(folder / "counted", steps=2, held=True))
    child.listen(WORK, saves=1)
    with _strace(child, "-o", str(log), "-e", f"trace={CALLS}"):
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
def _strace(child: toy.Child, *arguments: str) -> Iterator[None]:
    if shutil.which("strace") is None:
        raise MissingToolError("strace is not installed")
    command = ["strace", "-f", "-p", str(child.process.pid), *arguments]
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


def _chosen(rng: Rng, items: list, tries: int) -> list:
    if tries >= len(items):
        return items
    return [items[i] for i in sorted(rng.choice(len(items), tries, replace=False))]


def _injected(run: _Run, name: str, inject: str) -> tuple[toy.Child, bool]:
    child = run.child(1, held=True, steps=2)
    with _strace(child, "-o", "/dev/null", "-e", f"trace={name}", "-e", f"inject={name}:{inject}"):
        child.go()
        return child, child.end(WORK)


@fault("SIGKILL at a system call of a save", tries=400, slow=True)
def sigkill_in_save(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Kills at every call that writes, of a chunk, its log and its save."""
    run = _Run(folder / "run", tally)
    for name, number in tally.each(_chosen(rng, _calls(folder), tries)):
        child, _ = _injected(run, name, f"signal=KILL:when={number}")
        run.judge(child, f"{name} {number}", kill=True)


@fault("disc full from a system call on", tries=200)
def disc_full(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Returns ENOSPC from every call on that could need room; for `write` see `file_too_large`."""
    run = _Run(folder / "run", tally)
    needs = ("mkdir", "openat", "pwrite64", "fsync", "ftruncate", "rename")
    calls = [call for call in _calls(folder) if call[0] in needs]
    for name, number in tally.each(_chosen(rng, calls, tries)):
        since = "" if name == "openat" else "+"  # to clean up is to open folders
        child, ended = _injected(run, name, f"error=ENOSPC:when={number}{since}")
        run.judge_full(child, ended, f"{name} {number}")


@fault("disc full in the middle of a file", tries=60)
def file_too_large(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Fails writes beyond some size (RLIMIT_FSIZE), whatever the file."""
    run = _Run(folder / "run", tally)
    for _ in tally.each(range(tries)):
        largest = int(10 ** rng.uniform(0.0, 4.0)) - 1
        child = run.child(largest=largest, steps=2)
        run.judge_full(child, child.end(WORK), f"files up to {largest} bytes")


def _damaged(kind: str, tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Damages one file among all under a run's checkpoints."""
    sound, copy = folder / "sound", folder / "copy"
    toy.train(sound, 3)
    reference = toy.Reference()
    paths = [path for path in sorted(sound.rglob("checkpoints/**/*")) if path.is_file()]
    names = [path.relative_to(sound) for path in paths if path.stat().st_size]
    for _ in tally.each(range(tries)):
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(sound, copy)
        name = names[int(rng.integers(len(names)))]
        about = harness.damage(rng, kind, copy / name)
        step = _judge_restored(tally, copy, reference, about)
        spared = step != 3 or name.parts[1] != "3" or name.name == checkpoint.MANIFEST
        tally.check(spared, "silent", f"{about}: unnoticed")


for _kind in harness.DAMAGES:
    fault(f"{_kind} in a checkpoint", tries=200)(functools.partial(_damaged, _kind))


def _judge_restored(tally: Tally, run_dir: Path, reference: toy.Reference, about: str):
    """Counts a run whose newest sound state is wrong or lies before step 2; returns its step."""

    def restored() -> tuple:
        cfg = checkpoint.load_config(run_dir)
        return cfg, *checkpoint.restore(run_dir, toy.abstract_state())

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if (found := harness.works(tally, about, restored)) is None:
            return None
    cfg, state, extra = found
    step, newest = int(state.step), checkpoint.latest_step(run_dir)
    right = toy.bits(state) == reference.state(step) and len(extra["grasps"]) == toy.E * step
    right = right and cfg == toy.config()
    tally.check(right, "silent", f"{about}: step {step} is restored with other numbers")
    tally.check(step >= 2, "lost", f"{about}: step {step} is restored")
    told = step == newest or any(issubclass(one.category, DataWarning) for one in caught)
    tally.check(told, "silent", f"{about}: went back from step {newest} to {step} without a word")
    return step


def _turn_round(steps: Path) -> None:
    for old, new in (("2", "x"), ("3", "2"), ("x", "3")):
        (steps / old).rename(steps / new)


def _replace_newest(steps: Path, other: Path) -> None:
    shutil.rmtree(steps / "3")
    shutil.copytree(other / "3", steps / "3")


SWAPPED: dict[str, Callable[[Path, Path], object]] = {
    "newest one is another run's": _replace_newest,
    "newer one is another run's": lambda steps, other: shutil.copytree(other / "3", steps / "4"),
    "newer one is a link to another's": lambda steps, other: (steps / "4").symlink_to(other / "3"),
    "steps have each other's names": lambda steps, _: _turn_round(steps),
    "newest one has a newer name": lambda steps, _: (steps / "3").rename(steps / "9"),
    "older one has a newer name": lambda steps, _: (steps / "2").rename(steps / "9"),
    "newest one is missing": lambda steps, _: shutil.rmtree(steps / "3"),
    "state is missing": lambda steps, _: shutil.rmtree(steps / "3" / "state"),
    "extra is missing": lambda steps, _: shutil.rmtree(steps / "3" / "extra"),
    "manifest is missing": lambda steps, _: (steps / "3" / checkpoint.MANIFEST).unlink(),
    "file too many": lambda steps, _: (steps / "3" / "state" / "more").write_text("x"),
    "empty folder with a newer name": lambda steps, _: (steps / "9").mkdir(),
    "file with a newer name": lambda steps, _: (steps / "9").write_text("x"),
    "superscript digit": lambda steps, _: (steps / "\u00b2").mkdir(),
    "leading zero": lambda steps, other: shutil.copytree(other / "3", steps / "007"),
    "many digits": lambda steps, _: (steps / ("9" * 30)).mkdir(),
    "name of the run is missing": lambda steps, _: (steps / "run").unlink(),
    "name of the run is empty": lambda steps, _: (steps / "run").write_text(""),
    "log is a folder of the draft's name": lambda steps, _: (steps / ".saving").mkdir(),
}
"""Accidents of the step folders of a run, with steps 2 and 3; the other's are beside them."""


@fault("swapped, missing and foreign step folders", tries=len(SWAPPED))
def swapped(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Moves step folders; the right steps remain, or those before them, and the run continues."""
    for name, seed in (("sound", 5), ("other", 6)):
        toy.train(folder / name, 3, seed=seed)
    other, reference = folder / "other", toy.Reference()
    before = _content(other)
    for name in tally.each(_chosen(rng, list(SWAPPED), tries)):
        run_dir = folder / f"{tally.tries}"
        shutil.copytree(folder / "sound", run_dir)
        SWAPPED[name](run_dir / "checkpoints", other / "checkpoints")
        if name == "steps have each other's names":
            _put_names_right(tally, run_dir, name)
        _judge_restored(tally, run_dir, reference, name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _judge_resumed(tally, run_dir, reference, name)
    tally.check(_content(other) == before, "lost", "the other run has changed")


def _put_names_right(tally: Tally, run_dir: Path, about: str) -> None:
    try:
        checkpoint.sound(run_dir)
        tally.check(False, "silent", f"{about}: taken")
    except checkpoint.CheckpointError as error:
        tally.check("rename it to 2" in str(error), "lost", f"{about}: {error}")
    _turn_round(run_dir / "checkpoints")


def _judge_resumed(tally: Tally, run_dir: Path, reference: toy.Reference, about: str) -> None:
    resume = functools.partial(toy.train, run_dir, 2, resume=True)
    if (summary := harness.works(tally, f"{about}: resumed", resume)) is not None:
        tally.sound(toy.fault_of(run_dir, reference, summary.step), "lost", f"{about}: resumed")


def _content(folder: Path) -> dict[str, bytes]:
    paths = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@fault("two resumes at once", tries=10)
def two_at_once(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Resumes twice: the second is refused; once the first is killed, another one continues."""
    run = _Run(folder / "run", tally)
    for number in tally.each(range(tries)):
        first, second, about = run.child(1, held=True), run.child(steps=1), f"try {number}"
        tally.check(second.end(WORK), "hangs", f"{about}: the second hung")
        refused = second.error is not None and "in use by process" in second.error
        tally.check(refused, "silent", f"{about}: the second said {second.error!r}")
        if rng.random() < 0.5:
            first.go()
        first.kill()
        run.judge(first, about, kill=True)


@fault("read-only folders", tries=12)
def read_only(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Closes folders to a run; it says so in one line and changes nothing."""
    with tempfile.TemporaryDirectory() as name:  # pytest's own are closed to other users
        base = Path(name)
        base.chmod(0o755)
        toy.train(base / "run", 2)
        places = [base / "run", base / "run" / "checkpoints", base / "new"]
        user = 65534 if os.geteuid() == 0 else None  # root writes anywhere
        before = _content(base)
        for number in tally.each(range(tries)):
            place = places[number % len(places)]
            new = place.name == "new"
            closed = base if new else place
            mode = closed.stat().st_mode
            closed.chmod(0o555)
            run_dir = place if new else base / "run"
            child = toy.Child(toy.Order(run_dir, not new, steps=1, user=user))
            ended, about = child.end(WORK), f"{place.name} is read-only"
            closed.chmod(mode)
            tally.check(ended, "hangs", f"{about}: hung")
            tally.sound(child.problem(refused=True, killed=not ended), "tracebacks", about)
            tally.check(child.error or not ended, "silent", f"{about}: was not refused")
        tally.check(_content(base) == before, "lost", "a file has changed")


NAMES = (
    *("a b", "it's", 'say "so"', "\u5b66\u4e60", "\u00fcb\u00e9r", "\U0001f916", "$HOME;`x`"),
    *("-rf", "a#b%20&c", "a{b}|c<d>", "x" * 200),
)
REFUSED = ("[a-z]", "a*", "a?", "back\\slash", "\udcff")


@fault("paths with spaces, quotes and non-Latin letters", tries=len(NAMES) + len(REFUSED))
def odd_paths(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Trains and resumes in folders with odd names, or refuses them before any training."""
    reference = toy.Reference()
    for name in tally.each(_chosen(rng, [*NAMES, *REFUSED], tries)):
        run_dir = folder / name / "run"
        train = functools.partial(toy.train, run_dir, 1)
        if name in REFUSED:
            harness.refused(tally, ascii(name), train, checkpoint.CheckpointError)
        elif harness.works(tally, name, train, "tracebacks") is not None:
            _judge_resumed(tally, run_dir, reference, name)


@fault("closed pipe, full or missing stdout", tries=12)
def closed_pipe(tally: Tally, rng: Rng, tries: int, folder: Path) -> None:
    """Closes the output, as `train ... | head -1`; the run continues and writes its result."""
    reference, steps = toy.Reference(), 6
    ends = ["head", "true", ">/dev/full", ">&-", "2>&-", "2>/dev/full"]
    for number in tally.each(range(tries)):
        end, run_dir = ends[number % len(ends)], folder / f"run {number}"
        result, about = folder / f"{number}.json", f"stdout is {end}"
        answer = _with_stdout(end, run_dir, result, steps)
        harness.judge(tally, answer, about)
        found = toy.fault_of(run_dir, reference, steps)
        if found is None and not ((run_dir / "train.json").is_file() and result.is_file()):
            found = "there is no result"
        tally.check(not found, "lost", f"{about}: {found}; {answer.code} {answer.errors[-300:]!r}")


def _with_stdout(end: str, run_dir: Path, result: Path, steps: int) -> harness.Answer:
    options = ["smoke", "--run-dir", str(run_dir), "--json", str(result), "--seed", "5"]
    options += ["--train.actions", str(steps * toy.E), *toy_cli.OPTIONS]
    shell = ["sh", "-c", f'exec "$@" {end}', "sh"] if ">" in end else []
    process = harness.start(["-m", "tests.faults.toy_cli", "train", *options], shell)
    if not shell:
        assert process.stdout is not None
        if end == "head":
            process.stdout.readline()
        process.stdout.close()
        process.stdout = None
    return harness.wait(process, WORK)
