"""What bounds physics on Warp? As JSON: `csac-jax bench warp_kernels [--scenes E]`.

Counters of the GPU, by NVIDIA's `ncu`, which must be on the PATH. They are of ten substeps of E
(4096) scenes of `fast`: five while the fingers close, five while the hand lifts. For each kernel:
`launches`, its `share` of the time, `us` of a launch. `bandwidth` is the share of the memory's most
that it moves. `active` is that of the multiprocessors' warps which are there while it runs;
`issued` that of the instructions which they could issue. `all` weighs them by time.

ncu cannot follow what XLA launches. JAX makes the scenes on the host's cores here.
"""

import collections
import csv
import ctypes
import functools
import io
import json
import os
import re
import shutil
import subprocess
import sys
from typing import Any

from csac_jax.errors import SettingsError
from experiments.bench._options import read

FEW = 64  # scenes, which are repeated
COUNTED = (range(60, 65), range(100, 105))  # substeps
METRICS = {
    "seconds": "gpu__time_duration.sum",
    "bytes": "dram__bytes.sum",
    "active": "sm__warps_active.avg.pct_of_peak_sustained_active",
    "issued": "sm__inst_executed.avg.pct_of_peak_sustained_elapsed",
    "bandwidth": "dram__throughput.avg.pct_of_peak_sustained_elapsed",
}
_BYTES = {"byte": 1.0, "Kbyte": 1e3, "Mbyte": 1e6, "Gbyte": 1e9}
_UNITS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "%": 0.01, **_BYTES}


def launch(scenes: int) -> None:
    """The substeps, which a profiler counts."""
    import jax
    import numpy as np
    import warp as wp

    from csac_jax import env as environment, presets
    from csac_jax.sim import warp_physics
    from experiments.bench import _bare

    few = min(scenes, FEW)
    cfg = presets.get("fast").change(
        sim={"physics": "warp"}, scene={"pool": few}, train={"scenes": few, "learning_starts": FEW}
    )
    env: Any = environment.make_env(cfg)
    states, _, joints = _bare.grasping(cfg, env, few)
    inputs = functools.partial(warp_physics.inputs, env.physics)
    given = jax.device_get(jax.jit(jax.vmap(inputs))(states.scene, joints))
    simulator = env.physics.simulator
    batch = simulator.prepared(scenes)
    for target, name in zip(batch.given, simulator.arguments, strict=True):
        values = np.resize(given[name], (scenes, *given[name].shape[1:]))
        wp.copy(target, wp.array(values, dtype=target.dtype, ndim=target.ndim))
    cuda = ctypes.CDLL("libcuda.so.1")
    batch.restart()
    for substep in range(COUNTED[-1].stop):
        is_counted = any(substep in one for one in COUNTED)
        if is_counted:
            cuda.cuProfilerStart()
        batch.substep()
        wp.synchronize()
        if is_counted:
            cuda.cuProfilerStop()


def table(text: str) -> list[dict[str, Any]]:
    """Kernels by name, longest first, of what ncu writes as CSV; `all` comes first."""
    launches: dict[str, dict[str, Any]] = {}
    for row in csv.DictReader(io.StringIO(text[text.index('"ID"') :])):
        one = launches.setdefault(row["ID"], {"kernel": row["Kernel Name"]})
        value = float(row["Metric Value"].replace(",", ""))
        one[row["Metric Name"]] = value * _UNITS[row["Metric Unit"]]
    sums: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    for one in launches.values():
        name = re.sub(r"_[0-9a-f]{8}(_cuda_kernel.*)?$|__locals__.*", "", one["kernel"])
        seconds = one[METRICS["seconds"]]
        for group in ("all", name):
            sums[group].update({"launches": 1, "seconds": seconds, "bytes": one[METRICS["bytes"]]})
            weighed = ("active", "issued", "bandwidth")
            sums[group].update({key: seconds * one[METRICS[key]] for key in weighed})
    whole = sums["all"]["seconds"]
    return [
        {
            "kernel": name,
            "launches": found["launches"],
            "share": found["seconds"] / whole,
            "us": 1e6 * found["seconds"] / found["launches"],
            "terabytes_per_second": 1e-12 * found["bytes"] / found["seconds"],
            **{key: found[key] / found["seconds"] for key in ("bandwidth", "active", "issued")},
        }
        for name, found in sorted(sums.items(), key=lambda item: -item[1]["seconds"])
    ]


def main(arguments: list[str]) -> None:
    """Prints the result."""
    options = read("warp_kernels", arguments, scenes=4096, counted=False)
    if options["counted"]:  # by ncu, which runs this process
        launch(options["scenes"])
        return
    if shutil.which("ncu") is None:
        raise SettingsError("bench warp_kernels: ncu is not on the PATH; CUDA's toolkit has it")
    ncu = ["ncu", "--profile-from-start", "off", "--cache-control", "none"]
    ncu += ["--clock-control", "none", "--metrics", ",".join(METRICS.values()), "--csv"]
    own = [sys.executable, "-m", "csac_jax", "bench", "warp_kernels", "--counted"]
    own += ["--scenes", str(options["scenes"])]
    on_host = os.environ | {"JAX_PLATFORMS": "cpu"}
    found = subprocess.run([*ncu, *own], check=False, capture_output=True, text=True, env=on_host)
    if '"ID"' not in found.stdout:
        said = (found.stderr or found.stdout).strip().splitlines()
        raise SettingsError(f"bench warp_kernels: ncu counted nothing: {' '.join(said[-1:])}")
    from csac_jax.runtime import provenance

    counted = {"scenes": options["scenes"], "kernels": table(found.stdout)}
    print(json.dumps(counted | provenance.record(), indent=2))
