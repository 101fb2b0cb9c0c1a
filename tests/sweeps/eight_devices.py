"""Training on eight virtual devices, compared with one; prints JSON.

python -m tests.sweeps.eight_devices toy FOLDER    replicas, by a small step
python -m tests.sweeps.eight_devices real          a scene of `smoke` on each device
python -m tests.sweeps.eight_devices seeds         compiles for a seed on each, without Shardy

Physics are C's, which take scenes one by one: MJX rounds a batch of one scene otherwise than one of
eight.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import csac_jax  # noqa: F401  (before JAX)

import jax  # isort: skip
import numpy as np

from csac_jax import presets
from csac_jax.io import checkpoint
from csac_jax.runtime import compiler
from csac_jax.sweeps import replicas
from csac_jax.training import programs, sharding, step
from tests.training import toys
from tests.training.test_step import leaves

SEEDS = {"seeds": 8, "scenes": 2}
STEPS = 4
REAL_STEPS = 8
SMOKE = presets.smoke().change(sim={"physics": "c"})
CFG = SMOKE.change(train={"scenes": 8, "actions": 8 * REAL_STEPS})  # learns from the first step


def run_toy(shard: str, devices: int, folder: Path) -> tuple[Any, list[Any], Any]:
    """Returns the state after two chunks, their metrics, and the second chunk's state from a
    checkpoint of the first."""
    cfg, mesh = toys.CFG, sharding.make(devices)
    configs = [dataclasses.replace(cfg, seed=k) for k in range(SEEDS[shard])]
    (group,) = replicas.group_configs(configs)
    seeds = replicas.group_replicas(group)
    program = replicas.SweepProgram(toys.program(cfg), seeds, mesh, shard)
    state = program.init()
    places = jax.tree.map(lambda leaf: leaf.sharding, state)
    chunk = program.compile_chunk(STEPS).lower(state).compile()
    state, first = chunk(state)
    assert jax.tree.map(lambda leaf: leaf.sharding, state) == places
    checkpoint.save(folder, STEPS, state, cfg, {})
    state, second = chunk(state)
    restored, _ = checkpoint.restore(folder, program.abstract())
    assert jax.tree.map(lambda leaf: leaf.sharding, restored) == places
    again, _ = chunk(restored)
    return state, jax.device_get([first, second]), again


def difference(a: Any, b: Any) -> float:
    """Returns the largest difference of two trees, relative to the larger of 1 and the value."""
    pairs = zip(leaves(a), leaves(b), strict=True)
    errors = (np.abs(x.astype(float) - y) / np.maximum(np.abs(y), 1.0) for (_, x), (_, y) in pairs)
    return max(float(np.max(error)) for error in errors)


def compare_toy(shard: str, folder: Path) -> dict[str, Any]:
    """Compares one device and eight."""
    folders = [folder / f"{shard}-{n}" for n in (1, 8)]
    (one, seen, _), (eight, others, again) = (
        run_toy(shard, n, path) for n, path in zip((1, 8), folders, strict=True)
    )
    abstract = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), one)
    by_one, by_eight = (checkpoint.restore(path, abstract)[0] for path in folders)  # read on one
    parts = [leaf.addressable_shards[0].data for leaf in (eight.scenes, eight.learner["online"])]
    pairs = zip(seen, others, strict=True)
    return {
        "metrics": max(difference(a._asdict(), b._asdict()) for a, b in pairs),
        "state": difference(one, eight),
        "resumed": difference(eight, again),
        "moved": difference(by_eight, by_one),
        "parts": [part.shape for part in parts],
    }


def run_real(program: step.Program, devices: int) -> tuple[Any, Any]:
    """Returns state and metrics [T, 1, ...] after REAL_STEPS steps."""
    (group,) = replicas.group_configs([program.cfg])
    line = sharding.make(devices)
    together = replicas.SweepProgram(program, replicas.group_replicas(group), line, "scenes")
    return jax.device_get(together.compile_chunk(REAL_STEPS)(together.init()))


def compare_real() -> dict[str, Any]:
    """Compares integers by their number of differences, floats by their largest difference."""
    program = programs.make(CFG)
    (state, seen), (others_state, others_seen) = run_real(program, 1), run_real(program, 8)
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


def compile_seeds() -> dict[str, Any]:
    """Returns on how many devices the compiled step runs, by the partitioner before Shardy."""
    jax.config.update("jax_use_shardy_partitioner", False)  # as jaxlib 0.11 does, see `_guard`
    seeds = [dataclasses.replace(SMOKE, seed=k) for k in range(8)]
    (group,) = replicas.group_configs(seeds)
    program = replicas.sweep_program(group, sharding.make(8))
    chunk = compiler.lower(program.compile_chunk(1), program.abstract()).compile()
    return {"used": len(jax.tree.leaves(chunk.output_shardings)[0].device_set)}


def toy(folder: Path) -> dict[str, Any]:
    """Compares both ways of sharding."""
    programs.init_state, step.train_step = toys.init_state, toys.train_step
    return {shard: compare_toy(shard, folder) for shard in SEEDS}


if __name__ == "__main__":
    kind, *arguments = sys.argv[1:]
    work = {"toy": toy, "real": compare_real, "seeds": compile_seeds}[kind]
    results = work(*map(Path, arguments))
    print(json.dumps({"devices": len(jax.devices()), **results}))
