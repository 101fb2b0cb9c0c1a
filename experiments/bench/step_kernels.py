"""Kernels of a training step on a GPU by what they do, as JSON: `csac-jax bench step_kernels
[PRESET] [--devices N] [--seeds N] [SETTING ...]`, PRESET `quick` if none is given, settings as
`csac-jax train` takes them. The scenes of a run, or the seeds if there are several, lie on N (1)
GPUs; the first one's kernels are listed.

One step of a compiled loop, the third, as JAX's profiler traces it: `ms` and `launches` of
`physics` on Warp, matrix `products` and convolutions, `reductions`, `sorts`, `copies` of memory,
what `moves` or rearranges arrays, `exchanges` between GPUs, in which they wait for one another, and
`other` arithmetic. `busy` is the share of the step's time, `step_ms`, in which kernels run.
"""

import collections
import dataclasses
import re
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
from jax.profiler import ProfileData
from jax.sharding import Mesh

from csac_jax.errors import SettingsError
from csac_jax.runtime import cache
from csac_jax.sim import backend
from csac_jax.sweeps import replicas
from csac_jax.training import programs, sharding
from csac_jax.training.step import Program
from experiments.bench._options import config, emit, read_preset

KINDS = {  # the first that a kernel's name holds
    "exchanges": r"nccl|all.?reduce|all.?gather",
    "physics": r"_cuda_kernel|__locals__",
    "copies": r"memcpy|memset",
    "products": r"xmma|cutlass|nvjet|gemm|cudnn|convolution",
    "sorts": r"sort|radix|stream_executor::cuda::run",
    "reductions": r"reduce",
    "moves": r"concat|transpose|slice|pad|copy|gather|scatter|select|convert|broadcast",
    "other": r"",
}


def kind(kernel: str) -> str:
    """Returns the kind of a kernel by its name."""
    return next(kind for kind, names in KINDS.items() if re.search(names, kernel.lower()))


def table(kernels: Iterable[tuple[str, float, float]]) -> dict[str, Any]:
    """Sums by kind of kernels (name, start ms, end ms)."""
    every = list(kernels)
    if not every:
        raise SettingsError("bench step_kernels: no GPU ran a kernel")
    found: dict[str, list[float]] = collections.defaultdict(lambda: [0.0, 0])
    for name, start, end in every:
        found[kind(name)][0] += end - start
        found[kind(name)][1] += 1
    whole = max(end for *_, end in every) - min(start for _, start, _ in every)
    longest = sorted(found.items(), key=lambda item: -item[1][0])
    return {
        "step_ms": whole,
        "busy": sum(ms for ms, _ in found.values()) / whole,
        "kinds": {name: {"ms": ms, "launches": count} for name, (ms, count) in longest},
    }


def _traced(folder: Path) -> Iterable[tuple[str, float, float]]:
    """Yields the kernels of the first GPU."""
    (file,) = folder.rglob("*.xplane.pb")
    for plane in ProfileData.from_file(str(file)).planes:
        for line in plane.lines if plane.name.endswith("GPU:0") else ():
            for event in line.events if line.name.startswith("Stream") else ():
                yield event.name, 1e-6 * event.start_ns, 1e-6 * event.end_ns


def _compiled(program: Program, mesh: Mesh | None, seeds: int) -> tuple[Any, Any]:
    """Returns the state of a run, or of several seeds, and its compiled step."""
    if mesh is None and seeds == 1:
        return programs.init(program), programs.compile_chunk(program, 1)
    configs = [dataclasses.replace(program.cfg, seed=seed) for seed in range(seeds)]
    (group,) = replicas.group_configs(configs)
    runs = replicas.SweepProgram(program, replicas.group_replicas(group), mesh, _shard(seeds))
    return runs.init(), runs.compile_chunk(1)


def _shard(seeds: int) -> sharding.Shard:
    return "seeds" if seeds > 1 else "scenes"


def main(arguments: list[str]) -> None:
    """Prints the result. Raises SettingsError for devices that are not there, or do not divide
    the scenes or the seeds."""
    preset, numbers, flags = read_preset("step_kernels", arguments, devices=1, seeds=1)
    devices, seeds = numbers["devices"], numbers["seeds"]
    cfg = config("step_kernels", preset, flags).change(train={"chunk": 1})
    cfg = backend.resolve(cfg, devices, seeds)
    mesh = sharding.make(devices)
    sharding.check(mesh, _shard(seeds), seeds, cfg.train.scenes, cfg.learn.batch)
    cache.enable()
    state, chunk = _compiled(programs.make(cfg), mesh, seeds)
    for _ in range(2):
        state, _ = chunk(state)
    jax.block_until_ready(state)
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(chunk(state))
        found = table(_traced(Path(folder)))
    emit({"preset": preset, **numbers, "settings": flags, **found})
