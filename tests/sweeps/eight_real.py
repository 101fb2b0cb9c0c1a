"""Training steps of `smoke` on eight virtual devices; prints JSON.

python -m tests.sweeps.eight_real          compares a scene on each device with all on one
python -m tests.sweeps.eight_real seeds    compiles for a seed on each device, without Shardy

Physics are C's, which take scenes one by one: MJX rounds a batch of one scene otherwise than one of
eight.
"""

import dataclasses
import json
import sys
from typing import Any

import csac_jax  # noqa: F401  (before JAX)

import jax  # isort: skip
import numpy as np

from csac_jax import presets
from csac_jax.config import Config
from csac_jax.runtime import compiler
from csac_jax.sweeps import replicas
from csac_jax.training import programs, sharding, step
from tests.sweeps.eight_devices import difference

SCENES = 8
STEPS = 8


def config() -> Config:
    """Returns `smoke` with eight scenes; it learns from the first step on."""
    train = {"scenes": SCENES, "actions": SCENES * STEPS}
    return presets.smoke().change(sim={"physics": "c"}, train=train)


def run(program: step.Program, devices: int) -> tuple[Any, Any]:
    """Returns state and metrics [T, 1, ...] after STEPS steps."""
    (group,) = replicas.group_configs([program.cfg])
    line = sharding.make(devices)
    together = replicas.SweepProgram(program, replicas.group_replicas(group), line, "scenes")
    return jax.device_get(together.compile_chunk(STEPS)(together.init()))


def compare(one: tuple[Any, Any], other: tuple[Any, Any]) -> dict[str, Any]:
    """Compares integers by their number of differences, floats by their largest difference."""
    (state, seen), (others_state, others_seen) = one, other
    pairs = list(zip(seen, others_seen, strict=True))
    floats = [pair for pair in pairs if pair[0].dtype == np.float32]
    return {
        "counts": sum(int(np.sum(x != y)) for x, y in pairs if x.dtype != np.float32),
        "metrics": difference([x for x, _ in floats], [y for _, y in floats]),
        "scenes": difference(state.scenes, others_state.scenes),
        "stored": difference(state.replay.items, others_state.replay.items),
        "critic": difference(state.learner.online.critic, others_state.learner.online.critic),
        "learned": int(np.sum(seen.learned)),
        "grasps": int(np.sum(seen.primitive)),
    }


def compile_seeds() -> int:
    """Returns on how many devices the compiled step runs, by the partitioner before Shardy."""
    jax.config.update("jax_use_shardy_partitioner", False)  # as jaxlib 0.11 does, see `_guard`
    cfg = presets.smoke().change(sim={"physics": "c"})
    seeds = [dataclasses.replace(cfg, seed=k) for k in range(len(jax.devices()))]
    (group,) = replicas.group_configs(seeds)
    program = replicas.sweep_program(group, sharding.make(len(seeds)))
    chunk = compiler.lower(program.compile_chunk(1), program.abstract()).compile()
    return len(jax.tree.leaves(chunk.output_shardings)[0].device_set)


if __name__ == "__main__":
    if sys.argv[1:] == ["seeds"]:
        print(json.dumps({"devices": compile_seeds()}))
    else:
        made = programs.make(config())
        results = compare(run(made, 1), run(made, SCENES))
        print(json.dumps({"devices": len(jax.devices()), **results}))
