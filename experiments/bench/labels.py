"""How often do the finger gap and the height map tell a grasp's outcome as the simulator does?

`csac-jax bench labels [--episodes N] [--actions N]`: N episodes of N actions each in ten dropped
blocks, in C physics. The shipped policy acts, or grasps are random: above blocks, or anywhere.
Prints JSON: for each, rows by true outcome, columns by sensed one, and what disagrees.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.constants import OUTCOMES, Outcome, Primitive
from csac_jax.env import Env, State
from csac_jax.evaluation import policies, rollout, suites
from csac_jax.evaluation.policies import Policy, RandomPolicy
from experiments.bench._options import timed

SUITE = "random10"


def confusion(env: Env, policy: Policy, episodes: int, actions: int) -> np.ndarray:
    """Grasps by true and sensed outcome, [5, 5]; episodes that end go no further."""

    def act(key: jax.Array, states: State) -> tuple[State, tuple[jax.Array, ...]]:
        action = policies.act(policy, states, jax.random.split(key, episodes))
        after = jax.vmap(env.step)(states, action)
        counts = ~states.done & (action.primitive == Primitive.GRASP)
        later = jax.tree.map(
            lambda new, old: jax.vmap(jnp.where)(states.done, old, new), after, states
        )
        return later, (counts, after.info.outcome, after.info.outcome_by_gap)

    key, act = jax.random.key(0), jax.jit(act)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(key, episodes))
    found = np.zeros((len(Outcome), len(Outcome)), int)
    for number in range(actions):
        states, seen = act(jax.random.fold_in(key, number), states)
        counts, truth, sensed = jax.device_get(seen)
        np.add.at(found, (truth[counts], sensed[counts]), 1)
    return found


def labels(episodes: int, actions: int) -> dict[str, Any]:
    """The disagreement of each policy."""
    shipped: Any = policies.load("shipped")
    cfg = rollout.configured(shipped.cfg, "c", "hand")
    (env,) = suites.environments(cfg, SUITE, episodes, 0).values()
    anywhere = env.cfg.change(policy={"cells": "all"})
    acting: dict[str, Policy] = {
        "shipped": policies.in_world(shipped, env.cfg),
        "random_above_blocks": RandomPolicy(env.cfg),
        "random_anywhere": RandomPolicy(anywhere),
    }
    return {name: _told(confusion(env, each, episodes, actions)) for name, each in acting.items()}


def _told(found: np.ndarray) -> dict[str, Any]:
    lifted = np.arange(len(Outcome)) == Outcome.LIFTED
    return {
        "grasps": int(found.sum()),
        "outcomes_disagree": int(found.sum() - np.trace(found)),
        "lifted_sensed_alone": int(found[~lifted][:, lifted].sum()),
        "lifted_missed": int(found[lifted][:, ~lifted].sum()),
        "outcomes": list(OUTCOMES),
        "true_by_sensed": found.tolist(),
    }


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("labels", arguments, labels, episodes=32, actions=10)
