"""Episodes of a fixed policy, many at once in one compiled step, and what they measure."""

import functools
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.agent import rewards
from csac_jax.config import Config, PhysicsKind, RobotKind
from csac_jax.constants import CHANGE_AREA
from csac_jax.env import Env, State
from csac_jax.evaluation import metrics, policies, suites
from csac_jax.evaluation.metrics import ENDINGS, Episodes
from csac_jax.evaluation.policies import NetworkPolicy, Policy, PolicyDebug
from csac_jax.objects.library import Split
from csac_jax.robot import primitives
from csac_jax.runtime import compiler
from csac_jax.sim import physics as simulation
from csac_jax.training import transitions
from csac_jax.world import blocks, object_slots, scene_state

SIDE_BY_SIDE = 64  # most episodes that run at once
PER_CORE = 4  # of them on a CPU: more gain nothing, and the last episodes keep all places busy

OnProgress = Callable[[str, int, int], None]  # part of the suite, episodes finished, all episodes


def evaluate(
    policy: Policy,
    suite: str | suites.PreparedSuite = suites.IN_DISTRIBUTION,
    episodes: int = 50,
    seed: int = 0,
    physics: PhysicsKind = "auto",
    robot: RobotKind = "hand",
    on_progress: OnProgress | None = None,
    objects: str | None = None,
    split: Split = "held_out",
) -> dict[str, Any]:
    """Measures a policy in scenes that training never saw; the metrics are `metrics`'.

    Args: suite, a name of `suites.SUITES`, a case file, or a suite prepared by `suites.prepare`,
    which has the other arguments; on_progress, called after every action. Returns: the metrics; of
    a suite with several parts {"parts": {name: metrics}}. Raises SettingsError as `suites.prepare`.
    """
    if not isinstance(suite, suites.PreparedSuite):
        learned = policies.is_learned(policy)
        cfg = suites.standard(policy.cfg, suite)
        suite = suites.prepare(cfg, suite, episodes, seed, physics, robot, objects, split, learned)
    tables = {}
    for name, env in suite.parts.items():
        policies.warn_if_elsewhere(policy, env.cfg)
        actor = policies.in_world(policy, env.cfg)
        count = functools.partial(on_progress, name) if on_progress else None
        ended = rollout(env, actor, suite.episodes, suite.seed, count)
        tables[name] = metrics.summarise(ended)
        if env.cfg.scene.has_objects:
            tables[name]["objects"] = _by_object(env, ended)
            tables[name]["scenes_sha256"] = object_slots.fingerprint(env.cfg.scene, env.scenes)
    return next(iter(tables.values())) if len(tables) == 1 else {"parts": tables}


def _by_object(env: Env, episodes: Episodes) -> dict[str, Any]:
    """Counts by object, see `metrics.by_object`; blocks among the objects are of one name."""
    rows = _rows(env, len(episodes.completed))
    library = np.array([one.name for one in object_slots.library(env.cfg.scene).objects])
    names = library[np.asarray(env.scenes.numbers)[rows]]
    names = np.where(blocks.is_object(env.cfg.scene.slots), names, "block")
    return metrics.by_object(names, np.asarray(env.scenes.in_play)[rows], episodes.left)


def _rows(env: Env, episodes: int) -> np.ndarray:
    """Returns each episode's scene, spread evenly over the pool."""
    return np.arange(episodes) * env.scenes.position.shape[0] // episodes


