"""Evaluates the final policies of a sweep, without exploration.

The result is SWEEP/POINT/seed-K/eval.json, or eval-SUITE.json for scenes other than those of a
policy's own task, as of `csac-jax eval --json`. A policy that has one is skipped, so an interrupted
evaluation continues where it was.
"""

import dataclasses
import time
from pathlib import Path

from csac_jax.config import Config, PhysicsKind
from csac_jax.evaluation import policies, rollout, suites
from csac_jax.io import checkpoint, configs, files
from csac_jax.runtime import provenance
from csac_jax.runtime.signals import Stop
from csac_jax.sweeps.runner import SweepPlan, runs_of
from csac_jax.training.own_parts import NO_PARTS, OwnParts
from csac_jax.training.progress import Terminal

OWN = suites.IN_DISTRIBUTION  # every task has its own scenes, from other random numbers
SEED = 0  # of the evaluation: all policies of a point meet the same scenes


def measure(
    plan: SweepPlan,
    folder: Path,
    reporter: Terminal,
    stop: Stop,
    suite: str = OWN,
    own: OwnParts = NO_PARTS,
) -> int | None:
    """Evaluates the policies that are left, each in `plan.episodes` episodes of the suite's parts.
    A run that was given up has no policy. Returns the number of the signal that stopped it. Raises
    ValueError as `suites.prepare` does, before anything is measured there."""
    name = "eval.json" if suite == OWN else f"eval-{Path(suite).stem}.json"
    for point in plan.points:
        runs = runs_of(plan._replace(points=[point]))
        paths = {files.inside(folder, run, name): cfg for run, cfg in runs.items()}
        if done := sum(path.exists() for path in paths):
            reporter.log(f"{point.name}: {done} policies have their {name} already")
        saved = [path for path in paths if checkpoint.latest_step(path.parent) is not None]
        left = {path: paths[path] for path in saved if not path.exists()}
        if left and stop.signal is None:
            reporter.log(f"evaluating {point.name}: {len(left)} policies")
            _measure_point(plan.episodes, suite, point.cfg, left, stop, own)
    return stop.signal


def _measure_point(
    episodes: int,
    suite: str,
    cfg: Config,
    left: dict[Path, Config],
    stop: Stop,
    own: OwnParts = NO_PARTS,
) -> None:
    """Evaluates runs of one point, which share scenes and compiled episodes.

    In C MuJoCo if they were trained in it, on whatever device. Args: left, files to write.
    """
    physics: PhysicsKind = "c" if cfg.sim.physics == "c" else "auto"
    cfg = suites.standard(cfg, suite)
    prepared = suites.prepare(cfg, suite, episodes, SEED, physics, cfg.sim.robot)
    for path, trained in left.items():
        if stop.signal is not None:
            return
        begun = time.time()
        table = rollout.evaluate(policies.load(path.parent, own.network, own.learner), prepared)
        asked = {"policy": "learned", "suite": suite, "seed": SEED}
        seconds = {"seconds": round(time.time() - begun, 1)}
        measured = dataclasses.replace(prepared.cfg, seed=trained.seed)
        config = {"config": configs.to_dict(measured)}
        files.write_json(path, asked | seconds | table | config | provenance.record())
