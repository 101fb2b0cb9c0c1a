"""`csac-jax eval`: a policy, measured."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import tyro

from csac_jax.cli import output, parsing, settings
from csac_jax.cli.failures import BadArgumentsError, as_bad_arguments, check_seed
from csac_jax.config import Config
from csac_jax.io import files
from csac_jax.runtime import signals


@dataclasses.dataclass(frozen=True)
class EvalOptions:
    """Measures a policy in scenes that training never saw. It sees as it was trained to, and
    has the same gripper, unless other settings are given."""

    source: tyro.conf.Positional[str]
    """A run's folder, a policy file, or one that comes with the package, such as shipped; or a
    sweep's folder: all its final policies, each result beside its run."""
    which: str = "last"
    """Checkpoint of the run: last, the newest sound one; best, of a run trained with --eval-every;
    or a step."""
    policy: Literal["learned", "random", "geometric", "oracle"] = "learned"
    """What acts: the networks; grasps at random places above blocks; antipodal grasps from the
    edges of the height map; or a planner that reads the blocks' poses."""
    suite: str = "in_distribution"
    """Scenes: in_distribution (like the training's), random10, random30, cases, target (needs a
    policy of that task), packed, camera (random10 through ever worse cameras), pile,
    objects_packed, objects10, target_objects (objects of a library), or a case file."""
    objects: str | None = None
    """Library that suites of objects draw from: a folder, or made:SEED:COUNT for our own shapes; by
    default the policy's."""
    split: Literal["held_out", "train", "all"] = "held_out"
    """Which of its objects."""
    physics: Literal["auto", "mjx", "c"] = "auto"
    """What moves the blocks: MJX, C MuJoCo, or auto: C MuJoCo on a CPU, else MJX."""
    robot: Literal["hand", "ur5", "ur5e"] = "hand"
    """What moves the gripper: nothing, it floats as in training; or an arm."""
    augment: Literal["on", "off"] | None = None
    """Whether Q is the mean over mirror images of the view, see `policy.augment` of `csac-jax train
    --help-all`; by default as the policy's."""
    height_bonus: float | None = None
    """What each metre of the surface under a cell adds to Q, see `policy.height_bonus` of `csac-jax
    train --help-all`; by default as the policy's."""
    retry: float | None = None
    """How boldly the policy draws another place after failed grasps, see `policy.retry` of
    `csac-jax train --help-all`; by default as the policy's."""
    episodes: int = 50
    """Episodes of every part of the suite, each with a fresh scene where the part has several."""
    seed: int = 0
    """Number that scenes and noise follow from. No seed gives scenes of the training."""
    json: Path | None = None
    """File to write the result to, as JSON."""


def run(arguments: list[str]) -> int:
    """Measures and prints; returns the exit code."""
    if parsing.take(arguments, "--step")[0] is not None:
        raise BadArgumentsError("--step: it is --which STEP now, next to best and last")
    options, view = settings.parse_view(EvalOptions, "eval", arguments)
    if options.episodes < 1:
        raise BadArgumentsError("--episodes: at least 1")
    check_seed(options.seed)
    which = _which(options.which)
    if (Path(options.source) / files.SWEEP_PLAN).exists():
        return _evaluate_sweep(options, view)
    from csac_jax.evaluation import policies, suites

    policy = policies.POLICIES[options.policy](options.source, which)
    view = {**view, "policy": settings.decision(options)}
    begun = time.time()
    with as_bad_arguments(ValueError):
        seen = suites.with_objects(
            policy.cfg.change(**view), options.suite, options.objects, options.split
        )
    cfg, result = _evaluate(options, policy, seen)
    seconds = round(time.time() - begun, 1)
    for part, summary in result.get("parts", {Path(options.suite).stem: result}).items():
        title = f"{options.policy} policy, {part}: {options.episodes} episodes, seed {options.seed}"
        print_summary(title, summary)
    asked = {name: getattr(options, name) for name in ("policy", "which", "suite", "seed")}
    if seen.scene.has_objects:
        asked |= {"objects": seen.scene.objects, "split": seen.scene.split}
    output.write_result(options.json, {**asked, "seconds": seconds, **result}, cfg)
    return 0


def _evaluate_sweep(options: EvalOptions, view: Any) -> int:
    """Measures the final policies of a sweep that are left; returns the exit code."""
    mine = dataclasses.fields(EvalOptions)
    changed = {field.name for field in mine if getattr(options, field.name) != field.default}
    if changed - {"source", "suite", "episodes"} or any(view.values()):
        raise BadArgumentsError(
            "eval SWEEP: takes --suite and --episodes alone; give one of its runs for other options"
        )
    from csac_jax import api

    stop = signals.install()
    with as_bad_arguments(ValueError):
        stopped = api.evaluate_sweep(Path(options.source), options.suite, options.episodes, stop)
    return 0 if stopped is None else 128 + stopped


def _which(text: str) -> Any:
    """`best`, `last`, or the number of a step."""
    if text in ("best", "last"):
        return text
    if not text.isdecimal():
        raise BadArgumentsError(f"--which: '{text}' is neither best, last nor a step")
    return int(text)


def _evaluate(options: EvalOptions, policy: Any, seen: Config) -> tuple[Config, dict[str, Any]]:
    """The config that was measured in, from `seen`, and the result, see `rollout.evaluate`; shows
    progress."""
    from csac_jax.evaluation import rollout, suites
    from csac_jax.runtime import cache

    cache.enable()
    with as_bad_arguments(ValueError):
        cfg = rollout.configured(seen, options.physics, options.robot)
    count, seed, learned = options.episodes, options.seed, options.policy == "learned"
    with progress_bar() as show:
        with as_bad_arguments(ValueError):
            parts = suites.environments(cfg, options.suite, count, seed, learned)
        return cfg, rollout.measure(policy, parts, count, seed, show)


@contextlib.contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """A line on the terminal with the part and its finished episodes; nothing elsewhere."""
    bar = output.progress()
    task = bar.add_task("preparing scenes", total=None)

    def show(part: str, finished: int, episodes: int) -> None:
        bar.update(task, description=f"{part}, episodes", completed=finished, total=episodes)

    with bar:
        yield show


def print_summary(title: str, summary: dict[str, Any]) -> None:
    """Prints every metric, and a dash for one without cases."""
    from rich.console import Console
    from rich.table import Table

    from csac_jax.evaluation.statistics import Band
    from csac_jax.report import result_tables

    caption = "in brackets: 95 % interval; action_efficiency: blocks per action"
    table = Table("metric", "value", "n", title=title, caption=caption)
    for name, entry in {**summary, **summary.get("failures", {})}.items():
        if "value" in entry:
            band = Band(**entry) if entry["n"] else None
            table.add_row(name, result_tables.shown(metric=name, band=band), str(entry["n"]))
    console = Console(highlight=False)
    console.print(table)
    for name in ("outcomes", "counts"):
        console.print(f"{name}:", ", ".join(f"{key} {n}" for key, n in summary[name].items()))
