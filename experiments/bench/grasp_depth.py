"""How low and how deep should the tips go? As JSON: `csac-jax bench grasp_depth [--episodes N]`.

The suite `pile` in C MuJoCo, of our own shapes that train: of all, and of low and hollow ones. The
shipped policy, with other clearances above the table at the usual depth below the surface, then
with other depths at one clearance.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import jax

from csac_jax.config import SimConfig
from csac_jax.evaluation import policies, rollout
from csac_jax.objects import families, library
from experiments.bench._options import timed

CLEARANCES, DEPTHS = (0.002, 0.004, 0.008, 0.012), (0.02, 0.035, 0.05)  # m
USUAL, LOW = SimConfig.grasp_depth, 0.004
WAYS = [(low, USUAL) for low in CLEARANCES] + [(LOW, deep) for deep in DEPTHS if deep != USUAL]
HOLLOW = ("bowl", "tube", "nut", "cup")
SHAPES = 200


def _measured(policy: Any, objects: str, low: float, episodes: int) -> dict[str, Any]:
    """Success of a policy whose tips go down to `low` m."""
    cfg = policy.cfg.change(sim={"clearance": low})
    found = rollout.evaluate(
        policies.in_world(policy, cfg),
        "pile",
        episodes,
        physics="c",
        objects=objects,
        split="train",
    )
    return {name: found[name] for name in ("grasp_success", "declutter_rate")}


def measure(episodes: int) -> dict[str, Any]:
    """Every clearance and depth, on both sets of objects."""
    shipped, rows = policies.load("shipped"), []
    with tempfile.TemporaryDirectory() as folder:
        hollow = [one for one in families.draw(0, SHAPES) if one.family in HOLLOW]
        library.save(Path(folder) / "hollow", [one for one in hollow if not one.held_out])
        sets = {"all": f"made:0:{SHAPES}", "hollow": str(Path(folder) / "hollow")}
        for low, deep in WAYS:
            SimConfig.grasp_depth = deep  # a constant, which compiled programs hold
            jax.clear_caches()
            for name, objects in sets.items():
                found = _measured(shipped, objects, low, episodes)
                row = {"clearance": low, "depth": deep, "objects": name}
                rows.append(row | found)
                share = found["grasp_success"]["value"]
                print(f"{row} grasp_success {share:.3f}", file=sys.stderr, flush=True)
    SimConfig.grasp_depth = USUAL
    return {"episodes": episodes, "rows": rows}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("grasp_depth", arguments, measure, episodes=40)
