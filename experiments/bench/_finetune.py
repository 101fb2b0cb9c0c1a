"""A policy learns from grasps of another gripper, recorded through its camera."""

import dataclasses
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import stats

from csac_jax.config import SensorConfig
from csac_jax.deploy import CameraPolicy, fine_tuning
from csac_jax.deploy.fine_tuning import Settings
from csac_jax.deploy.record import Recorder
from csac_jax.env import Env
from csac_jax.evaluation import metrics, suites
from csac_jax.scene.layout import Scene
from csac_jax.sim.outcome import Trace
from csac_jax.sim.physics import Physics
from csac_jax.sim.primitives import JointTrajectory
from experiments.bench import _closed_loop

HELD_OUT = 1000  # added to the seed of scenes that nothing is learned from
IMAGE = 0.5  # of the camera's pixels: enough for a map of 64 cells
PLACES = {"above": (-0.03, 0.0, 0.7), "side": (-0.5, 0.0, 0.5)}  # m, where the camera stands
TIMES = ("before", "after")
SHOWN = ("grasp_success", "completion", "blocks_per_action", "pushes")


@dataclasses.dataclass(frozen=True, eq=False)
class Narrow:
    """Physics of a gripper that opens less than the one that the policy knows."""

    inner: Physics
    opening: float  # m, between the open fingers

    def run(self, scene: Scene, joints: JointTrajectory) -> tuple[Scene, Trace]:
        """See `physics.Physics`; joints 4 and 5 are the fingers of the floating hand."""
        half = jnp.float32(0.5 * self.opening)
        start, control = joints.start.at[4:].min(half), joints.control.at[:, 4].min(half)
        return self.inner.run(scene, joints.replace(start=start, control=control))


class World(NamedTuple):
    """What is measured in."""

    opening: float
    place: str  # of PLACES
    episodes: int
    learn: Settings


def world(policy: CameraPolicy, setting: World, episodes: int, seed: int) -> Env:
    """random10 seen by that camera, with that gripper."""
    cfg = policy.cfg.change(sim={"physics": "c"}, heightmap={"view": "oblique"})
    lens = dataclasses.replace(cfg.camera, position=PLACES[setting.place])
    cfg = cfg.change(camera=lens.scaled(IMAGE))
    (env,) = suites.environments(cfg, "random10", episodes, seed).values()
    return dataclasses.replace(env, physics=Narrow(env.physics, setting.opening))


def measure(source: str, setting: World, grasps: int, seed: int) -> dict[str, Any]:
    """One seed: scenes, grasps, order of learning and held-out scenes follow from it."""
    begun, policy = time.perf_counter(), CameraPolicy.load(source)
    env = world(policy, setting, 64, seed)
    with tempfile.TemporaryDirectory() as folder:
        recorder = Recorder(Path(folder), source)
        loop = _closed_loop.Loop(policy, env, 64, seed, recorder)
        counts = _closed_loop.collect(loop, SensorConfig(), grasps)
        recorded = time.perf_counter()
        tuned, done = fine_tuning.run(policy, Path(folder), setting.learn._replace(seed=seed))
    learned = time.perf_counter()
    held_out = world(policy, setting, setting.episodes, HELD_OUT + seed)
    found = {
        name: _evaluate(one, held_out, setting.episodes, HELD_OUT + seed)
        for name, one in zip(TIMES, (policy, tuned), strict=True)
    }
    seconds = {"record": recorded - begun, "learn": learned - recorded}
    seconds["evaluate"] = time.perf_counter() - learned
    return {
        "seed": seed,
        **found,
        "recorded": counts,
        "learned": done._asdict(),
        "seconds": seconds,
    }


def _evaluate(policy: CameraPolicy, env: Env, episodes: int, seed: int) -> dict[str, Any]:
    """What came of episodes, seen by the same camera; blocks taken per action, pushes included."""
    loop = _closed_loop.Loop(policy, env, episodes, seed)
    found = _closed_loop.measure(loop, SensorConfig())
    counts = found["counts"]
    actions = counts["grasps"] + counts["pushes"]
    shares = {name: found[name] for name in ("grasp_success", "completion")}
    shares["pushes"] = metrics.wilson(counts["pushes"], actions)
    shares["blocks_per_action"] = metrics.wilson(counts["blocks_taken"], actions)
    return {**shares, "counts": counts}


def gain(seeds: list[dict[str, Any]], metric: str) -> dict[str, Any]:
    """The mean gain of a metric over the seeds; its interval is Student's, of one seed None."""
    gains = np.array(
        [one["after"][metric]["value"] - one["before"][metric]["value"] for one in seeds]
    )
    mean, n = float(gains.mean()), len(gains)
    if n == 1:
        return {"value": mean, "low": None, "high": None, "n": 1}
    half = float(stats.t.ppf(0.975, n - 1) * gains.std(ddof=1) / np.sqrt(n))
    return {"value": mean, "low": mean - half, "high": mean + half, "n": n}
