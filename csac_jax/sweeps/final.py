"""Evaluates the final policies of a sweep, without exploration.

The result is SWEEP/POINT/seed-K/eval.json, or eval-SUITE.json for scenes other than those of a
policy's own task, as of `csac-jax eval --json`. A policy that has one is skipped, so an interrupted
evaluation continues where it was.
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

OWN = suites.IN_DISTRIBUTION  # every task has its own scenes, from other random numbers
SEED = 0  # of the evaluation: all policies of a point meet the same scenes


def measure(
    plan: SweepPlan, folder: Path, reporter: Reporter, stop: Stop, suite: str = OWN
) -> int | None:
    """Evaluates the policies that are left, each in `plan.episodes` episodes of the suite's parts.

    A run that was given up has no policy. Returns the number of the signal that stopped it. Raises
    SettingsError as `suites.prepare` does, before anything is measured there.
    """
    for point in plan.points:
        runs = runs_of(plan._replace(points=[point]))
        left = [run for run in runs if _is_left(folder / run.folder, suite)]
        if done := sum((folder / run.folder / _result(suite)).exists() for run in runs):
            reporter.log(f"{point.name}: {done} policies have their {_result(suite)} already")
        if left and stop.signal is None:
            reporter.log(f"evaluating {point.name}: {len(left)} policies")
            _measure_point(plan.episodes, suite, point, folder, left, stop)
    return stop.signal


def _result(suite: str) -> str:
    return "eval.json" if suite == OWN else f"eval-{Path(suite).stem}.json"


def _is_left(path: Path, suite: str) -> bool:
    return checkpoint.latest_step(path) is not None and not (path / _result(suite)).exists()


def _measure_point(
    episodes: int, suite: str, point: SweepPoint, folder: Path, runs: list[SweepRun], stop: Stop
) -> None:
    """Evaluates runs of one point, which share scenes and compiled episodes.

    In C MuJoCo if they were trained in it, on whatever device.
    """
    physics: PhysicsKind = "c" if point.cfg.sim.physics == "c" else "auto"
    robot = point.cfg.sim.robot
    prepared = suites.prepare(point.cfg, suite, episodes, SEED, physics, robot)
    for run in runs:
        if stop.signal is not None:
            return
        begun, path = time.time(), folder / run.folder
        found = rollout.evaluate(policies.load(path), prepared)
        measured = dataclasses.replace(prepared.cfg, seed=run.cfg.seed)
        _write(path / _result(suite), suite, measured, found, begun)


def _write(path: Path, suite: str, cfg: Config, table: dict[str, Any], begun: float) -> None:
    asked = {"policy": "learned", "suite": suite, "seed": SEED}
    seconds = {"seconds": round(time.time() - begun, 1)}
    config = {"config": configs.to_dict(cfg)}
    files.write_json(path, {**asked, **seconds, **table, **config, **provenance.record()})
