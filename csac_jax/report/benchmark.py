"""The benchmark of record: what ships and its baselines, in every suite, beside published numbers.

A cell is a policy in a suite, measured in C MuJoCo and kept in a file of its own, so that a
benchmark that was stopped goes on. Scenes follow from the seed and the share of the episodes.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from csac_jax import presets
from csac_jax.evaluation import policies, rollout, suites
from csac_jax.evaluation.policies import LearnedPolicy, Policy
from csac_jax.evaluation.statistics import Band
from csac_jax.io import files, policy_file
from csac_jax.report import result_tables

SEED = 0
OBJECTS = "made:7:400"  # the library whose held-out shapes suites of objects draw from
EPISODES = {  # of every part of a suite, in the whole benchmark
    "random10": 500,
    "random30": 100,
    "packed": 250,
    "cases": 250,
    "target": 250,
    "pile": 1000,
    "objects_packed": 1000,
    "objects10": 500,
    "target_objects": 500,
}
CLEARANCE = presets.objects().sim.clearance  # of every policy among objects, baselines too
CSAC = "doi:10.3390/electronics11132065"
METRICS = ("grasp_success", "completion", "declutter_rate", "action_efficiency")
_TITLES = ("grasp success", "completion", "objects taken", "objects per action")


class Published(NamedTuple):
    """Numbers of others, of their own simulators, scenes and objects; None: not given."""

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


def _grasps_alone() -> Policy:
    """The shipped policy, which never pushes."""
    policy = policies.load("shipped")
    assert isinstance(policy, LearnedPolicy)
    cfg = policy.cfg.change(policy={"primitive": "grasp"}, explore={"push_fraction": 0.0})
    return dataclasses.replace(policy, cfg=cfg)


POLICIES: dict[str, Callable[[], Policy]] = {
    "shipped": lambda: policies.load("shipped"),
    "shipped_grasp_only": _grasps_alone,
    "shipped_camera": lambda: policies.load("shipped_camera"),
    "shipped_clutter": lambda: policies.load("shipped_clutter"),
    "shipped_objects": lambda: policies.load("shipped_objects"),
    "shipped_target": lambda: policies.load("shipped_target"),
    "geometric": lambda: policies.POLICIES["geometric"]("shipped"),
    "random": lambda: policies.POLICIES["random"]("shipped"),
    "oracle": lambda: policies.POLICIES["oracle"]("shipped"),
}


class Cell(NamedTuple):
    """A policy in a suite."""

    suite: str
    policy: str
    episodes: int  # of every part

    def path(self, folder: Path) -> Path:
        """Where it is kept."""
        return folder / self.suite / f"{self.policy}.json"

    def asked(self) -> dict[str, Any]:
        """What its numbers follow from."""
        source = self.policy if self.policy in policy_file.SHIPPED else "shipped"
        digest = hashlib.sha256(policy_file.SHIPPED[source].read_bytes()).hexdigest()
        held = {"objects": OBJECTS, "clearance": CLEARANCE} if self.has_objects else {}
        return {**self._asdict(), "seed": SEED, "physics": "c", "policy_sha256": digest, **held}

    @property
    def has_objects(self) -> bool:
        """The suite draws objects of a library."""
        return suites.SUITES[self.suite].objects

    def acting(self) -> Policy:
        """The policy; among objects its tips go as low as objects need it, see CLEARANCE."""
        policy = POLICIES[self.policy]()
        if not self.has_objects:
            return policy
        return policies.in_world(policy, policy.cfg.change(sim={"clearance": CLEARANCE}))


def cells(share: float, of: tuple[str, ...] = (), by: tuple[str, ...] = ()) -> Iterator[Cell]:
    """The cells of these suites and policies, by default of all, with a share of the episodes, at
    least one. A learned policy acts where there are targets if it was trained for them, else where
    there are none."""
    for suite, episodes in EPISODES.items():
        for policy in POLICIES:
            fits = suites.SUITES[suite].target == (policy == "shipped_target")
            acts = fits or not policy.startswith("shipped")
            if suite in (of or EPISODES) and policy in (by or POLICIES) and acts:
                yield Cell(suite, policy, max(1, round(share * episodes)))


def kept(cell: Cell, folder: Path) -> dict[str, Any] | None:
    """The result of a cell in the folder, if it is whole and was measured as asked for now."""
    try:
        found = files.read_object(cell.path(folder))
    except (FileNotFoundError, ValueError):
        return None
    return found if cell.asked().items() <= found.items() else None


def measure(cell: Cell, progress: rollout.Progress | None = None) -> dict[str, Any]:
    """The result of a cell, see `rollout.evaluate`."""
    asked = cell.asked()
    result = rollout.evaluate(
        cell.acting(),
        cell.suite,
        cell.episodes,
        SEED,
        "c",
        progress=progress,
        objects=asked.get("objects"),
    )
    return {**asked, **result}


def markdown(results: list[dict[str, Any]]) -> str:
    """A table of results and, below those of each suite, the published numbers."""
    rows = [("suite", "method", "episodes", *_TITLES), ("---",) * (3 + len(_TITLES))]
    for suite in EPISODES:
        for result in (one for one in results if one["suite"] == suite):
            for part, summary in result.get("parts", {suite: result}).items():
                measured = (summary[metric] for metric in METRICS)
                shown = _shown(Band(**one) if one["n"] else None for one in measured)
                name = part if part == suite else f"{suite}, {part}"
                rows.append((name, result["policy"], str(result["episodes"]), *shown))
        for other in PUBLISHED.get(suite, ()):
            given = (getattr(other, metric) for metric in METRICS)
            shown = _shown(None if v is None else Band(v, None, None, 0) for v in given)
            rows.append((suite, f"{other.method} ({other.source})", "published", *shown))
    lines = [f"| {' | '.join(row)} |" for row in rows]
    note = (
        "In brackets: 95 % intervals. Published numbers are of other simulators, scenes, objects "
        "and cameras."
    )
    return "\n".join([*lines, "", note, ""])


def _shown(bands: Iterable[Band | None]) -> list[str]:
    """A band of each metric, as text."""
    return [result_tables.shown(band, metric=m) for band, m in zip(bands, METRICS, strict=True)]


def write_table(folder: Path, share: float) -> Path:
    """Writes the table of all that the folder holds at this share of the episodes, and the results
    themselves in one file, benchmark.json. Returns the table's path."""
    found = [one for cell in cells(share) if (one := kept(cell, folder)) is not None]
    path = folder / "benchmark.md"
    files.replace(path, markdown(found))
    text = json.dumps({"share": share, "results": found}, indent=1)
    files.replace(path.with_suffix(".json"), text + "\n")
    return path
