"""`csac-jax eval`: a policy, measured in one suite or in several."""

import collections
import dataclasses
import functools
import hashlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from csac_jax.cli import output, settings
from csac_jax.cli.failures import check_seed
from csac_jax.errors import SettingsError
from csac_jax.io import files, seal
from csac_jax.runtime import modules, processes, signals
from csac_jax.section import require

EPISODES = 50  # of every part of a suite, where neither --episodes nor --out is given
WORST = 12  # objects that are printed; the result has all
TABLE = "table.md"  # in the folder --out


@dataclasses.dataclass(frozen=True)
class EvalOptions(settings.DecisionOptions):
    """Measures a policy in scenes that training never saw, with its own view and gripper."""

    source: tyro.conf.Positional[str]
    """A run, a policy file, or a shipped policy; or a sweep: all its final policies."""
    which: str = "last"
    """Checkpoint of the run: last, best (of a run trained with --eval-every), or a step."""
    policy: str = "learned"
    """Actor: learned, the networks; random, above blocks; geometric, antipodal grasps from the
    height map; oracle, which reads the blocks' poses; planner, which simulates many actions;
    learned+planner, which simulates those of the networks; or MODULE:NAME, your own, or the name
    that a module of --import registers."""
    suites: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--suite"])] = ("in_distribution",)
    """Scenes: in_distribution (like the training's), random10, random30, cases, packed, camera
    (ever worse ones), blocked, tray; target, enclosed, hidden (of that task); pile, tight,
    objects_packed, objects10, target_objects (of a library); case files, or folders of them; or all
    that fit the policy."""
    out: Path | None = None
    """Folder for a file of each suite and a table of all; finished suites are not repeated."""
    jobs: int = 0
    """With --out, suites at a time, one a core; 0: as many as cores. 1 has all, or the GPU."""
    objects: str | None = None
    """Library of suites of objects, or procedural:SEED:COUNT; by default the policy's."""
    split: Literal["held_out", "train", "all"] = "held_out"
    """Objects of the library to evaluate on."""
    physics: Literal["auto", "mjx", "c"] = "auto"
    """Physics engine: MJX, C MuJoCo, or auto: C MuJoCo on a CPU, else MJX."""
    robot: Literal["hand", "ur5", "ur5e"] = "hand"
    """Carrier of the gripper: none, it floats as in training; or an arm."""
    episodes: int | None = None
    """Episodes of every part of a suite; by default 50, with --out the suite's own number."""
    share: float = 1.0
    """With --out, share of the suites' own numbers of episodes, above 0, at most 1."""
    seed: int = 0
    """Number that scenes and noise follow from. No seed gives scenes of the training."""
    name: str | None = None
    """Name of the policy in tables; by default that of its source, or of a policy without one."""
    json: Path | None = None
    """File to write the result of a single suite to, as JSON."""


def run(arguments: list[str]) -> int:
    """Measures and prints; returns the exit code."""
    options, view = settings.parse_view(EvalOptions, "eval", arguments)
    _check(options)
    if (Path(options.source) / files.SWEEP_PLAN).exists():
        return _evaluate_sweep(options, view)
    changes = {**view, "policy": options.decision}
    if options.out is not None:
        return _measure_all(options, changes, options.out)
    (suite,) = options.suites
    with output.progress() as bars:
        result = _measure(_shown(bars), options, changes, suite, options.episodes or EPISODES)
    for part, summary in result.get("parts", {Path(suite).stem: result}).items():
        number = f"{result['episodes']} episodes, seed {options.seed}"
        print_summary(f"{options.policy} policy, {part}: {number}", summary)
    if options.json is not None:
        files.write_json(options.json, seal.seal(result))
    return 0


def _check(options: EvalOptions) -> None:
    require(options.episodes is None or options.episodes >= 1, "--episodes: at least 1")
    require(0.0 < options.share <= 1.0, "--share: above 0, at most 1")
    require(0 <= options.jobs <= 1024, "--jobs: must lie in 0 .. 1024")
    check_seed(options.seed)
    _which(options.which)
    single = len(options.suites) == 1 and "all" not in options.suites
    require(single or options.out is not None, "--suites: several need --out DIR")
    both = options.out is not None and options.json is not None
    require(not both, "--json: is for a single suite; --out writes a file for each")


