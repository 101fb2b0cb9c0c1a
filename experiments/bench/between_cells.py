"""Does a policy's search find actions between the cells of its maps, and do they lift more?

`csac-jax bench between_cells POLICY [--episodes N]`: episodes of POLICY, a run or a policy file, in
scenes like its training's, in C physics. In every state its action is compared with the best cell's
of the same networks: the share that lies more than half a cell or half a yaw's step away. Then the
best cells act alone, in the same scenes. Prints JSON: shares, and metrics of both.
"""

import dataclasses
import functools
import json
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.agent import maps
from csac_jax.env import Env, State
from csac_jax.evaluation import policies, rollout, suites
from csac_jax.evaluation.policies import LearnedPolicy
from csac_jax.nets import networks
from csac_jax.runtime import provenance
from csac_jax.sim.primitives import Action
from experiments.bench._options import Parser

SHOWN = ("grasp_success", "completion", "action_efficiency")


def moved(cfg: Any, action: Action, cell: Action) -> tuple[jax.Array, jax.Array]:
    """Whether an action lies more than half a cell, and more than half a yaw's step, from a cell's
    [] bool; False for another primitive."""
    frames = maps.frames(cfg, networks.make(cfg.net))
    same = action.primitive == cell.primitive
    apart = jnp.abs(action.pose - cell.pose)
    turned = jnp.minimum(apart[2], 2.0 * jnp.pi - apart[2])
    return same & (apart[:2].max() > 0.5 * frames.cell), same & (turned > jnp.pi / len(frames.yaws))


def compare(env: Env, policy: LearnedPolicy, cells: LearnedPolicy, episodes: int) -> dict[str, Any]:
    """Shares of the states of `policy`'s episodes in which it leaves the best cell."""

    def act(key: jax.Array, states: State) -> tuple[State, Any]:
        keys = jax.random.split(key, episodes)
        action, cell = policies.act(policy, states, keys), policies.act(cells, states, keys)
        after = jax.vmap(env.step)(states, action)
        later = jax.tree.map(
            lambda new, old: jax.vmap(jnp.where)(states.done, old, new), after, states
        )
        seen = (~states.done, action.primitive == cell.primitive)
        return later, (*seen, *jax.vmap(functools.partial(moved, env.cfg))(action, cell))

    key, act = jax.random.key(0), jax.jit(act)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(key, episodes))
    rows = []
    for number in range(env.cfg.task.max_actions):
        states, row = act(jax.random.fold_in(key, number), states)
        rows.append(jax.device_get(row))
    counts, same, far, turned = map(np.stack, zip(*rows, strict=True))
    shares = {"same_primitive": same, "half_a_cell": far, "half_a_yaw": turned}
    shares["either"] = far | turned
    return {"states": int(counts.sum())} | {
        name: float(hits[counts].mean()) for name, hits in shares.items()
    }


def between_cells(source: str, episodes: int) -> dict[str, Any]:
    """The comparison of a policy with its own best cells. Raises ValueError for a policy that takes
    the best cell itself."""
    policy: Any = policies.load(source)
    if policy.cfg.policy.place == "argmax":
        raise ValueError(
            f"bench between_cells: {source} takes the best cell; give one that searches"
        )
    cfg = rollout.configured(policy.cfg, "c", policy.cfg.sim.robot)
    parts = suites.environments(cfg, suites.IN_DISTRIBUTION, episodes, 0)
    (env,) = parts.values()
    policy = policies.in_world(policy, env.cfg)
    cells = policies.in_world(policy, env.cfg.change(policy={"place": "argmax"}))
    shares = compare(env, policy, cells, episodes)
    found = {"search": rollout.measure(policy, parts, episodes, 0, None)}
    best = {name: dataclasses.replace(one, cfg=cells.cfg) for name, one in parts.items()}
    found["best_cell"] = rollout.measure(cells, best, episodes, 0, None)
    shown = {kind: {name: one[name] for name in SHOWN} for kind, one in found.items()}
    kind = {"net": env.cfg.net.kind, "start": env.cfg.cem.start, "preset": env.cfg.preset}
    return {"policy": kind, "moved": shares, **shown}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    parser = Parser(prog="bench between_cells", allow_abbrev=False)
    parser.add_argument("policy")
    parser.add_argument("--episodes", type=int, default=100)
    options, begun = parser.parse_args(arguments), time.perf_counter()
    result = between_cells(options.policy, options.episodes)
    result["seconds"] = time.perf_counter() - begun
    print(json.dumps(result | provenance.record(), indent=2))
