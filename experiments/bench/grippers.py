"""How do grippers do on random10? As JSON: `csac-jax bench grippers [--episodes N]`, in C
MuJoCo.

With each gripper that comes with the package: the planner that reads the blocks' poses, and the
shipped policy, which was trained with the RG2 alone and is told nothing of the gripper.
"""

import sys
from typing import Any

from csac_jax import grippers
from csac_jax.evaluation import policies, rollout
from experiments.bench._options import timed

SHOWN = ("grasp_success", "completion", "outcomes", "counts")


def _measured(policy: Any, gripper: str, episodes: int) -> dict[str, Any]:
    """What a policy does with a gripper."""
    cfg = policy.cfg.change(sim={"gripper": gripper})
    policy = policies.in_world(policy, cfg)
    found = rollout.evaluate(policy, "random10", episodes, seed=0, physics="c")
    return {name: found[name] for name in SHOWN}


def measure(episodes: int) -> dict[str, Any]:
    """Both policies with every gripper."""
    shipped = policies.load("shipped")
    kinds = {"oracle": policies.OraclePolicy(shipped.cfg), "shipped": shipped}
    rows = []
    for gripper in grippers.shipped():
        for kind, policy in kinds.items():
            found = _measured(policy, gripper, episodes)
            rows.append({"gripper": gripper, "policy": kind, **found})
            share = found["grasp_success"]["value"]
            print(f"{gripper} {kind}: grasp_success {share:.3f}", file=sys.stderr, flush=True)
    return {"episodes": episodes, "rows": rows}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("grippers", arguments, measure, episodes=50)
