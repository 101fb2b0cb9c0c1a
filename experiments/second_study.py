"""Runs the second study, docs/study-protocol.md: `python -m experiments.second_study COMMAND`.

plan               the arms, their seeds and GPU minutes, in order
run DIR            trains and evaluates what is left, for at most --minutes
evaluate DIR       evaluates the trained policies that are left, a process for each core
status DIR         the state of each arm
pack DIR           an archive of each part that has begun, into experiments/results/study
unpack DIR         the arms of the archives, so that `run` goes on elsewhere
report             the tables, from the archives

An arm is a sweep in DIR/PART/ARM. `run` goes on where it stopped; its exit code is 3 if arms are
left. Each GPU runs arms of its own: `--only control/* replay/*-16`. With --smoke there is one tiny
arm.
"""

import argparse
import fnmatch
import io
import itertools
import json
import operator
import os
import subprocess
import sys
import tarfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from csac_jax import api
from csac_jax.cli import sweep as command
from csac_jax.errors import FailedError, SettingsError
from csac_jax.io import files
from csac_jax.replay.samplers import Sampler
from csac_jax.report import result_tables, results
from csac_jax.runtime import processes, signals
from csac_jax.section import require
from csac_jax.sweeps import final, runner
from csac_jax.sweeps.runner import SweepPlan
from csac_jax.training import own_parts
from csac_jax.training.own_parts import OwnParts
from csac_jax.training.progress import Terminal
from experiments import index, second_tables
from experiments.samplers import ReaPER, TruncatedGeometric

MAIN, CONTROL, SEARCH = 1000, 1400, 1300  # first seeds
EPISODES = 100  # of every part of a suite
RESERVED = 2  # cores that evaluations leave to training
TOGETHER = 4  # seeds that a process evaluates, with one compiled program
OF_TARGETS, OF_CLEARING = ("enclosed", "target"), ("blocked", "tray", "random10")
ABOUT = {
    "pushes": "the same learner with and without pushes, 327,680 actions",
    "control": "uniform replay once more, other seeds",
    "replay": "five samplers at two replay volumes, 20,480 actions",
    "search": "two learning rates and two ways to explore places, for seven methods",
    "methods": "seven methods by the paper's protocol, each with the settings found for it",
    "contact": "the hand that presses with 20 N and with 100 N, with and without pushes",
    "settings": "share of pushes in exploration, success bonus and discount",
    "guarded": "a guarded descent, with and without pushes",
}
NONE = "--policy.primitive grasp --explore.push-fraction 0"  # no pushes
LARGE = (
    "pushes --algo csac --train.actions 327680 --together 1 "  # five take more than 141 GB
    "--train.no-overlap"
)
CLEAR = "--scene.certified blocked --task.kind clear --task.max-actions 15"
SMALL = (
    "--train.scenes 64 --train.actions 20480 --train.learning-starts 256 "
    "--train.chunk 20 --replay.capacity 20480 --sim.physics warp --train.no-overlap "
    "--learn.updates-per-step {}"
)
"""Settings of `pushes` in 64 scenes: as many updates of 64 as transitions are drawn an action."""
SAMPLERS: dict[str, tuple[str, Sampler | None]] = {
    "uniform": ("csac", None),
    "prioritised": ("csac_per", None),
    "beta": ("csac_beta", None),
    "geometric": ("csac", TruncatedGeometric()),
    "reaper": ("csac", ReaPER(scenes=64)),
}
"""Sampler -> the algorithm, and the part of one's own."""
METHODS = {
    "grasp_only": "--algo grasp_only",
    "reactive": "--algo reactive",
    "vpg": "--algo vpg",
    "csac": "--algo csac",
    "csac_per": "--algo csac_per",
    "csac_beta": "--algo csac_beta",
    "csac_rule": "--algo csac --policy.primitive rule",
}
SEARCHED = (
    "--train.actions 1000 --vary learn.learning_rate=0.001,0.0005 "
    "--vary explore.epsilon_place=0.5:0.0,0.0:0.0"
)
SETTINGS = {  # a half fraction: with uniform replay, volume 16, which has 0.5, 1 and 0.5
    "exploration": (0.5, 0, 0.2),
    "bonus": (0.25, 1, 0.2),
    "discount": (0.25, 0, 0.5),
}
SETTING = "--explore.push-fraction {} --reward.success-bonus {} --target.gamma {}"


