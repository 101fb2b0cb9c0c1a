"""Tunes the geometric baseline, as JSON: `csac-jax bench geometric [--episodes N] [--seed N]`.

One weight after another is halved, doubled or left out, and kept where more grasps succeed in
`pile` and `objects_packed` together. The objects are those that train, the scenes of a seed that no
result is from.
"""

import sys
from typing import Any

from csac_jax import presets
from csac_jax.agent.antipodal import Weights
from csac_jax.evaluation import policies, rollout, suites
from experiments.bench._options import timed

SUITES = ("pile", "objects_packed")
FACTORS = (0.0, 0.5, 2.0)


def measure(episodes: int, seed: int) -> dict[str, Any]:
    """Grasp success of every variant tried, and the weights in the end."""
    cfg = presets.get("objects")
    parts: dict[str, Any] = {}
    for suite in SUITES:
        seen = suites.with_objects(cfg, suite, None, "train")
        seen = rollout.configured(seen, "c", "hand")
        parts |= suites.environments(seen, suite, episodes, seed)
        print(f"{suite}: scenes at rest", file=sys.stderr, flush=True)
    rows: list[dict[str, Any]] = []

    def success(weights: Weights, what: str) -> float:
        row: dict[str, Any] = {"variant": what}
        for name, env in parts.items():
            policy = policies.GeometricPolicy(env.cfg, weights)
            found = rollout.measure(policy, {name: env}, episodes, seed, None)
            row[name] = found["grasp_success"]["value"]
        rows.append(row)
        print(row, file=sys.stderr, flush=True)
        return sum(row[name] for name in parts)

    best = Weights()
    value = success(best, "as it is")
    for name, weight in vars(Weights()).items():
        for factor in FACTORS:
            tried = best.replace(**{name: factor * weight})
            if (other := success(tried, f"{name} x {factor:g}")) > value:
                best, value = tried, other
    return {"episodes": episodes, "seed": seed, "rows": rows, "weights": vars(best)}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("geometric", arguments, measure, episodes=60, seed=100)
