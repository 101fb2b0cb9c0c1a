"""Does the arm grasp as the floating hand does? As JSON: `csac-jax bench robots [--grasps N]`, in C
MuJoCo.

The same grasps in the same settled piles of six, each pile turned by another yaw every time it is
used, so that the arm stands otherwise. One grasp in four is beside the planned place, and turned,
so that outcomes differ.
"""

import collections
import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import Config, RobotKind
from csac_jax.constants import Outcome
from csac_jax.scene import layout, model, pool
from csac_jax.scene.layout import Scene
from csac_jax.sim import oracle, outcome, physics as simulation
from csac_jax.sim.primitives import Action
from csac_jax.vision import observe
from experiments.bench._options import timed
from experiments.bench.parity import STREAM, TEN, pile_config

BATCH = 50
SCENES = 128
NOISE = (0.03, 0.03, 0.5)  # m, m, rad
ROBOTS: tuple[RobotKind, ...] = ("hand", "ur5")


def _outcomes(
    cfg: Config, kind: RobotKind, scenes: Scene, height: jax.Array, actions: Action
) -> np.ndarray:
    """Outcome of every grasp with this robot [n]."""
    sim = dataclasses.replace(cfg.sim, robot=kind, physics="c")
    cfg = dataclasses.replace(cfg, sim=sim)
    engine = simulation.make(model.build(cfg.scene, sim), sim)

    @jax.jit
    @jax.vmap
    def grasp(scene: Scene, height: jax.Array, action: Action) -> jax.Array:
        _, trace, plan = simulation.execute(engine, cfg, scene, height, action)
        return outcome.grasp_outcome(
            trace, plan.surface, plan.start[2] - jnp.min(plan.control[:, 2])
        )

    every = (scenes, height, actions)
    count = len(actions.primitive)
    rows = [
        jax.tree.map(lambda leaf, i=i: leaf[i : i + BATCH], every) for i in range(0, count, BATCH)
    ]
    return np.concatenate([np.asarray(grasp(*row)) for row in rows])


def measure(grasps: int) -> dict[str, Any]:
    """Outcomes of both robots."""
    cfg = pile_config(TEN.scene.slots[:6], 6)
    settled = pool.settled(cfg, STREAM, SCENES)
    rng = np.random.default_rng(STREAM)
    scenes = jax.tree.map(lambda leaf: leaf[np.arange(grasps) % SCENES], settled)
    yaws = rng.uniform(0.0, 2.0 * np.pi, grasps).astype(np.float32)
    scenes = jax.jit(jax.vmap(layout.rotate))(scenes, yaws)
    height = jax.jit(jax.vmap(lambda scene: observe.observe(cfg, scene).height))(scenes)
    plan = functools.partial(oracle.grasp, cfg)
    actions = jax.jit(jax.vmap(plan))(scenes, height)
    noise = rng.normal(size=(grasps, 3)) * NOISE * (np.arange(grasps) % 4 == 0)[:, None]
    actions = actions.replace(pose=jnp.asarray(actions.pose + noise.astype(np.float32)))
    found = {kind: _outcomes(cfg, kind, scenes, height, actions) for kind in ROBOTS}
    equal = found["hand"] == found["ur5"]
    counts = {
        kind: {level.name.lower(): collections.Counter(rows.tolist())[level] for level in Outcome}
        for kind, rows in found.items()
    }
    return {
        "grasps": grasps,
        "outcome_equal": float(equal.mean()),
        "equal": int(equal.sum()),
        "outcomes": counts,
    }


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("robots", arguments, measure, grasps=500)
