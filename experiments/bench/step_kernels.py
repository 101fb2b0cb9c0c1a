"""Kernels of a training step on a GPU by what they do, as JSON: `csac-jax bench step_kernels
[PRESET] [SETTING ...]`, PRESET `quick` if none is given, settings as `csac-jax train` takes them.

One step of a compiled loop, the third, as JAX's profiler traces it: `ms` and `launches` of
`physics` on Warp, matrix `products` and convolutions, `reductions`, `sorts`, `copies` of memory,
what `moves` or rearranges arrays, and `other` arithmetic. `busy` is the share of the step's time in
which kernels run, `step_ms`.
"""

import collections
import json
import re
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
from jax.profiler import ProfileData

from csac_jax.errors import SettingsError
from csac_jax.runtime import cache, provenance
from csac_jax.sim import backend
from csac_jax.training import step
from experiments.bench._options import Parser, config, split

KINDS = {  # the first that a kernel's name holds
    "physics": r"_cuda_kernel|__locals__",
    "copies": r"memcpy|memset",
    "products": r"xmma|cutlass|nvjet|gemm|cudnn|convolution",
    "sorts": r"sort|radix|stream_executor::cuda::run",
    "reductions": r"reduce",
    "moves": r"concat|transpose|slice|pad|copy|gather|scatter|select|convert|broadcast",
    "other": r"",
}


def kind(kernel: str) -> str:
    """What a kernel of this name does."""
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
    """What the GPU's streams did."""
    (file,) = folder.rglob("*.xplane.pb")
    for plane in ProfileData.from_file(str(file)).planes:
        for line in plane.lines if "GPU" in plane.name else ():
            for event in line.events if line.name.startswith("Stream") else ():
                yield event.name, 1e-6 * event.start_ns, 1e-6 * event.end_ns


def main(arguments: list[str]) -> None:
    """Prints the result."""
    preset, _, flags = split(Parser(prog="bench step_kernels", allow_abbrev=False), arguments)
    cfg = backend.resolve(config("step_kernels", preset, flags).change(train={"chunk": 1}))
    cache.enable()
    program = step.make(cfg)
    state, chunk = step.init(program), step.compile_chunk(program, 1)
    for _ in range(2):
        state, _ = chunk(state)
    jax.block_until_ready(state)
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(chunk(state))
        found = table(_traced(Path(folder)))
    print(json.dumps({"preset": preset, **found, **provenance.record()}, indent=2))
