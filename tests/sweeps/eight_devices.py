"""Run with eight virtual devices and a small step in place of the learner's: prints, as JSON, how
replicas on eight of them differ from those on one.

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
from csac_jax.training import program as programs, sharding, step
from tests.training import toys

SEEDS = {"seeds": 8, "scenes": 2}
STEPS = 4


def run(shard: str, devices: int, folder: Path) -> tuple[Any, list[Any], Any]:
    """State after two chunks, their metrics, and the second chunk's state from a checkpoint of the
    first."""
    cfg = toys.CFG
    (group,) = replicas.group_configs(
        [dataclasses.replace(cfg, seed=k) for k in range(SEEDS[shard])]
    )
    program = replicas.SweepProgram(
        toys.program(cfg), replicas.group_replicas(group), sharding.make(devices), shard
    )
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


def _leaves(tree: Any) -> list[np.ndarray]:
    is_key = [
        jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in jax.tree.leaves(tree)
    ]
    leaves = zip(jax.tree.leaves(tree), is_key, strict=True)
    return [np.asarray(jax.random.key_data(leaf) if key else leaf) for leaf, key in leaves]


def _difference(a: Any, b: Any) -> float:
    """Largest difference of two trees, relative to the larger of 1 and the value."""
    pairs = zip(_leaves(a), _leaves(b), strict=True)
    return max(
        float(np.max(np.abs(x.astype(float) - y) / np.maximum(np.abs(y), 1.0))) for x, y in pairs
    )


def compare(shard: str, folder: Path) -> dict[str, Any]:
    """What differs between one device and eight."""
    (one, seen, _), (eight, others, again) = (
        run(shard, n, folder / f"{shard}-{n}") for n in (1, 8)
    )
    abstract = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), one)
    elsewhere, _ = checkpoint.restore(
        folder / f"{shard}-8", abstract
    )  # saved on eight, read on one
    parts = [
        leaf.addressable_shards[0].data.shape for leaf in (eight.scenes, eight.learner["online"])
    ]
    return {
        "metrics": max(
            _difference(a._asdict(), b._asdict()) for a, b in zip(seen, others, strict=True)
        ),
        "state": _difference(one, eight),
        "resumed": _difference(eight, again),
        "moved": _difference(elsewhere, checkpoint.restore(folder / f"{shard}-1", abstract)[0]),
        "parts": parts,
    }


if __name__ == "__main__":
    programs.init_state, step.train_step = toys.init_state, toys.train_step
    found = {shard: compare(shard, Path(sys.argv[1])) for shard in SEEDS}
    print(json.dumps({"devices": len(jax.devices()), **found}))
