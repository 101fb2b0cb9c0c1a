"""Physics on Warp, on a GPU, as JSON: `csac-jax bench warp_action [--scenes E ...] [--repeats N]
[--pool N] [--mjx] [--set NAME=VALUE[;NAME=VALUE ...] ...]`.

For each number of scenes (2048) of the preset `fast`: seconds of an action of the environment
(`env`), of physics alone (`physics`), and of a bare loop of Warp's own steps with the same blocks
and set-points, recorded in graphs as ours are (`bare`). They alternate; each is the median of N (5)
rounds after one that does not count. `share` is bare / env. `first_action` is the time from the
start of the process for the first number of scenes, of which `scenes_ready` went into settling and
reading N (64) scenes. `warp_bytes` is the most that Warp's pool held so far. --mjx adds MJX's own
physics.

Each --set turns constants of `experiments/warp/action.py`, such as GRAPH_SUBSTEPS=190, and times
physics once more in the same scenes; `held_alike` is the share of blocks that end in the hand or
outside of it as before.

Before all substeps were one call, an action took 0.546 s with 2,048 scenes and 1.274 s with 8,192,
alone on an H200.
"""

import ast
import dataclasses
import functools
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import warp as wp

from csac_jax import env as environment, presets
from csac_jax.config import Config, PhysicsKind
from csac_jax.runtime import provenance
from csac_jax.scene import model
from csac_jax.scene.layout import Scene
from csac_jax.sim import oracle
from csac_jax.sim.physics import Physics
from csac_jax.sim.primitives import JointTrajectory
from experiments.bench import _bare
from experiments.bench._options import Parser
from experiments.bench._timing import medians
from experiments.warp import action, physics as warp_physics

Settings = dict[str, Any]  # constants of `experiments.warp.action` by name


def _seconds_since_start() -> float:
    """Of this process, by Linux's clock."""
    ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / 100.0


def _config(physics: PhysicsKind, scenes: int, pool: int) -> Config:
    return presets.get("fast").change(
        sim={"physics": physics},
        scene={"pool": pool},
        train={"scenes": scenes, "learning_starts": max(scenes, 64)},
    )


def _on_warp(cfg: Config) -> Physics:
    return warp_physics.make(model.build(cfg.scene, cfg.sim), cfg.sim)


def measure(
    physics: PhysicsKind, scenes: int, pool: int, repeats: int, variants: list[Settings]
) -> list[dict[str, Any]]:
    """One number of scenes, as the constants are, then with every variant of them."""
    cfg = _config(physics, scenes, pool)
    env = environment.make_env(cfg)
    if physics == "warp":
        env = dataclasses.replace(env, physics=_on_warp(cfg))
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), scenes))
    grasp = functools.partial(oracle.grasp, cfg)
    actions = jax.jit(jax.vmap(grasp))(states.scene, states.obs.height)
    joints = jax.block_until_ready(_bare.joint_trajectories(cfg, states.obs.height, actions))
    begun = {"scenes_ready": _seconds_since_start()}
    step = jax.jit(jax.vmap(env.step))
    jax.block_until_ready(step(states, actions))
    begun["first_action"] = _seconds_since_start()
    calls, held = _calls(env.physics, states.scene, joints)
    seconds = medians({"env": lambda: step(states, actions), **calls}, repeats)
    row = {"physics": physics, "scenes": scenes, "seconds": seconds, **begun, **_bytes()}
    row |= {"actions_per_second": scenes / seconds["env"]}
    rows = [row | {"share": seconds["bare"] / seconds["env"]}]
    for variant in variants:
        with mock.patch.multiple(action, **variant):
            other = _on_warp(cfg)
            calls, others_held = _calls(other, states.scene, joints)
            seconds = medians(calls, repeats)
        alike = float((held == others_held).mean())
        rows.append({"scenes": scenes, "set": variant, "seconds": seconds, "held_alike": alike})
    return rows


def _calls(
    physics: Physics, scenes: Scene, joints: JointTrajectory
) -> tuple[dict[str, Callable[[], Any]], jax.Array]:
    """What to time, and which blocks [E, N] the hand holds in the end."""
    run = jax.jit(jax.vmap(physics.run))
    _, trace = run(scenes, joints)
    bare = _bare.loop(physics, scenes, joints)
    return {"physics": lambda: run(scenes, joints), "bare": bare}, trace.held


def _bytes() -> dict[str, Any]:
    device = wp.get_device()
    if not device.is_cuda:
        return {}
    by_jax = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    return {"warp_bytes": wp.get_mempool_used_mem_high(device), "jax_bytes": by_jax}


def _settings(parser: Parser, text: str) -> Settings:
    settings = dict(pair.split("=", 1) for pair in text.split(";"))
    for name in settings:
        if not name.isupper() or name not in vars(action):
            parser.error(f"--set: {name} is no constant of experiments/warp/action.py")
    return {name: ast.literal_eval(value) for name, value in settings.items()}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    parser = Parser(prog="bench warp_action", allow_abbrev=False)
    parser.add_argument("--scenes", type=int, nargs="+", default=[2048])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--pool", type=int, default=64)
    parser.add_argument("--mjx", action="store_true")
    parser.add_argument("--set", nargs="+", default=[])
    options = parser.parse_args(arguments)
    variants = [_settings(parser, text) for text in options.set]
    rows = []
    for scenes in options.scenes:
        rows += measure("warp", scenes, options.pool, options.repeats, variants)
        if options.mjx:
            rows += measure("mjx", scenes, options.pool, options.repeats, [])
    print(json.dumps({"runs": rows} | provenance.record(), indent=2))