def _which(text: str) -> Any:
    if text in ("best", "last"):
        return text
    require(text.isdecimal(), f"--which: '{text}' is neither best, last nor a step")
    return int(text)


def _evaluate_sweep(options: EvalOptions, view: Any) -> int:
    fields = dataclasses.fields(EvalOptions)
    changed = {field.name for field in fields if getattr(options, field.name) != field.default}
    if changed - {"source", "suites", "episodes"} or any(view.values()):
        raise SettingsError(
            "eval SWEEP: takes --suite and --episodes alone; give one of its runs for other options"
        )
    from csac_jax import api

    stop, episodes = signals.install(), options.episodes or EPISODES
    stopped = api.evaluate_sweep(Path(options.source), options.suites[0], episodes, stop)
    return 0 if stopped is None else 128 + stopped


def _name(options: EvalOptions) -> str:
    """Returns the name of the policy in tables."""
    source = Path(options.source).resolve().name.removesuffix(".safetensors")
    learned = {"learned": source, "learned+planner": f"{source} + planner"}
    return options.name or learned.get(options.policy, options.policy)


def _policy(options: EvalOptions, changes: dict[str, Any], suite: str) -> tuple[Any, Any]:
    """Returns the policy, and the changed config of its world in a suite."""
    from csac_jax.evaluation import policies, suites

    policy = policies.make(options.policy, options.source, _which(options.which))
    return policy, suites.standard(policy.cfg, suite).change(**changes)