def rollout(
    env: Env,
    policy: Policy,
    episodes: int,
    seed: int,
    on_progress: Callable[[int, int], None] | None = None,
) -> Episodes:
    """Runs episodes of a policy, their scenes spread evenly over the environment's pool. Some run
    side by side; where one ends, the next begins. An episode's draws follow from the seed and its
    number alone. `on_progress` gets the episodes finished and all."""
    most = min(SIDE_BY_SIDE, episodes)
    if jax.default_backend() == "cpu":
        most = min(most, PER_CORE * len(os.sched_getaffinity(0)))
    few = max(1, most // 8)  # that begin at once, ours
    places = most // few * few
    static: Any = (type(env), env.cfg, env.physics, env.any_yaw, env.max_failures)
    begin, step = _compiled(*static)
    key = jax.random.key(seed)
    rows = _rows(env, episodes)
    started = np.asarray(env.scenes.in_play)[rows]
    number, left = started.sum(axis=1), np.zeros_like(started)

    def begun(numbers: np.ndarray) -> State:
        scenes = jax.tree.map(lambda leaf: leaf[rows[numbers]], env.scenes)
        return begin(jax.random.fold_in(key, 0), numbers, scenes)

    numbers, actions = np.full(places, _NONE), np.zeros(places, int)
    states = jax.tree.map(lambda leaf: leaf[np.zeros(places, int)], begun(np.zeros(few, int)))
    completed, ending = np.zeros(episodes, bool), np.zeros(episodes, np.int32)
    tables, shape, waiting = None, (episodes, env.cfg.task.max_actions), np.arange(episodes)
    while np.any(numbers != _NONE) or waiting.size:
        free = np.flatnonzero(numbers == _NONE)[: waiting.size]
        for some in np.split(free, np.arange(few, free.size, few)):
            if some.size == few or some.size == waiting.size > 0:
                chosen, waiting = waiting[: some.size], waiting[some.size :]
                numbers[some], actions[some] = chosen, 0
                here = np.pad(some, (0, few - some.size), constant_values=places)
                states = _put(states, here, begun(np.resize(chosen, few)))
        states, record = step(type(policy), _pytree(policy), key, np.maximum(numbers, 0), states)
        at_end = states.done, states.terminated, states.scene.in_play
        record, (done, terminated, in_play) = jax.device_get((record, at_end))
        busy = numbers != _NONE
        over = numbers[busy & done]
        completed[over], ending[over] = terminated[busy & done], endings(env, states)[busy & done]
        left[over] = in_play[busy & done]
        tables = tables or jax.tree.map(lambda leaf: np.zeros(shape, leaf.dtype), record)
        for table, leaf in zip(jax.tree.leaves(tables), jax.tree.leaves(record), strict=True):
            table[numbers[busy], actions[busy]] = leaf[busy]
        numbers, actions = np.where(busy & done, _NONE, numbers), actions + 1
        if on_progress is not None:
            on_progress(episodes - waiting.size - int(np.sum(numbers != _NONE)), episodes)
    assert tables is not None
    lost = tables.blocks_lost.sum(axis=1)
    number = np.ones_like(number) if env.cfg.task.kind == "target" else number
    at_ends = {"completed": completed, "ending": ending, "left": left}
    return tables._replace(blocks_lost=lost, blocks=number, **at_ends)


_NONE = -1  # number of the episode in a place that is free


@jax.jit
def _put(states: State, places: jax.Array, some: State) -> State:
    """Replaces the states in these places; places beyond the last are dropped."""
    return jax.tree.map(lambda leaf, new: leaf.at[places].set(new, mode="drop"), states, some)


@functools.lru_cache(maxsize=2)
def _compiled(
    kind: Any, cfg: Config, physics: Any, any_yaw: bool, max_failures: int
) -> tuple[Callable, Callable]:
    """Compiles `_begin` and `_step` once for all environments of one config and physics."""
    env = kind(cfg, physics, None, any_yaw, max_failures)  # without scenes, as it never resets
    jit = functools.partial(jax.jit, compiler_options=compiler.options(cfg))
    return jit(functools.partial(_begin, env)), jit(functools.partial(_step, env), static_argnums=0)


class StepRecord(NamedTuple):
    """One action of an episode; NumPy leaves of one scene."""

    before: State
    action: primitives.Action
    joints: primitives.JointTrajectory
    after: State
    reward: jax.Array  # [] R of CSAC eq. 12 for a learned policy; else `after.reward`
    debug: PolicyDebug | None  # of a learned policy


def episode(env: Env, policy: Policy, seed: int) -> Iterator[StepRecord]:
    """Runs one episode in the first scene of the environment's pool, and yields every action."""
    key, first = jax.random.key(seed), jax.tree.map(lambda leaf: leaf[:1], env.scenes)
    jit = functools.partial(jax.jit, compiler_options=compiler.options(env.cfg, brief=True))
    begin, step = (jit(functools.partial(part, env)) for part in (_begin, _recorded_step))
    states = begin(jax.random.fold_in(key, 0), jnp.zeros(1, jnp.int32), first)
    state = jax.tree.map(lambda leaf: leaf[0], states)
    for action in range(1, env.cfg.task.max_actions + 1):
        step_key = jax.random.fold_in(jax.random.fold_in(key, action), 0)
        record = step(_pytree(policy), step_key, state)
        yield jax.device_get(record)
        state = record.after
        if bool(state.done):
            return


def _recorded_step(env: Env, policy: Policy, key: jax.Array, state: State) -> StepRecord:
    action = policy(state, key)
    fingers = state.scene.fingers
    plan = primitives.plan(env.cfg.sim, env.cfg.heightmap, state.obs.height, action, fingers)
    joints = primitives.joint_trajectory(env.cfg.sim, plan)
    after = env.step(state, action)
    if not isinstance(policy, NetworkPolicy):
        return StepRecord(state, action, joints, after, after.reward, None)
    key = jax.random.clone(key)  # the debug view is of the same draws
    debug, later = policy.debug(state, key), policy.debug(after, jax.random.clone(key))
    paid = transitions.with_reward_outcome(policy.cfg.reward, after)
    result = transitions.to_action_result(action, paid.info)
    # By the critic that acts:
    result = result._replace(phi_before=debug.best_grasp, phi_after=later.best_grasp)
    reward = rewards.reward(policy.cfg.reward, result)
    return StepRecord(state, action, joints, after, reward, debug)


def _pytree(policy: Policy) -> Any:
    """Wraps a policy that is no pytree as an argument of compiled programs."""
    return jax.tree_util.Partial(policy) if jax.tree_util.all_leaves([policy]) else policy


def endings(env: Env, last: State) -> np.ndarray:
    """Returns why episodes ended, by their last states [...]: indices into ENDINGS [...]."""
    reasons = {
        "terminated": last.terminated,
        "physics_diverged": last.info.physics_diverged,
        "failed_grasps": env.gives_up(last.scene, last.failed_grasps),
        "action_cap": last.actions >= env.cfg.task.max_actions,
    }
    numbers = map(ENDINGS.index, (*reasons, "no_change_cap"))
    *chosen, default = map(np.int32, numbers)
    return np.select(jax.device_get([*reasons.values()]), chosen, default)


def _begin(env: Env, key: jax.Array, numbers: jax.Array, scenes: scene_state.SceneState) -> State:
    """Builds the first states of the episodes `numbers` [E] in `scenes` [E, ...]."""
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, numbers)
    placed = jax.vmap(env.randomise_pose)(keys, jax.tree.map(jnp.asarray, scenes))
    return jax.vmap(env.reset_to)(placed, keys)


