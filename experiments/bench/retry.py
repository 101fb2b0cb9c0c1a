"""How boldly to go on after a failed grasp? As JSON: `csac-jax bench retry [--episodes N]`.

`shipped_objects` with other temperatures `policy.retry`, in C MuJoCo, among new shapes that are not
those of the benchmark: in `objects10`, where failures end no episode, and in `pile`.
"""

import sys
from typing import Any

from csac_jax.evaluation import policies, rollout
from experiments.bench._options import timed

TEMPERATURES = (0.0, 0.03, 0.1, 0.3, 1.0)
SUITES = ("objects10", "pile")
OBJECTS, SEED = "mixed:9:400", 5
METRICS = ("grasp_success", "completion", "declutter_rate", "action_efficiency")


def measure(episodes: int) -> dict[str, Any]:
    """Every temperature in every suite."""
    rows, shipped = [], policies.load("shipped_objects")
    for suite in SUITES:
        for temperature in TEMPERATURES:
            bold = policies.in_world(shipped, shipped.cfg.change(policy={"retry": temperature}))
            how: Any = {"objects": OBJECTS, "split": "train", "physics": "c", "seed": SEED}
            found = rollout.evaluate(bold, suite, episodes, **how)
            row = {"suite": suite, "temperature": temperature}
            rows.append(row | {name: found[name] for name in METRICS})
            share = found["grasp_success"]["value"]
            print(f"{row} grasp_success {share:.3f}", file=sys.stderr, flush=True)
    return {"episodes": episodes, "objects": OBJECTS, "seed": SEED, "rows": rows}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("retry", arguments, measure, episodes=100)
