"""What does a trained policy gain by how it acts? As JSON: `csac-jax bench acting [--episodes N]`.

`shipped_objects` with other temperatures `policy.retry`, with and without `policy.augment`, in C
MuJoCo, among new shapes that are not those of the benchmark; and how long one decision takes.
"""

import itertools
import sys
import time
from typing import Any

import jax
import numpy as np

import csac_jax
from csac_jax.evaluation import policies, rollout
from experiments.bench._options import timed

TEMPERATURES = (0.0, 0.1, 0.3)
SUITES = ("objects10", "pile", "objects_packed")
OBJECTS, SEED = "mixed:9:400", 5
METRICS = ("grasp_success", "completion", "declutter_rate", "action_efficiency")
DECISIONS = 20


def _milliseconds(policy: policies.LearnedPolicy) -> float:
    """Median time of a decision in one scene, once it is compiled."""
    env = csac_jax.make_env(policy.cfg.change(sim={"physics": "c"}, scene={"pool": 1}))
    state, spent = jax.jit(env.reset)(jax.random.key(0)), []
    for number in range(1 + DECISIONS):
        begun = time.perf_counter()
        jax.block_until_ready(policy(state, jax.random.key(number)))
        spent.append(1e3 * (time.perf_counter() - begun))
    return float(np.median(spent[1:]))


def measure(episodes: int) -> dict[str, Any]:
    """Every way of acting in every suite."""
    rows, times, shipped = [], {}, policies.load("shipped_objects")
    for augment, temperature in itertools.product((False, True), TEMPERATURES):
        way = {"retry": temperature, "augment": augment}
        acting = policies.in_world(shipped, shipped.cfg.change(policy=way))
        times.setdefault(augment, _milliseconds(acting))
        for suite in SUITES:
            how: Any = {"objects": OBJECTS, "split": "train", "physics": "c", "seed": SEED}
            found = rollout.evaluate(acting, suite, episodes, **how)
            row = {"suite": suite, **way, "milliseconds": times[augment]}
            rows.append(row | {name: found[name] for name in METRICS})
            share = found["grasp_success"]["value"]
            print(f"{row} grasp_success {share:.3f}", file=sys.stderr, flush=True)
    return {"episodes": episodes, "objects": OBJECTS, "seed": SEED, "rows": rows}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("acting", arguments, measure, episodes=100)
