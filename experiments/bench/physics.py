"""Speed of every physics, as JSON: `csac-jax bench physics [--smallest E0] [--scenes E] [--warp]`.

Batches grow from E0 (1) to E (64) scenes by factors of eight. --warp adds MJX on Warp, on CUDA.

Actions of the environment, with heights and outcomes, alternate with a bare loop of the engine's
own steps: same model, settled scenes, set-points, batch and process. `share` is (actions/s x
substeps) / (bare steps/s), what is left of the engine's speed. Blocks are those of the preset
`quick`; every action is a planned grasp.
"""

import dataclasses
import functools
import json
from typing import Any

import jax

from csac_jax import env as environment, presets
from csac_jax.config import Config, PhysicsKind
from csac_jax.runtime import provenance
from csac_jax.sim import oracle
from experiments.bench import _bare
from experiments.bench._options import read
from experiments.bench._timing import medians

REPEATS = 5


def measure(cfg: Config, name: PhysicsKind, scenes: int) -> dict[str, Any]:
    """One physics and one batch."""
    cfg = dataclasses.replace(cfg, sim=dataclasses.replace(cfg.sim, physics=name))
    env = environment.make_env(cfg)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), scenes))
    plan_grasp = functools.partial(oracle.grasp, cfg)
    actions = jax.jit(jax.vmap(plan_grasp))(states.scene, states.obs.height)
    bare = _bare.loop(
        env.physics, states.scene, _bare.joint_trajectories(cfg, states.obs.height, actions)
    )
    step = jax.jit(jax.vmap(env.step))
    seconds = medians({"action": lambda: step(states, actions), "bare": bare}, REPEATS)
    return {
        "physics": name,
        "scenes": scenes,
        "actions_per_second": scenes / seconds["action"],
        "steps_per_second": scenes * cfg.sim.substeps / seconds["action"],
        "bare_steps_per_second": scenes * cfg.sim.substeps / seconds["bare"],
        "share": seconds["bare"] / seconds["action"],
    }


def main(arguments: list[str]) -> None:
    """Prints the result."""
    options = read("physics", arguments, smallest=1, scenes=64, warp=False)
    physics: tuple[PhysicsKind, ...] = ("c", "mjx", "warp") if options["warp"] else ("c", "mjx")
    cfg = presets.get("quick")
    batches = [
        options["smallest"] * 8**i
        for i in range(8)
        if options["smallest"] * 8**i <= options["scenes"]
    ]
    rows = [measure(cfg, name, batch) for name in physics for batch in batches]
    print(json.dumps({"substeps": cfg.sim.substeps, "runs": rows} | provenance.record(), indent=2))
