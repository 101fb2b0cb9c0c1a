"""Episodes of a fixed policy in scenes of their own, all side by side in one compiled step."""

import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.agent import actor_critic, maps, policy, rewards
from csac_jax.agent.actor_critic import ActorCritic, Params
from csac_jax.config import Config
from csac_jax.constants import CHANGE_AREA
from csac_jax.env import Env, State
from csac_jax.evaluation.metrics import ENDINGS, Episodes
from csac_jax.scene.layout import Scene
from csac_jax.sim import oracle, primitives, robot
from csac_jax.sim.primitives import Action
from csac_jax.sim.robot import JointTrajectory

POLICIES = ("learned", "random", "oracle")
SIDE_BY_SIDE = 64  # most episodes that run at once
NO_SCENES: Any = None  # of an environment that neither resets nor restarts

Policy = Callable[
    [jax.Array, Params, State], Action
]  # keys [E], params, leaves [E, ...] -> leaves [E, ...]


def rollout(
    cfg: Config, env: Env, name: str, params: Params | None, episodes: int, seed: int
) -> Episodes:
    """Runs `episodes` episodes of a policy, their scenes spread evenly over the environment's pool.

    What an episode draws follows from the seed and its number alone, not from how many run side by
    side; what a network or MJX computes may still differ with that in the last bits.

    Args: name, one of POLICIES; params, the networks that `learned` needs; seed of the policy's and
    the scenes' turns. Episodes end as in training: table cleared, action cap, no-change cap.
    """
    program = _program(env, name)
    size = -(-episodes // -(-episodes // SIDE_BY_SIDE))  # batches of one size: one compilation
    parts = []
    for first in range(0, episodes, size):
        numbers = np.arange(first, first + size)
        rows = np.minimum(numbers, episodes - 1) * env.scenes.position.shape[0] // episodes
        scenes = jax.tree.map(lambda leaf, rows=rows: leaf[rows], env.scenes)
        parts.append(_run(cfg, program, params, seed, numbers, numbers < episodes, scenes))
    joined = Episodes(*(np.concatenate(leaves) for leaves in zip(*parts, strict=True)))
    return Episodes(*(leaf[:episodes] for leaf in joined))


class _Program(NamedTuple):
    """What is compiled for an environment and a policy, whatever its scenes are."""

    begin: Callable[[jax.Array, jax.Array, Scene], State]  # key, numbers [E], scenes [E, ...]
    step: Callable[..., Any]  # key, numbers [E], params, states -> states, record


def _program(env: Env, name: str) -> _Program:
    """The program of an environment; parts of a suite that share config and physics compile
    once."""
    kind: Any = type(env)
    physics: Any = env.physics
    return _cached(kind, env.cfg, physics, env.any_yaw, name)


@functools.lru_cache(maxsize=2)
def _cached(kind: Any, cfg: Config, physics: Any, any_yaw: bool, name: str) -> _Program:
    env = kind(cfg, physics, NO_SCENES, any_yaw)
    act = _policy(cfg, env, name)
    return _Program(
        jax.jit(lambda key, numbers, scenes: _begin(env, _keys(key, numbers), scenes)),
        jax.jit(
            lambda key, numbers, params, states: _step(
                env, act, _keys(key, numbers), params, states
            )
        ),
    )


class Thought(NamedTuple):
    """What a learned policy saw in a state. P = primitives, H W as the height map."""

    q: jax.Array  # [P, H, W] largest value over the yaws; -inf where there is nothing to act on
    candidates: jax.Array  # [P, J, 3] m, m, rad: the last poses that the cross-entropy method tried
    best_grasp: jax.Array  # [] phi_g of CSAC eq. 16, by the critic that acts


class Moment(NamedTuple):
    """One action of an episode; leaves of one scene, NumPy."""

    before: State
    action: Action
    joints: JointTrajectory  # how the robot moved
    after: State
    reward: (
        np.ndarray
    )  # [] R of CSAC eq. 12 for a learned policy; else 1 where a block that was asked for was taken
    thought: Thought | None  # of a learned policy


def episode(cfg: Config, env: Env, name: str, params: Params | None, seed: int) -> Iterator[Moment]:
    """One episode of a policy in the first scene of the environment's pool, action by action."""
    act, numbers = _policy(cfg, env, name), jnp.zeros(1, jnp.int32)
    learner = actor_critic.make(cfg) if name == "learned" else None

    @jax.jit
    def step(key: jax.Array, params: Params, states: State):
        keys = _keys(key, numbers)
        action = act(keys, params, states)
        plan = jax.vmap(lambda obs, one: primitives.plan(cfg.sim, cfg.heightmap, obs.height, one))(
            states.obs, action
        )
        joints = jax.vmap(lambda one: robot.joint_trajectory(cfg.sim.robot, one))(plan)
        after = jax.vmap(env.step)(states, action)
        if learner is None:
            return action, joints, after, after.reward, None
        thought = _think(learner, keys, params, states)
        return action, joints, after, _rewards(learner, params, thought, action, after), thought

    key = jax.random.key(seed)
    first = jax.tree.map(lambda leaf: leaf[:1], env.scenes)
    states = jax.jit(lambda key: _begin(env, _keys(key, numbers), first))(
        jax.random.fold_in(key, 0)
    )
    for number in range(1, cfg.task.max_actions + 1):
        action, joints, after, reward, thought = step(
            jax.random.fold_in(key, number), params, states
        )
        yield jax.tree.map(
            lambda leaf: np.asarray(leaf)[0], Moment(states, action, joints, after, reward, thought)
        )
        states = after
        if bool(after.done[0]):
            return


def _think(learner: ActorCritic, keys: jax.Array, params: Params, states: State) -> Thought:
    """What the policy `learned`, given the same keys, looks at; leaves [E, ...]."""
    cfg, frames = learner.cfg, learner.frames
    seen = actor_critic.look(learner, params, states.obs)
    places = geometry.cell_centres(cfg.heightmap)
    q, _ = jax.vmap(maps.best_over_yaws, (None, 0, None))(frames, seen, places)
    candidates = jax.vmap(policy.candidates, (0, None, 0))(keys, learner, seen)
    return Thought(q, candidates, jax.vmap(actor_critic.best_grasp)(seen))


def _rewards(
    learner: ActorCritic, params: Params, thought: Thought, action: Action, after: State
) -> jax.Array:
    """What training would have paid [E]; phi by the critic that acts, where training takes the
    target critic."""
    info, cfg = after.info, learner.cfg.reward
    phi = jax.vmap(actor_critic.best_grasp)(actor_critic.look(learner, params, after.obs))
    result = rewards.ActionResult(
        primitive=action.primitive,
        outcome=info.outcome,
        distance=info.distance,
        phi_before=thought.best_grasp,
        phi_after=phi,
        changed=info.moved > CHANGE_AREA,
        blocks_lost=info.blocks_lost,
    )
    return jax.vmap(rewards.reward, (None, 0))(cfg, result)


def _run(
    cfg: Config,
    program: _Program,
    params: Params | None,
    seed: int,
    numbers: np.ndarray,
    wanted: np.ndarray,
    scenes: Scene,
) -> Episodes:
    """The episodes `numbers` [E], which begin with `scenes` [E, ...]; those not `wanted` [E] bool
    end at once."""
    key = jax.random.key(seed)
    order = jnp.asarray(numbers)
    states = program.begin(jax.random.fold_in(key, 0), order, scenes)
    one = cfg.task.kind == "target"
    blocks = (
        np.ones(len(numbers), np.int32) if one else np.asarray(states.scene.in_play.sum(axis=1))
    )
    states = states.replace(truncated=jnp.asarray(~wanted))
    records = []
    for number in range(1, cfg.task.max_actions + 1):
        states, record = program.step(jax.random.fold_in(key, number), order, params, states)
        records.append(jax.device_get(record))
        if np.all(states.done):
            break
    pad = ((0, 0), (0, cfg.task.max_actions - len(records)))
    seen = {
        name: np.pad(np.stack([getattr(record, name) for record in records], axis=1), pad)
        for name in _Record._fields
    }
    lost = seen.pop("blocks_lost").sum(axis=1)
    terminated = np.asarray(states.terminated)
    return Episodes(
        blocks=blocks, completed=terminated, blocks_lost=lost, ending=_endings(cfg, states), **seen
    )


def _endings(cfg: Config, states: State) -> np.ndarray:
    """Why the episodes of these last states [E, ...] were over, numbers in ENDINGS."""
    last = jax.device_get(states)
    capped = np.where(
        last.actions >= cfg.task.max_actions,
        ENDINGS.index("action_cap"),
        ENDINGS.index("no_change_cap"),
    )
    ending = np.where(last.info.physics_diverged, ENDINGS.index("physics_diverged"), capped)
    return np.where(last.terminated, ENDINGS.index("terminated"), ending).astype(np.int32)


class _Record(NamedTuple):
    """What one action did in every scene, each [E], 0 where the episode was over; see
    `Episodes`."""

    valid: jax.Array
    primitive: jax.Array
    outcome: jax.Array
    cleared: jax.Array
    changed: jax.Array
    wrong: jax.Array
    blocks_lost: jax.Array


def _begin(env: Env, keys: jax.Array, scenes: Scene) -> State:
    scenes = jax.tree.map(jnp.asarray, scenes)
    return jax.vmap(env.reset_to)(jax.vmap(env.randomise_pose)(keys, scenes), keys)


def _step(
    env: Env, act: Policy, keys: jax.Array, params: Params, states: State
) -> tuple[State, _Record]:
    """One action in every scene; finished ones stay."""
    going = ~states.done
    action = act(keys, params, states)
    after = jax.vmap(env.step)(states, action)
    info, one = after.info, env.cfg.task.kind == "target"
    lost = (after.terminated & (after.reward == 0.0)).astype(jnp.int32)
    record = _Record(
        valid=going,
        primitive=action.primitive,
        outcome=info.outcome,
        cleared=after.reward.astype(jnp.int32) if one else info.cleared,
        changed=info.moved > CHANGE_AREA,
        wrong=(info.cleared > 0) & (after.reward == 0.0) if one else jnp.zeros_like(going),
        blocks_lost=lost if one else info.blocks_lost,
    )
    record = jax.tree.map(lambda leaf: jnp.where(going, leaf, jnp.zeros_like(leaf)), record)
    keep = jax.vmap(jnp.where)
    return jax.tree.map(lambda new, old: keep(going, new, old), after, states), record


def _policy(cfg: Config, env: Env, name: str) -> Policy:
    """The policy of that name. Raises ValueError for an unknown one."""
    learner = actor_critic.make(cfg)
    frames = learner.frames

    def learned(keys: jax.Array, params: Params, states: State) -> Action:
        dense_maps = actor_critic.look(learner, params, states.obs)
        act = jax.vmap(policy.best_action, (0, None, 0, 0))
        return act(keys, learner, dense_maps, states.steps_without_change)

    def random(keys: jax.Array, params: Params, states: State) -> Action:
        valid = jax.vmap(maps.actionable_cells, (None, 0))(frames, states.obs)
        return jax.vmap(policy.random_grasp, (0, None, 0))(keys, frames, valid)

    def planned(keys: jax.Array, params: Params, states: State) -> Action:
        plan = jax.vmap(oracle.grasp, (None, None, None, 0, 0))
        return plan(cfg.sim, cfg.heightmap, cfg.scene.slots, states.scene, states.obs.height)

    policies = {"learned": learned, "random": random, "oracle": planned}
    if name not in policies:
        raise ValueError(f"policy '{name}' is not one of: {', '.join(POLICIES)}")
    return policies[name]


def _keys(key: jax.Array, numbers: jax.Array) -> jax.Array:
    """A key for each episode of these numbers [E]."""
    return jax.vmap(jax.random.fold_in, (None, 0))(key, numbers)
