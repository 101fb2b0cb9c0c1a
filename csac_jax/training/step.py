"""The algorithm: one training step of all scenes, CSAC Algorithm 1, compiled as a chunk of many.

Observe, act, simulate, replace finished scenes, remember, learn. E = scenes, B = batch.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh

from csac_jax import env as environment
from csac_jax.agent import actor_critic, augment
from csac_jax.agent.csac import CSAC
from csac_jax.agent.learner import Learner, Transition
from csac_jax.agent.rewards import ActionResult
from csac_jax.config import Config, RewardConfig
from csac_jax.constants import CHANGE_AREA, Outcome, Primitive
from csac_jax.env import Env
from csac_jax.replay import ring, samplers
from csac_jax.replay.ring import ReplayState
from csac_jax.replay.samplers import Sampler
from csac_jax.runtime import compiler
from csac_jax.scene import layout
from csac_jax.sim import physics as simulation
from csac_jax.sim.primitives import Action
from csac_jax.training import sharding
from csac_jax.vision import heightmap
from csac_jax.vision.heightmap import Observation


@struct.dataclass
class TrainState:
    """Everything that a run carries from step to step: a checkpoint is this and the config."""

    key: jax.Array  # [] typed key, root of all randomness, never consumed
    step: jax.Array  # [] int32, training steps done
    scenes: environment.State  # leaves [E, ...]
    learner: Any  # the learner's state
    replay: ReplayState


class StepMetrics(NamedTuple):
    """What one training step did; a chunk stacks them along a leading axis T."""

    primitive: jax.Array  # [E] int32, 0 push, 1 grasp
    outcome: jax.Array  # [E] int32, Outcome; only of grasps
    push_better: jax.Array  # [E] bool, the push made the best grasp worth more; False for grasps
    cleared: jax.Array  # [E] int32, blocks taken from the table
    blocks_lost: jax.Array  # [E] int32, blocks that left the workspace
    terminated: jax.Array  # [E] bool
    truncated: jax.Array  # [E] bool
    reward: jax.Array  # [E] float32
    gap_disagrees: jax.Array  # [E] bool, finger gap and ground truth name different outcomes
    contact_overflow: jax.Array  # [E] int32, substeps with every contact slot in use
    physics_diverged: jax.Array  # [E] bool, physics failed: transition dropped, scene replaced
    unreachable: jax.Array  # [E] bool, the robot cannot follow the action, so that nothing moved
    learned: jax.Array  # [] bool, False during the warm-up
    critic_loss: jax.Array  # [] float32
    actor_loss: jax.Array  # [] float32
    td_error: jax.Array  # [] float32, mean of abs(y - Q)
    q_mean: jax.Array  # [] float32
    finite: jax.Array  # [] bool, every number of the learner's state is finite


_LOSSES = ("critic_loss", "actor_loss", "td_error", "q_mean")  # of updates


class Hyperparams(NamedTuple):
    """Settings that enter the program as arguments, in place of constants of its config."""

    values: dict[str, Any]  # value [...] of each setting by its dotted name, such as `learn.tau`
    return_bounds: tuple[Any, Any]  # smallest and largest possible return, []


@dataclasses.dataclass(frozen=True, eq=False)
class Program:
    """The static parts of a run, closed over by what is compiled."""

    cfg: Config
    env: Env
    learner: Learner
    sampler: Sampler
    mesh: Mesh | None = None  # whose devices divide scenes and batches


def make(
    cfg: Config,
    env: Env | None = None,
    learner: Learner | None = None,
    sampler: Sampler | None = None,
    network: Any = None,
) -> Program:
    """The program of a config, with parts of your own in place of the config's."""
    env = environment.make_env(cfg) if env is None else env
    learner = CSAC(actor_critic.make(cfg, network)) if learner is None else learner
    sampler = samplers.make(cfg.replay, cfg.train.scenes) if sampler is None else sampler
    return Program(cfg, env, learner, sampler)


