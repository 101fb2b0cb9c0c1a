"""Measures what ships and its baselines in every suite; writes the table of docs/benchmarks.

    python -m experiments.benchmark --share 0.1 --out build/benchmark

Each policy is measured by `csac-jax eval --suites all --out OUT/POLICY`, so that a benchmark that
was stopped continues. Published numbers come from other simulators, scenes, objects and cameras.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

from csac_jax import cli
from csac_jax.evaluation import policies, suites
from csac_jax.evaluation.statistics import Band
from csac_jax.io import files, policy_file
from csac_jax.report import suite_table

OBJECTS = "procedural:7:400"  # the library whose held-out shapes suites of objects draw from
CLEARANCE = "0.004"  # m, of every policy among objects, baselines too
CSAC = "doi:10.3390/electronics11132065"
BASELINES = ("geometric", "random", "oracle")
SUITES = {
    False: ("random10", "random30", "cases", "packed", "target"),
    True: ("pile", "objects_packed", "objects10", "target_objects"),
}


class Published(NamedTuple):
    """Published numbers; None: not given."""

    method: str
    source: str
    grasp_success: float | None = None
    completion: float | None = None
    declutter_rate: float | None = None
    action_efficiency: float | None = None


PUBLISHED: dict[str, tuple[Published, ...]] = {
    "random30": (
        Published("VPG, 30 blocks", "arXiv:1803.09956", 0.677, 1.0, None, 0.61),
        Published("SPOT, 30 blocks", "arXiv:1909.11730", 0.84, 1.0, None, 0.74),
    ),
    "cases": (
        Published("VPG, as CSAC's authors ran it", CSAC, None, 0.6, None, 0.7),
        Published("CSAC-beta", CSAC, None, 0.9, None, 0.8),
    ),
    "pile": (
        Published("OrbitGrasp, random view", "arXiv:2407.03531", 0.967, None, 0.979),
        Published("NeuGraspNet, top view", "arXiv:2306.07392", 0.865, None, 0.835),
    ),
    "objects_packed": (
        Published("OrbitGrasp, random view", "arXiv:2407.03531", 0.983, None, 0.988),
        Published("NeuGraspNet, top view", "arXiv:2306.07392", 0.977, None, 0.932),
    ),
}


def measure(name: str, out: Path, share: float) -> int:
    """Measures a policy in all suites that fit it; returns the first exit code that is not 0."""
    source, kind = ("shipped", name) if name in BASELINES else (name, "learned")
    knows_target = kind != "learned" or policies.load_config(source).task.has_target
    for has_objects, names in SUITES.items():
        fits = [suite for suite in names if knows_target or not suites.SUITES[suite].target]
        command = ["eval", source, "--policy", kind, "--physics", "c", "--share", str(share)]
        command += ["--out", str(out / name), "--suites", *fits]
        if has_objects:
            command += ["--objects", OBJECTS, "--sim.clearance", CLEARANCE]
        if fits and (code := cli.main(command)):
            return code
    return 0


def table(results: list[dict[str, Any]]) -> str:
    """Writes all results suite by suite, published numbers below those of their suite."""
    rows: list[suite_table.Row] = []
    for suite in (*SUITES[False], *SUITES[True]):
        rows += suite_table.rows(one for one in results if one["suite"] == suite)
        for entry in PUBLISHED.get(suite, ()):
            values = [getattr(entry, metric) for metric in suite_table.METRICS]
            bands = [None if value is None else Band(value, None, None, 0) for value in values]
            title = f"{entry.method} ({entry.source})"
            rows.append((suite, title, "published", *suite_table.shown(bands)))
    return suite_table.markdown(rows)


def main() -> int:
    """Measures and writes OUT/benchmark.md and .json; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--share", type=float, default=1.0, help="share of the episodes")
    parser.add_argument("--out", type=Path, default=Path("build/benchmark"))
    options, results = parser.parse_args(), []
    for name in (*policy_file.SHIPPED, *BASELINES):
        if code := measure(name, options.out, options.share):
            return code
        for path in sorted((options.out / name).glob("*.json")):
            results.append({**files.read_object(path), "policy": name})
    files.replace(options.out / "benchmark.md", table(results))
    text = json.dumps({"share": options.share, "results": results}, indent=1)
    files.replace(options.out / "benchmark.json", text + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