class Arm(NamedTuple):
    """A sweep of one setting, or of those that are searched."""

    part: str
    name: str
    words: str  # of the sweep's command, without seeds and folder
    seeds: tuple[int, int]  # first and number
    minutes: float  # of a GPU, estimated
    suites: tuple[str, ...] = OF_TARGETS
    sampler: Sampler | None = None
    episodes: int = EPISODES

    @property
    def place(self) -> str:
        """Returns the arm's folder below that of the study."""
        return f"{self.part}/{self.name}"


def arms() -> list[Arm]:
    """Returns the arms of the protocol in the order in which they run."""
    return [
        *(
            Arm("pushes", f"{on}-{name}", f"{LARGE} {task} {no}", (MAIN, 5), 9.6, of)
            for on, task, of in (("enclosed", "", OF_TARGETS), ("blocked", CLEAR, OF_CLEARING))
            for name, no in (("pushes", ""), ("none", NONE))
        ),
        _small("control", "uniform-16", first=CONTROL),
        *(_replay(name, 16) for name in SAMPLERS),
        *(_replay(name, 2) for name in SAMPLERS),
        *(
            Arm("search", name, f"paper_small {words} {SEARCHED}", (SEARCH, 3), 2.4, (final.OWN,))
            for name, words in METHODS.items()
        ),
        *(
            Arm("methods", name, f"paper_small {words}", (MAIN, 12), 3.8)
            for name, words in METHODS.items()
        ),
        _small("contact", "20N-none", NONE),
        _small("contact", "100N-none", f"{NONE} --sim.down-force 100"),
        _small("contact", "100N-pushes", "--sim.down-force 100"),
        *(_small("settings", name, SETTING.format(*values)) for name, values in SETTINGS.items()),
        _small("guarded", "none", f"{NONE} --sim.approach guarded"),
        _small("guarded", "pushes", "--sim.approach guarded"),
    ]


def _small(part: str, name: str, more: str = "", volume: int = 16, first: int = MAIN) -> Arm:
    algo = "" if "--algo" in more else "--algo csac"
    words = f"pushes {algo} {SMALL.format(volume)} {more}"
    return Arm(part, name, words, (first, 8), 3.5 if volume == 16 else 2.4, ("enclosed",))


def _replay(name: str, volume: int) -> Arm:
    algo, sampler = SAMPLERS[name]
    arm = _small("replay", f"{name}-{volume}", f"--algo {algo}", volume)
    return arm._replace(sampler=sampler)


def smoke_arms() -> list[Arm]:
    """Returns an arm that takes a minute on a CPU."""
    words = "smoke --sim.physics c --algo csac --train.actions 32"
    sampler = ReaPER(scenes=2, actions=15)
    return [Arm("replay", "reaper-16", words, (MAIN, 2), 0.5, (final.OWN,), sampler, 2)]


# Running


def plan_of(arm: Arm, folder: Path) -> SweepPlan:
    """Returns the plan of an arm: the stored one, or a new one by the sweep's own parser."""
    if (folder / arm.place / files.SWEEP_PLAN).exists():
        return runner.read_plan(folder / arm.place)
    first, number = arm.seeds
    found = best_settings(arm, folder) if arm.part == "methods" else ""
    words = f"{arm.words} {found} --seed {first} --seeds {number}"
    _, plan = command.read(words.split())
    named = [one._replace(cfg=own_parts.named(one.cfg, _own(arm))) for one in plan.points]
    return plan._replace(points=named)


def best_settings(arm: Arm, folder: Path) -> str:
    """Returns the flags of the searched setting with most completion; of equal ones the
    first by name."""
    searched = folder / "search" / arm.name
    require((searched / files.SWEEP_PLAN).exists(), f"{searched}: run the search first")

    def completion(point: Any) -> float:
        paths = sorted((searched / point.name).glob("seed-*/eval.json"))
        require(len(paths) > 0, f"{searched}: evaluate the search first")
        return float(np.mean([files.read_object(path)["completion"]["value"] for path in paths]))

    points = sorted(runner.read_plan(searched).points, key=operator.attrgetter("name"))
    best = max(points, key=completion)
    flags = [f"--{key.replace('_', '-')} {value}" for key, value in best.values.items()]
    return " ".join(flags).replace(":", " ")


def is_search_of(one: Arm, arm: Arm) -> bool:
    """Tells whether the evaluations of `one` choose the settings of an arm."""
    return (one.part, arm.part, one.name) == ("search", "methods", arm.name)


def _own(arm: Arm) -> OwnParts:
    return OwnParts(sampler=arm.sampler)