def _step(
    env: Env, kind: type, policy: Policy, key: jax.Array, numbers: jax.Array, states: State
) -> tuple[State, Episodes]:
    """Takes one action in every scene; records [E] are 0 after the end. Finished scenes stay.
    `kind`, the policy's type, is static: JAX takes dataclasses of equal fields for equal whatever
    their types are, and would at times run the program of the one for the other."""
    del kind
    running = ~states.done
    keys = jax.vmap(functools.partial(jax.random.fold_in, key))(states.actions + 1)
    act = policy.batched if isinstance(policy, NetworkPolicy) else jax.vmap(policy)
    action = act(states, jax.vmap(jax.random.fold_in)(keys, numbers))
    cleared = jax.vmap(scene_state.park)(states.scene, running[:, None] & states.scene.in_play)
    after = jax.vmap(env.step)(states.replace(scene=cleared), action)
    info, has_target, unpaid = after.info, env.cfg.task.kind == "target", after.reward == 0.0
    target_lost = (after.terminated & unpaid).astype(jnp.int32)
    reachable = jax.vmap(functools.partial(simulation.reachable, env.cfg))
    record = Episodes(
        valid=running,
        primitive=action.primitive,
        outcome=info.outcome,
        cleared=after.reward.astype(jnp.int32) if has_target else info.cleared,
        changed=info.moved > CHANGE_AREA,
        wrong=(info.cleared > 0) & unpaid & has_target,
        blocks_lost=target_lost if has_target else info.blocks_lost,
        unreachable=~reachable(states.obs.height, action),
    )
    record = jax.tree.map(lambda leaf: jnp.where(running, leaf, jnp.zeros_like(leaf)), record)
    return transitions.where(running, after, states), record