def _measure(
    on_progress: Callable[..., None],
    options: EvalOptions,
    changes: dict[str, Any],
    suite: str,
    episodes: int,
    own_modules: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Measures the policy in a suite; returns the metrics with all that they follow from. Loads
    `own_modules`, which a process of its own lacks."""
    for module in own_modules:
        modules.load(module)
    from csac_jax.evaluation import policies, rollout, suites
    from csac_jax.io import configs
    from csac_jax.runtime import cache, provenance

    cache.enable()
    begun = time.time()
    policy, cfg = _policy(options, changes, suite)
    has_objects = suite in suites.SUITES and suites.SUITES[suite].objects
    objects = options.objects if has_objects or options.out is None else None
    world = (options.seed, options.physics, options.robot, objects, options.split)
    prepared = suites.prepare(cfg, suite, episodes, *world, policies.is_learned(policy))
    table = rollout.evaluate(policy, prepared, on_progress=functools.partial(on_progress, suite))
    asked = {"name": _name(options), "policy": options.policy, "which": options.which}
    has_library = any(env.cfg.scene.has_objects for env in prepared.parts.values())
    library = {"objects": prepared.cfg.scene.objects, "split": options.split}
    return {
        **asked,
        "seed": options.seed,
        "suite": suite,
        "episodes": episodes,
        **(library if has_library else {}),
        "seconds": round(time.time() - begun, 1),
        **table,
        "config": configs.to_dict(prepared.cfg),
        **provenance.record(),
    }


def _measure_all(options: EvalOptions, changes: dict[str, Any], out: Path) -> int:
    from csac_jax.evaluation import suites

    require(out.is_dir() or not out.exists(), f"--out: {out} is a file; give a folder")
    out.mkdir(parents=True, exist_ok=True)  # before hours of work
    policy, cfg = _policy(options, changes, options.suites[0])
    chosen = _fitting(options, cfg) if "all" in options.suites else options.suites
    for suite in chosen:
        suites.check(suite)
    tag = _digest(options, policy, cfg)
    numbers = {}
    for suite in chosen:
        full = suites.SUITES[suite].episodes if suite in suites.SUITES else EPISODES
        numbers[suite] = options.episodes or max(1, round(options.share * full))
    paths = {suite: out / f"{Path(suite).stem}.json" for suite in chosen}
    waiting = [suite for suite in chosen if not _is_kept(paths[suite], numbers[suite], tag)]
    for suite in sorted(set(chosen) - set(waiting)):
        print(f"{suite}, kept from before", flush=True)

    def on_done(number: int, result: dict[str, Any]) -> None:
        suite = waiting[number]
        files.write_json(paths[suite], seal.seal({**result, "digest": tag}))
        _write_table(out, paths)
        print(f"{suite}, {result['episodes']} episodes, {result['seconds']} s", flush=True)

    own = modules.names()
    tasks = [(options, changes, suite, numbers[suite], own) for suite in waiting]
    with output.progress() as bars:
        jobs = options.jobs or processes.cores()
        processes.each(_measure, tasks, jobs, _shown(bars), on_done)
    print(_write_table(out, paths), end="")
    return 0


def _fitting(options: EvalOptions, cfg: Any) -> tuple[str, ...]:
    from csac_jax.evaluation import policies, suites

    any_task = options.policy not in policies.LEARNED or cfg.task.kind == "both"
    targets = {False, True} if any_task else {cfg.task.has_target}
    has_library = bool(options.objects or cfg.scene.objects)
    return tuple(
        name
        for name, suite in suites.SUITES.items()
        if suite.target in targets and (has_library or not suite.objects)
    )


def _digest(options: EvalOptions, policy: Any, cfg: Any) -> str:
    import jax
    import numpy as np

    from csac_jax.io import configs

    given = dataclasses.replace(options, out=None, jobs=0, suites=(), share=1.0, episodes=None)
    content = json.dumps([str(given), configs.to_dict(cfg)], sort_keys=True)
    digest = hashlib.sha256(content.encode())
    for leaf in jax.tree.leaves(getattr(policy, "params", ())):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()


def _is_kept(path: Path, episodes: int, tag: str) -> bool:
    try:
        result = files.read_object(path)
    except (FileNotFoundError, ValueError):
        return False
    asked = (result.get("episodes"), result.get("digest")) == (episodes, tag)
    return asked and seal.is_intact(result)


def _write_table(folder: Path, paths: dict[str, Path]) -> str:
    from csac_jax.report import suite_table

    results = [files.read_object(path) for path in paths.values() if path.exists()]
    text = suite_table.markdown(suite_table.rows(results))
    files.replace(folder / TABLE, text)
    return text


def _shown(bars: Any) -> Callable[[str, str, int, int], None]:
    lines: dict[str, Any] = collections.defaultdict(lambda: bars.add_task(""))

    def show(suite: str, part: str, finished: int, total: int) -> None:
        title = f"{part if part == suite else f'{suite}, {part}'}, episodes"
        numbers = {"completed": finished, "total": total, "visible": finished < total}
        bars.update(lines[suite], description=title, **numbers)

    return show


def _print_objects(objects: dict[str, Any]) -> None:
    """Prints the WORST objects: how often each was drawn, and how often it was gone at the end."""
    from rich.console import Console
    from rich.table import Table

    shares = sorted(objects.items(), key=lambda item: item[1]["gone"] / item[1]["episodes"])
    title = f"objects that stayed most often, of {len(objects)}"
    table = Table("object", "gone", "drawn", title=title)
    for name, entry in shares[:WORST]:
        table.add_row(name, str(entry["gone"]), str(entry["episodes"]))
    Console(highlight=False).print(table)


def print_summary(title: str, summary: dict[str, Any]) -> None:
    """Prints every metric, and a dash for one without cases. A suite of objects has no word of
    blocks."""
    from rich.console import Console
    from rich.table import Table

    from csac_jax.evaluation.statistics import Band
    from csac_jax.report import cells

    thing = "object" if "objects" in summary else "block"
    caption = f"in brackets: 95 % interval; action_efficiency: {thing}s per action"
    table = Table("metric", "value", "n", title=title, caption=caption)
    for name, entry in {**summary, **summary.get("failures", {})}.items():
        if isinstance(entry, dict) and "value" in entry:
            band = Band(**entry) if entry["n"] else None
            row = name.replace("block", thing)
            table.add_row(row, cells.shown(metric=name, band=band), str(entry["n"]))
    console = Console(highlight=False)
    console.print(table)
    if "objects" in summary:
        _print_objects(summary["objects"])
    for name in ("outcomes", "counts"):
        numbers = ", ".join(f"{key} {n}" for key, n in summary[name].items())
        console.print(f"{name}:", numbers.replace("block", thing))
