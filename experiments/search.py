"""A search of settings with the same budget for every method, and the result with what it found.

    python -m experiments.search run paper_small runs/search --methods vpg csac csac_beta
    python -m experiments.search record runs/search --actions 1750
    python -m experiments.search result runs/search runs/result --seeds 16 --evaluate 500

Every method tries the same number of settings with the same seeds: first its own defaults, then
draws from SPACE by the same random numbers. The best has the largest area under the training curve,
mean over seeds; a run that was given up counts as 0. Each method has a record, METHOD.json, of all
that was tried. `record` judges by a curve's first ACTIONS: a search may be stopped before its end.
`result` refuses records of different budgets, and seeds that the search has used.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from csac_jax import algorithms, api, presets
from csac_jax.config import Config
from csac_jax.errors import SettingsError
from csac_jax.evaluation import statistics
from csac_jax.io import configs, files
from csac_jax.report import results
from csac_jax.runtime import provenance, signals
from csac_jax.sim import backend
from csac_jax.sweeps import grid, runner
from csac_jax.sweeps.grid import SweepPoint
from csac_jax.sweeps.runner import SweepPlan, SweepResult, SweepRun, runs_of
from csac_jax.training import programs

METHODS = ("grasp_only", "reactive", "vpg", "csac", "csac_per", "csac_beta")
FIRST_SEED = 1_000_000  # of the search: results begin at 0
CRITERION = "area under the training curve, mean over seeds"
MADE_WITH = "provenance.json"  # beside sweep.json: where the search was begun
SPACE: dict[str, Callable[[float], float]] = {
    "learn.learning_rate": lambda u: 1e-4 * 30.0**u,
    "learn.lr_final_fraction": lambda u: 0.05 * 20.0**u,
    "target.gamma": lambda u: 0.8 * u,
    "explore.decay": lambda u: 1.0 - 1e-2 * 1e-2**u,
}
"""Setting -> its value at u in 0 .. 1. All enter a program as numbers: one compilation a method."""
DEFINING = {"reactive": ("target.gamma",), "grasp_only": ("target.gamma",)}
"""Settings that make a method what it is, and are not searched for it."""


def trials(algo: str, count: int) -> list[dict[str, float]]:
    """The settings that a method tries: its defaults, then the same draws as every other."""
    draws = np.random.default_rng(FIRST_SEED).random((count - 1, len(SPACE)))
    searched = [
        {name: float(f"{law(u):.4g}") for (name, law), u in zip(SPACE.items(), row, strict=True)}
        for row in draws
    ]
    kept = [name for name in SPACE if name not in DEFINING.get(algo, ())]
    return [{}, *({name: one[name] for name in kept} for one in searched)]


def plan(cfg: Config, methods: Sequence[str], count: int, seeds: int) -> SweepPlan:
    """The sweep of a search: `count` points for each method, named METHOD-I."""
    points = [
        point(f"{algo}-{i}", cfg, algo, settings, FIRST_SEED)
        for algo in methods
        for i, settings in enumerate(trials(algo, count))
    ]
    return SweepPlan(seeds, points)


def point(name: str, cfg: Config, algo: str, settings: dict[str, Any], seed: int) -> SweepPoint:
    """The point of an algorithm with these settings, by dotted name, from this seed on."""
    tried = programs.replace_settings(algorithms.configure(cfg, algo), settings).change(seed=seed)
    told = {key: str(value) for key, value in settings.items()}
    return SweepPoint(name, told, backend.resolve(tried))


def run(
    preset: tyro.conf.Positional[str],
    folder: tyro.conf.Positional[Path],
    methods: tuple[str, ...] = METHODS,
    trials: int = 16,
    seeds: int = 3,
    task: str = "target",
) -> None:
    """Tries `trials` settings of every method with `seeds` seeds each; goes on in a folder that
    exists. TASK is clear, target or packed."""
    cfg = programs.replace_settings(presets.get(preset), grid.settings_of("task", task))
    if search(cfg, folder, methods, trials, seeds, signals.install()).stopped_by is None:
        for record in records(folder):
            print(f"{record['algo']}: {record['best'] or 'its defaults'}")


def search(
    cfg: Config, folder: Path, methods: Sequence[str], count: int, seeds: int, stop: signals.Stop
) -> SweepResult:
    """Trains what is left of a search, and records each method once all is done. Raises
    SettingsError where the folder holds another search."""
    if count < 1 or seeds < 1:
        raise SettingsError("--trials, --seeds: at least 1")
    wanted = plan(cfg, methods, count, seeds)
    if not folder.exists():
        folder.mkdir(parents=True)
        files.write_json(folder / MADE_WITH, provenance.record())
        files.replace(folder / files.SWEEP_PLAN, runner.plan_text(wanted))
    elif (folder / files.SWEEP_PLAN).read_text() != runner.plan_text(wanted):
        raise SettingsError(f"{folder} holds another search; give another folder")
    done = api.run_sweep(wanted, folder, None, "seeds", None, True, stop, resume=True)
    if done.stopped_by is None:
        _record_all(wanted, folder, cfg.train.steps * cfg.train.scenes)
    return done


def record(folder: tyro.conf.Positional[Path], actions: int) -> None:
    """Records every method of a search, maybe a stopped one, by the first ACTIONS of each curve."""
    _record_all(runner.read_plan(folder), folder, actions)


def _record_all(wanted: SweepPlan, folder: Path, actions: int) -> None:
    """Writes METHOD.json of every method. Raises SettingsError for more actions than there were."""
    if not 1 <= actions <= min(p.cfg.train.steps * p.cfg.train.scenes for p in wanted.points):
        raise SettingsError("--actions: at least 1, and no more than a run has")
    for algo in dict.fromkeys(point.cfg.algo for point in wanted.points):
        own = wanted._replace(points=[p for p in wanted.points if p.cfg.algo == algo])
        files.write_json(folder / f"{algo}.json", _record(own, algo, folder, actions))


def _record(own: SweepPlan, algo: str, folder: Path, actions: int) -> dict[str, Any]:
    """What a method has tried, and the best of it by so many actions."""
    settings = trials(algo, len(own.points))
    areas = [
        [_area(folder, one, actions) for one in runs_of(own._replace(points=[point]))]
        for point in own.points
    ]
    best = int(np.argmax([np.mean(row) for row in areas]))
    first = own.points[0].cfg
    seeds = list(range(first.seed, first.seed + own.seeds))
    tried = [{"settings": s, "areas": a} for s, a in zip(settings, areas, strict=True)]
    return {
        "algo": algo,
        "criterion": CRITERION,
        "budget": {"settings": len(settings), "seeds": seeds, "actions": actions},
        "tried": tried,
        "best": settings[best],
        "config": configs.to_dict(first),
        **files.read_object(folder / MADE_WITH),
    }


def _area(folder: Path, run: SweepRun, actions: int) -> float:
    """The area under the first `actions` of a run's training curve; 0 for one that did not come so
    far, or grasped nothing."""
    found = results.read([folder / run.folder]).runs
    if not found or found[0].actions[-1] < actions:
        return 0.0
    return statistics.area(found[0].actions, found[0].success, float(actions))


def records(folder: Path) -> list[dict[str, Any]]:
    """The methods' records. Raises SettingsError where there are none, or budgets differ."""
    found = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
    found = [record for record in found if "criterion" in record]
    if not found:
        raise SettingsError(f"{folder} holds no finished search; run: experiments.search run")
    budgets = {json.dumps(record["budget"]) for record in found}
    if len(budgets) > 1:
        raise SettingsError(f"{folder}: methods had different budgets; search again with one")
    return found


