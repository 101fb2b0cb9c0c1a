"""Run with eight virtual devices: compiles training steps of `smoke`, a seed on each device, by the
partitioner before Shardy, which jaxlib 0.11 gets (`_guard`); prints, as JSON, on how many.

python -m tests.sweeps.eight_by_seeds
"""

import dataclasses
import json

import csac_jax  # noqa: F401  (before JAX)

import jax  # isort: skip

from csac_jax import presets
from csac_jax.runtime import compiler
from csac_jax.sweeps import replicas
from csac_jax.training import sharding


def main() -> int:
    """Devices that the compiled step runs on."""
    jax.config.update("jax_use_shardy_partitioner", False)
    cfg = presets.smoke().change(sim={"physics": "c"})
    seeds = [dataclasses.replace(cfg, seed=k) for k in range(len(jax.devices()))]
    (group,) = replicas.group_configs(seeds)
    program = replicas.sweep_program(group, sharding.make(len(seeds)))
    chunk = compiler.lower(program.compile_chunk(1), program.abstract()).compile()
    return len(jax.tree.leaves(chunk.output_shardings)[0].device_set)


if __name__ == "__main__":
    print(json.dumps({"devices": main()}))