def replace_hyperparams(program: Program, hyperparams: Hyperparams | None) -> Program:
    """The program with these hyper-parameters, if there are any, in place of its config's."""
    if hyperparams is None:
        return program
    cfg = replace_settings(program.cfg, hyperparams.values)
    learner = program.learner.replace_hyperparams(cfg, hyperparams.return_bounds)
    sampler = program.sampler.replace_hyperparams(cfg.replay)
    return dataclasses.replace(program, cfg=cfg, learner=learner, sampler=sampler)


def replace_settings(cfg: Config, values: dict[str, Any]) -> Config:
    """The config with other values of settings, by dotted name; traced ones are not checked."""
    sections: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        section, field = name.split(".")
        sections.setdefault(section, {})[field] = value
    return cfg.change(**sections)


def train_step(
    program: Program, state: TrainState, hyperparams: Hyperparams | None = None
) -> tuple[TrainState, StepMetrics]:
    """One action in each of the E scenes and the updates that belong to it."""
    program = replace_hyperparams(program, hyperparams)
    return learn_step(program, *act_step(program, state))


def act_step(program: Program, state: TrainState) -> tuple[TrainState, StepMetrics]:
    """A step without its updates, lines 8-15; metrics as of one that learns nothing."""
    cfg, env, learner = program.cfg, program.env, program.learner
    key_act, _, key_reset = _step_keys(state.key, state.step)
    scenes = state.scenes

    # Observe and act (lines 8-13).
    taken = state.step * cfg.train.scenes
    action = learner.act(key_act, state.learner, scenes.obs, scenes.steps_without_change, taken)

    # Simulate.
    after = sharding.map_scenes(program.mesh, jax.vmap(env.step))(scenes, action)

    # Replace finished scenes.
    fresh = jax.vmap(env.auto_reset)(_keys(key_reset, cfg.train.scenes), after)
    scenes_next = _where(after.done, fresh, after)

    # Reward and remember (lines 14-15).
    info, paid = after.info, judged(cfg.reward, after)
    result = action_result(action, paid.info)
    reward, push_better = learner.reward(cfg.reward, state.learner, scenes.obs, after.obs, result)
    next_obs, terminated = BOOTSTRAPS[cfg.target.bootstrap](paid, scenes_next)
    before, seen = heightmap.pack(scenes.obs), heightmap.pack(next_obs)
    label = push_better if cfg.reward.renewed else None
    transition = Transition(before, action, reward, seen, terminated, label)
    replay = ring.add(state.replay, transition, ~info.physics_diverged)

    metrics = StepMetrics(
        primitive=action.primitive,
        outcome=info.outcome,
        push_better=push_better,
        cleared=info.cleared,
        blocks_lost=info.blocks_lost,
        terminated=after.terminated,
        truncated=after.truncated,
        reward=reward,
        gap_disagrees=(action.primitive == Primitive.GRASP) & (info.outcome != info.outcome_by_gap),
        contact_overflow=info.contact_overflow,
        physics_diverged=info.physics_diverged,
        unreachable=~jax.vmap(functools.partial(simulation.reachable, cfg))(
            scenes.obs.height, action
        ),
        learned=jnp.bool_(False),
        finite=jnp.bool_(True),
        **dict.fromkeys(_LOSSES, jnp.float32(0.0)),
    )
    return TrainState(state.key, state.step + 1, scenes_next, state.learner, replay), metrics


def learn_step(
    program: Program, state: TrainState, metrics: StepMetrics
) -> tuple[TrainState, StepMetrics]:
    """The updates of a step, lines 16-26, after `act_step`; metrics with theirs."""
    cfg, step = program.cfg, state.step - 1
    _, key_learn, _ = _step_keys(state.key, step)
    # Before `learning_starts` the result is dropped: a branch costs more.
    ready = state.step * cfg.train.scenes >= cfg.train.learning_starts
    done = _updates_done(cfg, step)
    learned, priority, losses = learn(program, key_learn, state.learner, state.replay, done)
    learned = jax.tree.map(lambda new, old: jnp.where(ready, new, old), learned, state.learner)
    priority = jnp.where(ready, priority, state.replay.priority)
    after = state.replace(learner=learned, replay=state.replay.replace(priority=priority))
    return after, metrics._replace(learned=ready, finite=_is_finite(learned), **losses)


