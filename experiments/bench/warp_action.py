"""Physics on Warp, on a GPU, as JSON: `csac-jax bench warp_action [--scenes E ...] [--repeats N]
[--pool N]`.

For each number of scenes (2048) of the preset `fast`: seconds of an action of the environment
(`env`), of physics alone (`physics`), and of a bare loop of Warp's own steps with the same blocks
and set-points, recorded in graphs as ours are (`bare`). They alternate; each is the median of N (5)
rounds after one that does not count. `share` is bare / env. `first_action` is the time from the
start of the process for the first number of scenes, of which `scenes_ready` went into settling and
reading N (64) scenes. `warp_bytes` is the most that Warp's pool held so far. `calls` counts the
calls of Warp that a scan of two steps makes, which are to be two.
"""

import functools
import json
import time
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import warp as wp

from csac_jax import env as environment, presets
from csac_jax.config import Config
from csac_jax.runtime import provenance
from csac_jax.sim import oracle
from csac_jax.sim.primitives import Action
from csac_jax.sim.warp_action import Batch
from experiments.bench import _bare
from experiments.bench._options import Parser
from experiments.bench._timing import medians


def _seconds_since_start() -> float:
    """Of this process, by Linux's clock."""
    ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / 100.0


def _config(scenes: int, pool: int) -> Config:
    return presets.get("fast").change(
        sim={"physics": "warp"},
        scene={"pool": pool},
        train={"scenes": scenes, "learning_starts": max(scenes, 64)},
    )


def measure(scenes: int, pool: int, repeats: int) -> dict[str, Any]:
    """One number of scenes."""
    cfg = _config(scenes, pool)
    env = environment.make_env(cfg)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), scenes))
    grasp = functools.partial(oracle.grasp, cfg)
    actions = jax.jit(jax.vmap(grasp))(states.scene, states.obs.height)
    joints = jax.block_until_ready(_bare.joint_trajectories(cfg, states.obs.height, actions))
    begun = {"scenes_ready": _seconds_since_start()}
    step = jax.jit(jax.vmap(env.step))
    jax.block_until_ready(step(states, actions))
    begun["first_action"] = _seconds_since_start()
    run = jax.jit(jax.vmap(env.physics.run))
    bare = _bare.loop(env.physics, states.scene, joints)
    calls = {"env": lambda: step(states, actions), "physics": lambda: run(states.scene, joints)}
    seconds = medians({**calls, "bare": bare}, repeats)
    row = {"scenes": scenes, "seconds": seconds, **begun, **_bytes()}
    row |= {"actions_per_second": scenes / seconds["env"]}
    return row | {"share": seconds["bare"] / seconds["env"], "calls": _calls(env, states, actions)}


def _calls(env: environment.Env, states: environment.State, actions: Action) -> int:
    """Calls of Warp in a scan of two steps that keeps what training keeps."""

    def step(states: environment.State, _: None) -> tuple[environment.State, Any]:
        after = jax.vmap(env.step)(states, actions)
        return after, after.info

    with mock.patch.object(Batch, "run", autospec=True, side_effect=Batch.run) as counted:
        scan = jax.jit(lambda states: jax.lax.scan(step, states, length=2))
        jax.block_until_ready(scan(states))
    return counted.call_count


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
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--pool", type=int, default=64)
    options = parser.parse_args(arguments)
    rows = [measure(scenes, options.pool, options.repeats) for scenes in options.scenes]
    print(json.dumps({"runs": rows} | provenance.record(), indent=2))
