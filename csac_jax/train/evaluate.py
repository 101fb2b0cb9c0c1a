"""Episodes of a fixed policy in scenes of their own, all side by side in one compiled step."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.agent import learner as learning, maps, policy
from csac_jax.agent.learner import Params
from csac_jax.config import Config
from csac_jax.env import Env, State
from csac_jax.sim import oracle, primitives, robot
from csac_jax.sim.primitives import Action
from csac_jax.sim.robot import Drive
from csac_jax.train.metrics import Episodes

POLICIES = ("learned", "random", "oracle")
SIDE_BY_SIDE = 64  # most episodes that run at once

Policy = Callable[[jax.Array, Params, State], Action]  # key [], params, leaves [E, ...] -> leaves [E, ...]


def rollout(cfg: Config, env: Env, name: str, params: Params | None, episodes: int, seed: int) -> Episodes:
    """Runs `episodes` episodes of a policy, their scenes spread evenly over the environment's pool.

    Args: name, one of POLICIES; params, the networks that `learned` needs; seed of the policy's and the scenes' turns.
    Episodes end as in training: table cleared, action cap, no-change cap.
    """
    act = _policy(cfg, env, name)
    step = jax.jit(lambda key, params, states: _step(env, act, key, params, states))
    key = jax.random.key(seed)
    parts = []
    for first in range(0, episodes, SIDE_BY_SIDE):
        rows = np.arange(first, min(first + SIDE_BY_SIDE, episodes)) * env.scenes.position.shape[0] // episodes
        parts.append(_run(cfg, env, step, params, jax.random.fold_in(key, first), rows))
    return Episodes(*(np.concatenate(leaves) for leaves in zip(*parts, strict=True)))


class Moment(NamedTuple):
    """One action of an episode; leaves of one scene, NumPy."""

    before: State
    action: Action
    drive: Drive  # how the robot moved
    after: State


def episode(cfg: Config, env: Env, name: str, params: Params | None, seed: int) -> Iterator[Moment]:
    """One episode of a policy in the first scene of the environment's pool, action by action."""
    act = _policy(cfg, env, name)

    @jax.jit
    def step(key: jax.Array, params: Params, states: State):
        action = act(key, params, states)
        plan = jax.vmap(lambda obs, one: primitives.plan(cfg.sim, cfg.heightmap, obs.height, one))(states.obs, action)
        drive = jax.vmap(lambda one: robot.drive(cfg.sim.robot, one))(plan)
        return action, drive, jax.vmap(env.step)(states, action)

    key = jax.random.key(seed)
    states = jax.jit(lambda key: _begin(env, key, np.zeros(1, int)))(jax.random.fold_in(key, 0))
    for number in range(1, cfg.task.max_actions + 1):
        action, drive, after = step(jax.random.fold_in(key, number), params, states)
        yield jax.tree.map(lambda leaf: np.asarray(leaf)[0], Moment(states, action, drive, after))
        states = after
        if bool(after.done[0]):
            return


def _run(cfg: Config, env: Env, step: Callable, params: Params | None, key: jax.Array, rows: np.ndarray) -> Episodes:
    """The episodes that begin with the scenes `rows` of the pool."""
    states = jax.jit(lambda key: _begin(env, key, rows))(jax.random.fold_in(key, 0))
    one = cfg.task.kind == "target"
    blocks = np.ones(len(rows), np.int32) if one else np.asarray(states.scene.in_play.sum(axis=1))
    records = []
    for number in range(1, cfg.task.max_actions + 1):
        states, record = step(jax.random.fold_in(key, number), params, states)
        records.append(jax.device_get(record))
        if np.all(states.done):
            break
    valid, primitive, outcome, cleared, left = (np.stack(leaves, axis=1) for leaves in zip(*records, strict=True))
    pad = ((0, 0), (0, cfg.task.max_actions - valid.shape[1]))
    return Episodes(
        valid=np.pad(valid, pad),
        primitive=np.pad(primitive, pad),
        outcome=np.pad(outcome, pad),
        cleared=np.pad(cleared, pad),
        blocks=blocks,
        completed=np.asarray(states.terminated),
        left=left.sum(axis=1),
    )


def _begin(env: Env, key: jax.Array, rows: np.ndarray) -> State:
    scenes = jax.tree.map(lambda leaf: jnp.asarray(leaf[rows]), env.scenes)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(rows)))
    return jax.vmap(env.begin)(jax.vmap(env.vary)(keys, scenes), keys)


def _step(env: Env, act: Policy, key: jax.Array, params: Params, states: State):
    """One action in every scene; finished ones stay. Record: valid, primitive, outcome, cleared, left, each [E]."""
    going = ~states.done
    action = act(key, params, states)
    after = jax.vmap(env.step)(states, action)
    info, one = after.info, env.cfg.task.kind == "target"
    lost = (after.terminated & (after.reward == 0.0)).astype(jnp.int32)
    record = (
        going,
        action.primitive,
        info.outcome,
        jnp.where(going, after.reward.astype(jnp.int32) if one else info.cleared, 0),
        jnp.where(going, lost if one else info.left, 0),
    )
    keep = jax.vmap(jnp.where)
    return jax.tree.map(lambda new, old: keep(going, new, old), after, states), record


def _policy(cfg: Config, env: Env, name: str) -> Policy:
    """The policy of that name. Raises ValueError for an unknown one."""
    learner = learning.make(cfg)
    frames, span = learner.frames, learner.bounds[1] - learner.bounds[0]

    def learned(key: jax.Array, params: Params, states: State) -> Action:
        dense_maps = learning.look(learner, params, states.obs)
        act = jax.vmap(policy.best_action, (0, None, None, 0, None, 0))
        return act(_keys(key, states), cfg, frames, dense_maps, span, states.idle)

    def random(key: jax.Array, params: Params, states: State) -> Action:
        valid = jax.vmap(maps.actionable, (None, 0))(frames, states.obs)
        return jax.vmap(policy.random_grasp, (0, None, 0))(_keys(key, states), frames, valid)

    def planned(key: jax.Array, params: Params, states: State) -> Action:
        plan = jax.vmap(oracle.grasp, (None, None, None, 0, 0))
        return plan(cfg.sim, cfg.heightmap, cfg.scene.slots, states.scene, states.obs.height)

    policies = {"learned": learned, "random": random, "oracle": planned}
    if name not in policies:
        raise ValueError(f"policy '{name}' is not one of: {', '.join(POLICIES)}")
    return policies[name]


def _keys(key: jax.Array, states: State) -> jax.Array:
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(states.actions.shape[0]))