def _step_keys(key: jax.Array, step: jax.Array) -> tuple[jax.Array, ...]:
    """Keys of a training step: to act, to learn and to reset."""
    return tuple(jax.random.split(jax.random.fold_in(key, step), 3))


def _episodic(after: environment.State, _: environment.State) -> tuple[Observation, jax.Array]:
    """Nothing follows the end of an episode."""
    return after.obs, after.terminated


def _continuing(
    after: environment.State, scenes_next: environment.State
) -> tuple[Observation, jax.Array]:
    """The last action of an episode is followed by the next scene, and one without any effect by
    nothing; Zeng et al., code: `get_label_value`.

    Deviation: an episode that is cut off goes on in its own scene.
    """
    effect = (after.info.moved > CHANGE_AREA) | (after.info.outcome == Outcome.LIFTED)
    return _where(after.terminated, scenes_next.obs, after.obs), ~effect


BOOTSTRAPS = {"episodic": _episodic, "continuing": _continuing}
"""States after actions and those acted in next, leaves [E, ...] -> what a transition is followed
by, leaves [E, ...], and whether V of it is 0, [E] bool."""


def _where(condition: jax.Array, yes: Any, no: Any) -> Any:
    """Scene by scene, leaves [E, ...], `yes` where the condition [E] holds, else `no`."""
    return jax.tree.map(lambda a, b: jax.vmap(jnp.where)(condition, a, b), yes, no)


def judged(cfg: RewardConfig, after: environment.State) -> environment.State:
    """States after actions, leaves [...], with the outcome that is paid for, by `reward.source`;
    logs and evaluations keep that of ground truth."""
    if cfg.source == "truth":
        return after
    return after.replace(info=after.info.replace(outcome=after.info.outcome_by_gap))


def action_result(action: Action, info: environment.Info) -> ActionResult:
    """What actions did, leaves [...]; phi, here 0, is the learner's to fill in."""
    unknown = jnp.zeros_like(info.distance)
    return ActionResult(
        primitive=action.primitive,
        outcome=info.outcome,
        distance=info.distance,
        phi_before=unknown,
        phi_after=unknown,
        changed=info.moved > CHANGE_AREA,
        blocks_lost=info.blocks_lost,
    )


def learn(
    program: Program, key: jax.Array, state: Any, replay: ReplayState, done: jax.Array
) -> tuple[Any, jax.Array, dict[str, jax.Array]]:
    """The updates after `done` [] others, each on a batch of its own, then the end of the step on
    (part of) the last."""
    cfg, learner = program.cfg, program.learner
    total = max(cfg.train.steps * cfg.learn.updates, 1)

    def update(carry, i):
        state, priority = carry
        *keys_draw, key_update = jax.random.split(jax.random.fold_in(key, i), 3)
        progress = (done + i).astype(jnp.float32) / total
        current = replay.replace(priority=priority)
        slots, weights, batch = _draw(program, keys_draw, current, progress)
        state, info = learner.update(key_update, state, batch, weights)
        current = program.sampler.update(current, slots, info.error)
        return (state, current.priority), (info, batch.obs)

    start, numbers = (state, replay.priority), jnp.arange(cfg.learn.updates)
    (state, priority), (info, observations) = jax.lax.scan(update, start, numbers)
    last = jax.tree.map(lambda leaf: leaf[-1, : cfg.learn.actor_batch or None], observations)
    state, actor_loss = learner.end_step(state, heightmap.unpack(last))
    losses = {
        "critic_loss": jnp.mean(info.critic_loss),
        "actor_loss": actor_loss,
        "td_error": jnp.mean(jnp.abs(info.error)),
        "q_mean": jnp.mean(info.q),
    }
    return state, priority, losses


def _is_finite(tree: Any) -> jax.Array:
    """Whether every floating number of a pytree is finite, [] bool."""
    floats = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.all(jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in floats], bool))


def _updates_done(cfg: Config, step: jax.Array) -> jax.Array:
    """Updates [] int32 before training step `step` [] that were not dropped."""
    return jnp.maximum(step - first_to_learn(cfg), 0) * cfg.learn.updates


