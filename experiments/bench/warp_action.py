"""Times physics on Warp, on a GPU, as JSON: `csac-jax bench warp_action [--scenes E ...] [--blocks
N ...] [--step MS ...] [--repeats N] [--pool N] [--task clear|target] [--details]`.

For each number of scenes (2048), of blocks (those of the preset `fast`), and for each longest step
in ms (ours): seconds of an action of the environment (`env`), of physics alone (`physics`), and of
a bare loop of Warp's own steps with the same blocks and set-points, recorded in graphs as ours are
(`bare`). They alternate; each is the median of N (5) rounds after one that does not count. `share`
is bare / env.

`first_action` is the time from the start of the process for the first row, of which `scenes_ready`
went into settling and reading N (64) scenes. `warp_bytes` is the most that Warp's pool held so far.
`bits_differ` is the number of leaves in which a second run of the same action differs.

--details adds milliseconds and launches of each kernel in an action whose substeps are launched one
by one: only then can Warp time them.
"""

import collections
import itertools
import re
import sys
import time
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import warp as wp

from csac_jax import env as environment, presets
from csac_jax.config import Config
from csac_jax.runtime import cache
from experiments.bench import _bare
from experiments.bench._options import Parser, emit, with_blocks
from experiments.bench._timing import medians


def _seconds_since_start() -> float:
    """Returns the age of this process, by Linux's clock."""
    ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / 100.0


def _config(scenes: int, blocks: int, pool: int, task: str) -> Config:
    cfg = presets.get("fast").change(
        sim={"physics": "warp"},
        scene={"pool": pool},
        task={"kind": task},
        train={"scenes": scenes, "learning_starts": max(scenes, 64)},
    )
    return cfg if blocks == len(cfg.scene.slots) else with_blocks(cfg, blocks)


def measure(cfg: Config, longest: float, repeats: int, details: bool) -> dict[str, Any]:
    """Times one config with one longest step, ms."""
    from csac_jax.sim import warp_action

    scenes = cfg.train.scenes
    with mock.patch.object(warp_action, "STEP", 1e-3 * longest):
        env = environment.make_env(cfg)
    states, actions, joints = jax.block_until_ready(_bare.grasping(cfg, env, scenes))
    begun = {"scenes_ready": _seconds_since_start()}
    step = jax.jit(jax.vmap(env.step))
    with mock.patch.object(warp_action, "STEP", 1e-3 * longest):
        first = jax.device_get(step(states, actions))
    begun["first_action"] = _seconds_since_start()
    run = jax.jit(jax.vmap(env.physics.run))
    bare = _bare.loop(env.physics, states.scene, joints)
    calls = {"env": lambda: step(states, actions), "physics": lambda: run(states.scene, joints)}
    seconds = medians({**calls, "bare": bare}, repeats)
    row = {"scenes": scenes, "blocks": len(cfg.scene.slots), "seconds": seconds}
    row |= {"steps": env.physics.simulator.substeps}
    row |= {"actions_per_second": scenes / seconds["env"], **begun, **_bytes()}
    row |= {"share": seconds["bare"] / seconds["env"]}
    row |= {"bits_differ": _differing(first, jax.device_get(step(states, actions)))}
    row |= {"overflows": int(first.info.contact_overflow.sum())}
    row |= {"diverged": int(first.info.physics_diverged.sum())}
    if details:
        row["kernels"] = _kernels(env, joints)
    return row


def _differing(one: Any, other: Any) -> int:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return sum(a.tobytes() != b.tobytes() for a, b in pairs)


def _kernels(env: environment.Env, joints: Any) -> dict[str, list[float]]:
    """Times each kernel in an action: milliseconds and launches, longest first."""
    batch = env.physics.simulator.prepared(len(joints.control))
    batch.restart()
    wp.timing_begin(wp.TIMING_ALL)
    for _ in range(batch.substeps):
        batch.substep()
    found: dict[str, list[float]] = collections.defaultdict(lambda: [0.0, 0])
    for each in wp.timing_end():
        name = re.sub(r"_[0-9a-f]{8}\b|__locals__\w*kernel", "", each.name.split(" ")[-1])
        found[name][0] += each.elapsed
        found[name][1] += 1
    return dict(sorted(found.items(), key=lambda item: -item[1][0]))


def _bytes() -> dict[str, Any]:
    device = wp.get_device()
    if not device.is_cuda:
        return {}
    by_jax = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    return {"warp_bytes": wp.get_mempool_used_mem_high(device), "jax_bytes": by_jax}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    parser = Parser(prog="bench warp_action", allow_abbrev=False)
    parser.add_argument("--scenes", type=int, nargs="+", default=[2048])
    parser.add_argument("--blocks", type=int, nargs="+", default=[10])
    parser.add_argument("--step", type=float, nargs="+", default=None)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--pool", type=int, default=64)
    parser.add_argument("--task", choices=("clear", "target"), default="clear")
    parser.add_argument("--details", action="store_true")
    options = parser.parse_args(arguments)
    cache.enable()
    from csac_jax.sim import warp_action

    steps = options.step or [1e3 * warp_action.STEP]
    rows = []
    for scenes, blocks, longest in itertools.product(options.scenes, options.blocks, steps):
        cfg = _config(scenes, blocks, options.pool, options.task)
        rows.append(measure(cfg, longest, options.repeats, options.details))
        done = {name: value for name, value in rows[-1].items() if name != "kernels"}
        print(f"{longest} ms: {done}", file=sys.stderr, flush=True)
    emit({"runs": rows})
