"""The final policies of a sweep, measured without exploration: SWEEP/POINT/seed-K/eval.json.

The file is that of `csac-jax eval --json`. A policy that has one is passed over, so an interrupted
evaluation goes on where it was.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

from csac_jax.config import Config, PhysicsKind
from csac_jax.evaluation import policies, rollout, suites
from csac_jax.io import checkpoint, configs, files
from csac_jax.runtime import provenance
from csac_jax.runtime.signals import Stop
from csac_jax.sweeps.grid import SweepPoint
from csac_jax.sweeps.runner import SweepPlan, SweepRun, runs_of
from csac_jax.training.loop import Reporter

RESULT = "eval.json"
SUITE = suites.IN_DISTRIBUTION  # every task has its own scenes, from other random numbers
SEED = 0  # of the evaluation: all policies of a point meet the same scenes


def measure(plan: SweepPlan, folder: Path, reporter: Reporter, stop: Stop) -> int | None:
    """Evaluates the policies that are left, each in `plan.episodes` episodes of its task.

    A run that was given up has no policy. Returns the number of the signal that stopped it.
    """
    for point in plan.points:
        runs = [run for run in runs_of(plan._replace(points=[point])) if _is_left(folder, run)]
        if runs and stop.signal is None:
            reporter.say(f"evaluating {point.name}: {len(runs)} policies")
            _measure_point(plan, point, folder, runs, stop)
    return stop.signal


def _is_left(folder: Path, run: SweepRun) -> bool:
    path = folder / run.folder
    return checkpoint.latest_step(path) is not None and not (path / RESULT).exists()


def _measure_point(
    plan: SweepPlan, point: SweepPoint, folder: Path, runs: list[SweepRun], stop: Stop
) -> None:
    """Evaluates runs of one point, which share their scenes and the compiled episodes; in C MuJoCo
    if they were trained in it, on whatever device."""
    physics: PhysicsKind = "c" if point.cfg.sim.physics == "c" else "auto"
    cfg = rollout.configured(point.cfg, physics, point.cfg.sim.robot)
    parts = suites.environments(cfg, SUITE, plan.episodes, SEED)
    for run in runs:
        if stop.signal is not None:
            return
        begun, path = time.time(), folder / run.folder
        found = rollout.measure(policies.load(path), parts, plan.episodes, SEED, None)
        _write(path / RESULT, dataclasses.replace(cfg, seed=run.cfg.seed), found, begun)


def _write(path: Path, cfg: Config, found: dict[str, Any], begun: float) -> None:
    asked = {"policy": "learned", "suite": SUITE, "seed": SEED}
    seconds = {"seconds": round(time.time() - begun, 1)}
    config = {"config": configs.to_dict(cfg)}
    files.write_json(path, {**asked, **seconds, **found, **config, **provenance.record()})