def first_to_learn(cfg: Config) -> int:
    """The first training step whose updates are not dropped."""
    return -(-cfg.train.learning_starts // cfg.train.scenes) - 1


def _draw(program: Program, keys: Any, replay: ReplayState, progress: jax.Array) -> tuple[Any, ...]:
    """A batch as the sampler has it, augmented: slots [B], weights [B], leaves [B, ...]."""
    cfg, (key_sample, key_augment) = program.cfg, keys
    slots, weights = program.sampler.sample(key_sample, replay, progress, cfg.learn.batch)
    batch = sharding.shard_batch(program.mesh, ring.gather(replay, slots))
    augmented = jax.vmap(augment.augment, (0, None, 0))
    return slots, weights, augmented(_keys(key_augment, cfg.learn.batch), cfg, batch)


def _keys(key: jax.Array, num: int) -> jax.Array:
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(num))


def init(program: Program) -> TrainState:
    """The state before the first step; a fixed point of types."""
    return compile_init(program)()


def compile_init(program: Program) -> Callable[[], TrainState]:
    """What makes the first state, jitted: shapes and state are of one trace, and every seed of one
    program."""
    begin = jax.jit(functools.partial(init_state, program))

    def first() -> TrainState:
        key = jax.random.key(program.cfg.seed)
        if isinstance(key, jax.core.Tracer):  # for shapes alone; no options within a trace
            return begin(key)
        return begin.lower(key).compile(compiler.options(program.cfg))(key)

    return first


def prepare(program: Program) -> None:
    """Does ahead, maybe in another thread, what else delays the first step."""
    simulation.prepare(program.env.physics, program.cfg.train.scenes)


def init_state(
    program: Program, key: jax.Array, hyperparams: Hyperparams | None = None
) -> TrainState:
    """Fresh scenes and networks, an empty ring (lines 1-4), from the run's root key; pure."""
    program = replace_hyperparams(program, hyperparams)
    cfg = program.cfg
    key_scenes, key_nets = jax.random.split(jax.random.fold_in(key, np.uint32(2**32 - 1)))
    scenes = jax.vmap(program.env.reset)(_keys(key_scenes, cfg.train.scenes))
    learner = program.learner.init(key_nets)
    replay = ring.init(program.sampler.init(cfg.replay.capacity), example(cfg))
    return TrainState(key, jnp.int32(0), scenes, learner, replay)


def example(cfg: Config) -> Transition:
    """Shapes and types of a stored transition; no arrays."""

    def build() -> Transition:
        rows = (cfg.heightmap.size, cfg.heightmap.size)
        colour, target = jnp.zeros((*rows, 3)), jnp.zeros(rows, bool)
        fingers = jnp.zeros(3) if cfg.net.gripper else None
        obs = Observation(colour, jnp.zeros(rows), target, fingers)
        action = Action(primitive=jnp.int32(0), pose=jnp.zeros(3))
        packed = heightmap.pack(obs)
        label = jnp.zeros((), bool) if cfg.reward.renewed else None
        return Transition(packed, action, jnp.zeros(()), packed, jnp.zeros((), bool), label)

    return jax.eval_shape(build)


def abstract_state(cfg: Config, learner: Learner | None = None, network: Any = None) -> Any:
    """Shapes and types of a run's state: no scene is settled, nothing is compiled."""
    no_physics: Any = None
    blank = jax.tree.map(lambda leaf: np.asarray(leaf)[None], layout.parked(cfg.scene.slots))
    program = make(cfg, Env(cfg, no_physics, blank), learner, network=network)
    return jax.eval_shape(lambda: init(program))


def compile_chunk(program: Program, num_steps: int):
    """A jitted function state -> (state, StepMetrics [T, ...]) of T = `num_steps` training steps.
    The state is donated: what goes in is used up, and the replay is updated in place."""

    def chunk(state: TrainState) -> tuple[TrainState, StepMetrics]:
        return jax.lax.scan(lambda carry, _: train_step(program, carry), state, length=num_steps)

    return jax.jit(chunk, donate_argnums=0, compiler_options=compiler.options(program.cfg))