def is_trained(arm: Arm, folder: Path) -> bool:
    """Tells whether all runs of an arm have ended."""
    place = folder / arm.place
    if not (place / files.SWEEP_PLAN).exists():
        return False
    groups = len(runner.groups_of(runner.read_plan(place)))
    return all((place / "groups" / str(i) / "done").exists() for i in range(groups))


def left(arm: Arm, folder: Path) -> list[tuple[int, str]]:
    """Returns seed and suite of the evaluations of a trained arm that are left."""
    place = folder / arm.place
    names = {suite: f"eval-{suite}.json" for suite in arm.suites} | {final.OWN: "eval.json"}
    points = files.read_object(place / runner.SUMMARY)["settings"]
    sound = [row for point in points for row in point["runs"] if row["complete"]]
    wanted = {
        (row["seed"], suite)
        for row in sound
        for suite in arm.suites
        if not (place / row["run_dir"] / names[suite]).exists()
    }
    return sorted(wanted)


def train(arm: Arm, folder: Path, stop: signals.Stop) -> None:
    """Trains an arm, or goes on with it, until `stop`."""
    place, plan = folder / arm.place, plan_of(arm, folder)
    resume = (place / files.SWEEP_PLAN).exists()
    api.run_sweep(plan, place, None, "seeds", None, True, stop, resume, _own(arm))


def run(chosen: Sequence[Arm], folder: Path, minutes: float, evaluator: list[str]) -> bool:
    """Trains what fits into the minutes, and evaluates meanwhile. Returns whether all is done.

    Args: evaluator, the command of a process that evaluates what is left.
    """
    begun, stop = time.monotonic(), signals.install()
    remaining = lambda: minutes - (time.monotonic() - begun) / 60.0  # noqa: E731
    timer = threading.Timer(60.0 * minutes, lambda: setattr(stop, "signal", stop.signal or 15))
    timer.daemon = True
    timer.start()
    helper = _start(evaluator)
    for arm in chosen:
        if is_trained(arm, folder):
            continue
        searched = [one for one in chosen if is_search_of(one, arm)]
        if any(left(one, folder) for one in searched if is_trained(one, folder)):
            helper = _evaluated(helper, evaluator, stop)
        if stop.signal is not None or remaining() < arm.minutes:
            print(f"{arm.place}: not begun, {remaining():.1f} minutes are left", flush=True)
            break
        train(arm, folder, stop)
        if helper.poll() is not None:
            helper = _start(evaluator)
    _evaluated(helper, evaluator, stop)
    timer.cancel()
    return all(is_trained(arm, folder) and not left(arm, folder) for arm in chosen)


def _start(evaluator: list[str]) -> subprocess.Popen:
    """Starts a process whose JAX leaves the GPU alone."""
    return subprocess.Popen(evaluator, env=os.environ | {"JAX_PLATFORMS": "cpu"})


def _evaluated(
    helper: subprocess.Popen, evaluator: list[str], stop: signals.Stop
) -> subprocess.Popen:
    """Waits for the evaluations under way, then for those that are left; ends them at a stop."""
    for last in (helper, None):
        process = last or _start(evaluator)
        while process.poll() is None and stop.signal is None:
            time.sleep(0.2)
        process.terminate()
        process.wait()
    return process


def evaluate(chosen: Sequence[Arm], folder: Path, jobs: int) -> None:
    """Evaluates the trained policies that are left, in C MuJoCo, by `jobs` processes."""
    tasks = [
        (arm, folder, seeds, suite)
        for arm in chosen
        if is_trained(arm, folder)
        for suite in arm.suites
        if (open_seeds := {seed for seed, of in left(arm, folder) if of == suite})
        for seeds in _together(*arm.seeds)
        if open_seeds.intersection(seeds)
    ]
    on_done = lambda number, _: print(f"evaluated {tasks[number][0].place}", flush=True)  # noqa: E731
    processes.each(evaluate_runs, tasks, jobs, lambda *_: None, on_done)


def _together(first: int, number: int) -> Iterator[range]:
    """Yields the seeds in ranges of `TOGETHER`."""
    for start in range(first, first + number, TOGETHER):
        yield range(start, min(start + TOGETHER, first + number))


def evaluate_runs(_: Any, arm: Arm, folder: Path, seeds: range, suite: str) -> None:
    """Evaluates the policies of some seeds in a suite."""
    plan = runner.read_plan(folder / arm.place)
    points = [point._replace(cfg=point.cfg.change(seed=seeds.start)) for point in plan.points]
    some = SweepPlan(len(seeds), points, arm.episodes)
    with Terminal(Console(quiet=True)) as terminal:
        final.measure(some, folder / arm.place, terminal, signals.Stop(), suite, _own(arm))