def check_seeds(found: Sequence[dict[str, Any]], seeds: Sequence[int]) -> None:
    """Raises SettingsError where a seed of the result is one of the search."""
    used = {seed for record in found for seed in record["budget"]["seeds"]}
    if both := sorted(used & set(seeds)):
        raise SettingsError(f"--seed: the search has used seed {both[0]}; choose other seeds")


def result(
    search_folder: tyro.conf.Positional[Path],
    folder: tyro.conf.Positional[Path],
    seeds: int = 16,
    seed: int = 0,
    evaluate: int = 500,
) -> None:
    """Trains every method with its best settings, with SEEDS seeds from SEED on, and evaluates the
    final policies in EVALUATE episodes. A stopped one goes on by `csac-jax sweep --resume`."""
    wanted = result_plan(records(search_folder), seeds, seed, evaluate)
    api.run_sweep(wanted, folder, None, "seeds", None, True, signals.install())


def result_plan(found: Sequence[dict[str, Any]], seeds: int, seed: int, episodes: int) -> SweepPlan:
    """The sweep of a result: a point per method, named after it."""
    check_seeds(found, range(seed, seed + seeds))
    points = []
    for record in found:
        cfg = configs.from_dict(record["config"])
        tried = programs.replace_settings(cfg, record["best"]).change(seed=seed)
        told = {key: str(value) for key, value in record["best"].items()}
        points.append(SweepPoint(record["algo"], told, tried))
    return SweepPlan(seeds, points, episodes)


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"run": run, "record": record, "result": result})
