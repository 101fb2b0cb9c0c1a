"""Compares replicas on eight virtual devices with those on one, with a small step; prints JSON.

python -m tests.sweeps.eight_devices FOLDER
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import csac_jax  # noqa: F401  (before JAX)

import jax  # isort: skip
import numpy as np

from csac_jax.io import checkpoint
from csac_jax.sweeps import replicas
from csac_jax.training import programs, sharding, step
from tests.training import toys
from tests.training.test_step import leaves

SEEDS = {"seeds": 8, "scenes": 2}
STEPS = 4


def run(shard: str, devices: int, folder: Path) -> tuple[Any, list[Any], Any]:
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


def compare(shard: str, folder: Path) -> dict[str, Any]:
    """Compares one device and eight."""
    folders = [folder / f"{shard}-{n}" for n in (1, 8)]
    (one, seen, _), (eight, others, again) = (
        run(shard, n, path) for n, path in zip((1, 8), folders, strict=True)
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


if __name__ == "__main__":
    programs.init_state, step.train_step = toys.init_state, toys.train_step
    results = {shard: compare(shard, Path(sys.argv[1])) for shard in SEEDS}
    print(json.dumps({"devices": len(jax.devices()), **results}))