def states(chosen: Sequence[Arm], folder: Path) -> Iterator[dict[str, str]]:
    """Yields a row per arm: its plan and what of it is done."""
    for arm in chosen:
        first, number = arm.seeds
        trained = is_trained(arm, folder)
        waiting = len(left(arm, folder)) if trained else 0
        begun = "begun" if (folder / arm.place).exists() else ""
        state = f"{waiting} evaluations left" if waiting else "done" if trained else begun
        seeds = f"{first} to {first + number - 1}"
        yield {"arm": arm.place, "seeds": seeds, "minutes": f"{arm.minutes:.1f}", "state": state}


def pack(chosen: Sequence[Arm], folder: Path, archives: Path) -> Iterator[Path]:
    """Writes an archive of each part that has trained arms: plans, logs and evaluations."""
    for part in dict.fromkeys(arm.part for arm in chosen):
        trained = [arm for arm in chosen if arm.part == part and is_trained(arm, folder)]
        paths = [path for arm in trained for path in sorted(_records(folder / arm.place))]
        if paths:
            archive = archives / f"second-{part}{results.ARCHIVE}"
            _write_archive(archive, ABOUT[part], folder / part, paths)
            yield archive


def unpack(archives: Path, folder: Path) -> None:
    """Writes the arms of the archives below a folder, without their checkpoints."""
    for archive in sorted(archives.glob(f"second-*{results.ARCHIVE}")):
        part = archive.name.removeprefix("second-").removesuffix(results.ARCHIVE)
        for name, content in index.contents(archive).items():
            path = folder / part / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)


def _records(place: Path) -> Iterator[Path]:
    yield from (place / files.SWEEP_PLAN, place / runner.SUMMARY)
    yield from place.glob(f"{runner.GROUPS}/*/done")
    for run in runner.runs_of(runner.read_plan(place)):
        names = (files.CONFIG, files.METRICS, "eval*.json")
        yield from itertools.chain.from_iterable((place / run).glob(name) for name in names)


def _write_archive(archive: Path, about: str, folder: Path, paths: Sequence[Path]) -> None:
    """Writes files below `folder` under their names there, without owners and times."""
    archive.parent.mkdir(parents=True, exist_ok=True)
    named = {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
    named[index.ABOUT] = (json.dumps({".": about}, indent=2) + "\n").encode()
    with tarfile.open(archive, "w:xz") as opened:
        for name, content in sorted(named.items()):
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            opened.addfile(entry, io.BytesIO(content))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="second_study", description=__doc__.splitlines()[0])
    commands = ("plan", "run", "evaluate", "status", "pack", "unpack", "report")
    parser.add_argument("command", choices=commands)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("runs/second"))
    parser.add_argument("--minutes", type=float, default=9.0, help="of this call of run")
    parser.add_argument("--archives", type=Path, default=index.STUDY)
    parser.add_argument("--jobs", type=int, default=max(1, processes.cores() - RESERVED))
    parser.add_argument("--only", nargs="+", default=["*"], help="patterns of PART/ARM")
    parser.add_argument("--smoke", action="store_true", help="one tiny arm, for a test")
    options = parser.parse_args(arguments)
    try:
        return call(options)
    except (FailedError, SettingsError) as error:
        print(f"second_study: {error}", file=sys.stderr)
        return 1


def call(options: argparse.Namespace) -> int:
    """Carries out a command; returns the exit code."""
    planned = smoke_arms() if options.smoke else arms()
    chosen = [arm for arm in planned if any(fnmatch.fnmatch(arm.place, p) for p in options.only)]
    require(len(chosen) > 0, f"--only {' '.join(options.only)}: no arm has such a name")
    if options.command == "run":
        own = [sys.executable, "-m", "experiments.second_study", "evaluate", str(options.folder)]
        own += ["--jobs", str(options.jobs), *(["--smoke"] if options.smoke else [])]
        own += ["--only", *options.only]
        return 0 if run(chosen, options.folder, options.minutes, own) else 3
    if options.command == "evaluate":
        evaluate(chosen, options.folder, options.jobs)
    elif options.command == "report":
        print(second_tables.report(options.archives, [arm.place for arm in chosen]))
    elif options.command == "unpack":
        unpack(options.archives, options.folder)
    elif options.command == "pack":
        print(*pack(chosen, options.folder, options.archives), sep="\n")
    else:
        print(result_tables.table_text(list(states(chosen, options.folder))))
        print(f"{sum(arm.minutes for arm in chosen):.1f} minutes in all")
    return 0


if __name__ == "__main__":
    sys.exit(main())
