"""The algorithm: one training step of all scenes, CSAC Algorithm 1, compiled as a chunk of many.

Look, act, simulate, remember, learn, replace finished scenes. E = scenes, B = batch, P =
primitives.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax import env as environment
from csac_jax.agent import augment, learner as learning, policy, rewards
from csac_jax.agent.learner import Learner, LearnerState, Params, Transition
from csac_jax.config import Config
from csac_jax.constants import CHANGE_AREA, Primitive
from csac_jax.env import Env
from csac_jax.replay import ring, samplers
from csac_jax.replay.ring import ReplayState
from csac_jax.runtime import compiler
from csac_jax.scene import layout
from csac_jax.sim.primitives import Action
from csac_jax.training import chunked_vmap
from csac_jax.training.sharding import UNSHARDED, DataSharding
from csac_jax.vision import heightmap
from csac_jax.vision.heightmap import Observation


@struct.dataclass
class TrainState:
    """Everything that a run carries from step to step: a checkpoint is this and the config."""

    key: jax.Array  # [] typed key, root of all randomness, never consumed
    step: jax.Array  # [] int32, training steps done
    scenes: environment.State  # leaves [E, ...]
    learner: LearnerState
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
    learned: jax.Array  # [] bool, False during the warm-up
    critic_loss: jax.Array  # [] float32
    actor_loss: jax.Array  # [] float32
    td_error: jax.Array  # [] float32, mean of abs(y - Q)
    q_mean: jax.Array  # [] float32


@dataclasses.dataclass(frozen=True, eq=False)
class Program:
    """The static parts of a run, closed over by what is compiled."""

    cfg: Config
    env: Env
    learner: Learner
    sharding: DataSharding = UNSHARDED  # of scenes and batches over devices
    networks_at_once: int | None = None  # of runs side by side, see `chunked_vmap`; None for all


class Hyperparams(NamedTuple):
    """Settings that enter the program as arguments, in place of constants of its config."""

    values: dict[str, Any]  # value [...] of each setting by its dotted name, such as `learn.tau`
    return_bounds: tuple[Any, Any]  # smallest and largest possible return, []


def make(cfg: Config) -> Program:
    """Environment and learner of a config."""
    return Program(cfg, environment.make(cfg), learning.make(cfg))


def replace_hyperparams(program: Program, hyperparams: Hyperparams | None) -> Program:
    """The program with these hyper-parameters, if there are any, in place of its own."""
    if hyperparams is None:
        return program
    cfg = replace_settings(program.cfg, hyperparams.values)
    learner = learning.replace_hyperparams(program.learner, cfg, hyperparams.return_bounds)
    return dataclasses.replace(program, cfg=cfg, learner=learner)


def replace_settings(cfg: Config, values: dict[str, Any]) -> Config:
    """The config with other values of settings, by dotted name. Traced ones are not checked."""
    sections: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        section, field = name.split(".")
        sections.setdefault(section, {})[field] = value
    changed: dict[str, Any] = {
        name: dataclasses.replace(getattr(cfg, name), **fields) for name, fields in sections.items()
    }
    return dataclasses.replace(cfg, **changed)


def train_step(
    program: Program, state: TrainState, hyperparams: Hyperparams | None = None
) -> tuple[TrainState, StepMetrics]:
    """One action in each of the E scenes and the updates that belong to it."""
    program = replace_hyperparams(program, hyperparams)
    cfg, env, learner = program.cfg, program.env, program.learner
    key_act, key_learn, key_reset = jax.random.split(jax.random.fold_in(state.key, state.step), 3)
    scenes = state.scenes

    # Look and act: by default CEM on the critic's maps from the actor's mean, plus noise (lines
    # 8-13).
    look = _apart(program, lambda online, obs: learning.look(learner, online, obs))
    maps = look(state.learner.online, scenes.obs)
    act = jax.vmap(policy.act, (0, None, None, 0, None, 0, None))
    taken = state.step * cfg.train.scenes
    span = learner.bounds[1] - learner.bounds[0]
    action = act(
        _keys(key_act, cfg.train.scenes),
        cfg,
        learner.frames,
        maps,
        span,
        scenes.steps_without_change,
        taken,
    )

    # Simulate.
    after = program.sharding.map_scenes(jax.vmap(env.step))(scenes, action)

    # Reward and remember (lines 14-15).
    pushed = action.primitive == Primitive.PUSH
    around = _apart(program, lambda *given: _around(learner, *given), one_by_one=True)
    phi_before, phi_after = around(state.learner.target, scenes.obs, after.obs, pushed)
    info = after.info
    changed = info.moved > CHANGE_AREA
    reward = jax.vmap(rewards.reward, (None, 0, 0, 0, 0, 0, 0, 0))(
        cfg.reward,
        action.primitive,
        info.outcome,
        info.distance,
        phi_before,
        phi_after,
        changed,
        info.blocks_lost,
    )
    seen = Transition(
        obs=heightmap.pack(scenes.obs),
        action=action,
        reward=reward,
        next_obs=heightmap.pack(after.obs),
        terminated=after.terminated,
    )
    replay = ring.add(state.replay, seen, ~info.physics_diverged)

    # Learn (lines 16-26). During the warm-up the result is dropped: a branch would cost more than
    # those few updates.
    ready = taken + cfg.train.scenes >= cfg.train.learning_starts
    learned, priority, losses = _learn(program, key_learn, state.learner, replay)
    learned = jax.tree.map(lambda new, old: jnp.where(ready, new, old), learned, state.learner)
    priority = jnp.where(ready, priority, replay.priority)

    # Replace finished scenes.
    fresh = jax.vmap(env.restart)(_keys(key_reset, cfg.train.scenes), after)
    scenes = jax.tree.map(lambda new, old: jax.vmap(jnp.where)(after.done, new, old), fresh, after)

    metrics = StepMetrics(
        primitive=action.primitive,
        outcome=info.outcome,
        push_better=pushed & (phi_after > phi_before + cfg.reward.dead_band),
        cleared=info.cleared,
        blocks_lost=info.blocks_lost,
        terminated=after.terminated,
        truncated=after.truncated,
        reward=reward,
        gap_disagrees=~pushed & (info.outcome != info.outcome_by_gap),
        contact_overflow=info.contact_overflow,
        physics_diverged=info.physics_diverged,
        learned=ready,
        **losses,
    )
    state = TrainState(
        state.key, state.step + 1, scenes, learned, replay.replace(priority=priority)
    )
    return state, metrics


def _apart(
    program: Program, part: Callable[..., Any], one_by_one: bool = False
) -> Callable[..., Any]:
    """`part`, what the networks of one run do; of several side by side only so many at a time as
    the program says."""
    if program.networks_at_once is None:
        return part
    return chunked_vmap.vmap_in_chunks(part, 1 if one_by_one else program.networks_at_once)


def _learn(
    program: Program, key: jax.Array, state: LearnerState, replay: ReplayState
) -> tuple[LearnerState, jax.Array, dict[str, jax.Array]]:
    """The critic's updates, each on a batch drawn anew, then one of the actor on the last batch, or
    a part of it."""
    cfg, learner = program.cfg, program.learner
    total = max(cfg.train.steps * cfg.learn.updates, 1)
    update_critic = _apart(
        program, lambda key, *given: learning.update_critic(key, learner, *given)
    )
    update_actor = _apart(program, lambda *given: learning.update_actor(learner, *given))

    def update(carry, i):
        state, priority = carry
        *keys_draw, key_target = jax.random.split(jax.random.fold_in(key, i), 3)
        progress = state.updates.astype(jnp.float32) / total
        current = replay.replace(priority=priority)
        slots, weights, batch = _draw(program, keys_draw, current, progress)
        state, info = update_critic(key_target, state, batch, weights)
        current = ring.set_priorities(current, slots, samplers.priority(cfg.replay, info.error))
        return (state, current.priority), (info, batch.obs)

    numbers = jnp.arange(cfg.learn.updates)
    (state, priority), (info, observations) = jax.lax.scan(
        update, (state, replay.priority), numbers
    )
    last = heightmap.unpack(
        jax.tree.map(lambda leaf: leaf[-1, : cfg.learn.actor_batch or None], observations)
    )
    state, actor_loss = update_actor(state, last)
    losses = {
        "critic_loss": jnp.mean(info.critic_loss),
        "actor_loss": actor_loss,
        "td_error": jnp.mean(jnp.abs(info.error)),
        "q_mean": jnp.mean(info.q),
    }
    return state, priority, losses


def _draw(
    program: Program, keys: Sequence[jax.Array], replay: ReplayState, progress: jax.Array
) -> tuple[jax.Array, jax.Array, Transition]:
    """A batch as the sampler has it, augmented: slots [B], weights [B], leaves [B, ...]; two
    keys."""
    cfg, (key_sample, key_augment) = program.cfg, keys
    slots, weights = samplers.sample(key_sample, cfg.replay, replay, progress, cfg.learn.batch)
    batch = program.sharding.shard_batch(ring.gather(replay, slots))
    vary = jax.vmap(augment.vary, (0, None, 0))
    return slots, weights, vary(_keys(key_augment, cfg.learn.batch), cfg, batch)


def _best_grasps(learner: Learner, target: Params, obs: Observation) -> jax.Array:
    """phi_g of E states [E] by the target critic, eq. 16."""
    return jax.vmap(learning.best_grasp)(learning.look(learner, target, obs))


def _around(
    learner: Learner, target: Params, before: Observation, after: Observation, pushed: jax.Array
) -> jax.Array:
    """phi_g before and after the action [2, E]; zeros if no scene was `pushed` [E] bool, since
    grasps need none.

    With seeds side by side the branch turns into a selection, both sides run; one by one it stays a
    branch.
    """
    views = jax.tree.map(lambda *leaves: jnp.stack(leaves), before, after)

    def look() -> jax.Array:
        return jax.lax.map(lambda obs: _best_grasps(learner, target, obs), views)

    return jax.lax.cond(jnp.any(pushed), look, lambda: jnp.zeros((2, *pushed.shape)))


def _keys(key: jax.Array, num: int) -> jax.Array:
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(num))


def init(program: Program, trunk: Any = None) -> TrainState:
    """The state before the first step: fresh scenes and networks, an empty ring (lines 1-4). A
    fixed point of types.

    trunk: variables that the networks' trunks begin with, see `weights.read`; None for random ones.
    """
    state = jax.jit(lambda: init_state(program, jax.random.key(program.cfg.seed)))()
    return (
        state if trunk is None else state.replace(learner=learning.with_trunk(state.learner, trunk))
    )


def init_state(
    program: Program, key: jax.Array, hyperparams: Hyperparams | None = None
) -> TrainState:
    """The state before the first step of the run whose root key is `key`; pure."""
    program = replace_hyperparams(program, hyperparams)
    cfg = program.cfg
    key_scenes, key_nets = jax.random.split(jax.random.fold_in(key, np.uint32(2**32 - 1)))
    return TrainState(
        key=key,
        step=jnp.int32(0),
        scenes=jax.vmap(program.env.reset)(_keys(key_scenes, cfg.train.scenes)),
        learner=learning.init(key_nets, program.learner),
        replay=ring.init(cfg.replay, example(cfg)),
    )


def example(cfg: Config) -> Transition:
    """Shapes and types of a stored transition; no arrays."""

    def build() -> Transition:
        rows = (cfg.heightmap.size, cfg.heightmap.size)
        seen = Observation(
            colour=jnp.zeros((*rows, 3)), height=jnp.zeros(rows), target=jnp.zeros(rows, bool)
        )
        action = Action(primitive=jnp.int32(0), pose=jnp.zeros(3))
        packed = heightmap.pack(seen)
        return Transition(packed, action, jnp.zeros(()), packed, jnp.zeros((), bool))

    return jax.eval_shape(build)


def abstract_state(cfg: Config) -> Any:
    """Shapes and types of a run's state, as `jax.eval_shape` gives them: no scene is settled,
    nothing is compiled."""
    nothing: Any = None
    blank = jax.tree.map(lambda leaf: np.asarray(leaf)[None], layout.parked(cfg.scene.slots))
    program = Program(cfg, Env(cfg, nothing, blank), learning.make(cfg))
    return jax.eval_shape(lambda: init(program))


def compile_chunk(program: Program, num_steps: int):
    """A compiled function state -> (state, StepMetrics [T, ...]) of `num_steps` training steps.

    The state is donated: what goes in is used up, and the replay is updated in place.
    """

    def chunk(state: TrainState) -> tuple[TrainState, StepMetrics]:
        return jax.lax.scan(lambda carry, _: train_step(program, carry), state, length=num_steps)

    return jax.jit(chunk, donate_argnums=0, compiler_options=compiler.options(program.cfg))
