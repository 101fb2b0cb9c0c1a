"""Times seeds side by side, as JSON: `csac-jax bench sweep [PRESET] [--seeds 1 4 16] [--devices
1 ...] [--shard seeds|scenes] [--steps N] [--repeats N] [SETTING ...]`, PRESET `quick` if none is
given, settings as `csac-jax train` takes them: `--train.scenes 64`.

For every number of devices and of seeds, the compiled loop of STEPS (2) training steps of all of
them: its compilation and the median of REPEATS (3) rounds after one that is not timed. With --shard
seeds, numbers of seeds that the devices do not divide are left out. Beside a row of one seed on one
device, `train` is its program as `csac-jax train` has it. `parts` is how many parts the seeds run
in, see `Pipelined` in csac_jax/sweeps/replicas.py. Configurations follow one another, so that on a
busy machine ratios are worth less than those of `bench step`. Rows also go to standard error.
"""

import dataclasses
import itertools
import json
import statistics
import sys
import time
from typing import Any

import jax

from csac_jax.runtime import compiler
from csac_jax.sim import backend
from csac_jax.sweeps import grid, replicas, runner
from csac_jax.training import programs, sharding
from csac_jax.training.step import Program
from experiments.bench._options import Parser, config, emit, split


def _timed(jitted: Any, state: Any, repeats: int) -> dict[str, Any]:
    """Times the compilation and repeated calls, each from the state of the last."""
    begun = time.perf_counter()
    chunk = compiler.lower(jitted, state).compile()
    compiled = time.perf_counter() - begun
    seconds = []
    for _ in range(1 + repeats):
        begun = time.perf_counter()
        state, metrics = chunk(state)
        jax.block_until_ready((state, metrics))
        seconds.append(time.perf_counter() - begun)
    times = {"compile_seconds": compiled, "seconds": statistics.median(seconds[1:])}
    return times | {"temporary_bytes": chunk.memory_analysis().temp_size_in_bytes}


def measure(
    program: Program, seeds: int, devices: int, shard: sharding.Shard, steps: int, repeats: int
) -> Any:
    """Measures a row: `seeds` runs on `devices` devices."""
    cfg, mesh = program.cfg, sharding.make(devices)
    sharding.check(mesh, shard, seeds, cfg.train.scenes, cfg.learn.batch)
    (group,) = replicas.group_configs([dataclasses.replace(cfg, seed=k) for k in range(seeds)])
    parts = replicas.num_parts(cfg, seeds, mesh)
    together = replicas.SweepProgram(program, replicas.group_replicas(group), mesh, shard, parts)
    row = _timed(together.compile_chunk(steps), together.init(), repeats)
    rate = seeds * cfg.train.scenes * steps / row["seconds"]
    return {"seeds": seeds, "devices": devices, "parts": parts, **row, "actions_per_second": rate}


def main(arguments: list[str]) -> None:
    """Prints the result. Raises SettingsError for what cannot be measured."""
    parser = Parser(prog="bench sweep", description=__doc__, allow_abbrev=False)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--devices", type=int, nargs="+", default=[1])
    parser.add_argument("--shard", choices=["seeds", "scenes"], default="seeds")
    for name, default in (("steps", 2), ("repeats", 3)):
        parser.add_argument(f"--{name}", type=int, default=default)
    preset, options, flags = split(parser, arguments)
    if min(*options.seeds, options.steps, options.repeats) < 1:
        parser.error("--seeds, --steps, --repeats: at least 1")
    most_devices, most_seeds = max(options.devices), max(options.seeds)
    cfg = backend.resolve(config("sweep", preset, flags), most_devices, most_seeds)
    for devices in options.devices:
        mesh = sharding.make(devices)
        sharding.check(mesh, options.shard, 0, cfg.train.scenes, cfg.learn.batch)
        most = runner.SweepPlan(most_seeds, [grid.SweepPoint("base", {}, cfg)])
        runner.check_room(most, 1 if options.shard == "scenes" else devices)
    program, steps, repeats = programs.make(cfg), options.steps, options.repeats
    alone = None
    if 1 in options.seeds and 1 in options.devices:
        chunk = programs.compile_chunk(program, steps)
        alone = _timed(chunk, programs.init(program), repeats)
    rows = []
    for devices, seeds in itertools.product(options.devices, options.seeds):
        if options.shard == "scenes" or seeds % devices == 0:
            row = measure(program, seeds, devices, options.shard, steps, repeats)
            print(f"bench sweep: {json.dumps(row)}", file=sys.stderr)
            rows.append(row)
    sizes = {"scenes": cfg.train.scenes, "batch": cfg.learn.batch, "steps": steps}
    sizes |= {"shard": options.shard, "physics": cfg.sim.physics, "settings": flags}
    emit({"preset": cfg.preset, **sizes, "train": alone, "rows": rows})
