"""The algorithm: one training step of all scenes, CSAC Algorithm 1. E = scenes, B = batch."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.sharding import Mesh

from csac_jax import env as environment
from csac_jax.agent import augment
from csac_jax.agent.csac import CSAC
from csac_jax.agent.learner import Learner, Transition
from csac_jax.config import Config
from csac_jax.replay import ring
from csac_jax.replay.ring import ReplayState
from csac_jax.replay.samplers import Sampler
from csac_jax.robot.primitives import Action
from csac_jax.training import sharding, transitions
from csac_jax.training.transitions import StepMetrics
from csac_jax.vision import heightmap


@struct.dataclass
class TrainState:
    """Everything that a run carries from step to step: a checkpoint is this and the config."""

    key: jax.Array  # [] typed key, root of all randomness, never consumed
    step: jax.Array  # [] int32, training steps done
    scenes: environment.State  # leaves [E, ...]
    learner: Any  # the learner's state
    replay: ReplayState


@dataclasses.dataclass(frozen=True, eq=False)
class Program:
    """The static parts of a run, closed over by what is compiled."""

    cfg: Config
    env: environment.Env
    learner: Learner
    sampler: Sampler
    mesh: Mesh | None = None  # whose devices divide scenes and batches


def train_step(program: Program, state: TrainState) -> tuple[TrainState, StepMetrics]:
    """Takes one action in each of the E scenes and makes the updates that belong to it. On a CPU
    each half is a program of its own, see `split_step`; elsewhere both are one."""
    if program.cfg.train.overlap:
        return _overlapped(program, state)
    acted, metrics = act_half(program, state)
    # ---- acting ends, learning begins
    return learn_half(program, acted, metrics)


def act_half(program: Program, state: TrainState) -> tuple[TrainState, StepMetrics]:
    """Takes the actions of a step and stores them, lines 8-15; metrics without losses."""
    action = _choose(program, state)
    after = sharding.map_scenes(program.mesh, jax.vmap(program.env.step))(state.scenes, action)
    return _remember(program, state, action, after)


def learn_half(
    program: Program, state: TrainState, metrics: StepMetrics
) -> tuple[TrainState, StepMetrics]:
    """Learns from the replay, lines 16-26, and adds the losses to the metrics of `act_half`."""
    cfg, step = program.cfg, state.step - 1
    _, key_learn, _ = _step_keys(state.key, step)
    ready = state.step * cfg.train.scenes >= cfg.train.learning_starts
    after, learned = _updated(program, key_learn, state, ready, updates_done(cfg, step))
    return after, metrics._replace(**learned)


def _overlapped(program: Program, state: TrainState) -> tuple[TrainState, StepMetrics]:
    """Makes the updates while physics runs: they know the transitions before this action, which
    the networks before them chose."""
    cfg, env, step = program.cfg, program.env, state.step
    action = _choose(program, state)
    each = functools.partial(sharding.map_scenes, program.mesh)
    started = each(jax.vmap(env.start))(state.scenes, action)

    _, key_learn, _ = _step_keys(state.key, step)
    ready = step * cfg.train.scenes >= cfg.train.learning_starts
    key_learn = jax.random.fold_in(key_learn, _zero_after(started.running))
    learned, losses = _updated(program, key_learn, state, ready, updates_done(cfg, step - 1))

    done = jnp.broadcast_to(losses["critic_loss"] + losses["actor_loss"], (cfg.train.scenes,))
    after = each(jax.vmap(env.finish))(state.scenes, started, done)
    acted, metrics = _remember(program, learned, action, after)
    return acted, metrics._replace(**losses)


def _zero_after(tree: Any) -> jax.Array:
    """Returns [] uint32, zero, that needs an array of `tree`."""
    some = jax.tree.leaves(tree)[0].ravel()[0]
    return jnp.where(some == some, 0, 1).astype(jnp.uint32)


def _choose(program: Program, state: TrainState) -> Action:
    """Chooses an action in each scene, lines 8-13."""
    key_act, _, _ = _step_keys(state.key, state.step)
    taken, scenes = state.step * program.cfg.train.scenes, state.scenes
    idle = scenes.steps_without_change
    return program.learner.act(key_act, state.learner, scenes.obs, idle, taken)


def _remember(
    program: Program, state: TrainState, action: Action, after: environment.State
) -> tuple[TrainState, StepMetrics]:
    """Replaces finished scenes; rewards and stores what happened, lines 14-15."""
    cfg, env, scenes, learner = program.cfg, program.env, state.scenes, program.learner
    _, _, key_reset = _step_keys(state.key, state.step)
    fresh = jax.vmap(env.auto_reset)(numbered_keys(key_reset, cfg.train.scenes), after)
    scenes_next = transitions.where(after.done, fresh, after)
    transition, push_better = transitions.remember(
        cfg, learner, state.learner, scenes, action, after, scenes_next
    )
    replay = ring.add(state.replay, transition, ~after.info.physics_diverged)
    metrics = transitions.action_metrics(cfg, scenes, transition, push_better, after)
    return TrainState(state.key, state.step + 1, scenes_next, state.learner, replay), metrics


def _updated(
    program: Program, key: jax.Array, state: TrainState, ready: jax.Array, done: jax.Array
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Makes the updates of a step, after `done` [] of the run, if it is `ready` []; returns also
    what metrics say of them."""
    # Before `learning_starts` the result is dropped: a branch costs more.
    learned, priority, losses = learn(program, key, state.learner, state.replay, done)
    learned = jax.tree.map(lambda new, old: jnp.where(ready, new, old), learned, state.learner)
    priority = jnp.where(ready, priority, state.replay.priority)
    after = state.replace(learner=learned, replay=state.replay.replace(priority=priority))
    return after, {"learned": ready, "finite": _is_finite(learned), **losses}


def learn(
    program: Program, key: jax.Array, state: Any, replay: ReplayState, done: jax.Array
) -> tuple[Any, jax.Array, dict[str, jax.Array]]:
    """Makes a step's updates, each on a batch of its own, after `done` [] updates of the run.

    Returns: the learner's state, the priorities of the replay [C], the losses by name.
    """
    cfg, learner = program.cfg, program.learner
    total = max(cfg.train.steps * cfg.learn.updates_per_step, 1)

    def update(carry: tuple[Any, jax.Array], i: jax.Array) -> Any:
        state, priority = carry
        *keys_draw, key_update = jax.random.split(jax.random.fold_in(key, i), 3)
        progress = (done + i).astype(jnp.float32) / total
        current = replay.replace(priority=priority)

        # Draw a batch, then update critic and targets (lines 15-21, 24-26).
        slots, weights, batch = draw(program, keys_draw, current, progress)
        state, info = learner.update(key_update, state, batch, weights)
        current = program.sampler.update(current, slots, info.error)
        return (state, current.priority), (info, batch.obs)

    start, numbers = (state, replay.priority), jnp.arange(cfg.learn.updates_per_step)
    (state, priority), (info, observations) = jax.lax.scan(update, start, numbers)

    # Update the actor once, on (part of) the last batch (lines 22-23).
    actor_loss = jnp.zeros(())
    if isinstance(learner, CSAC):
        last = jax.tree.map(lambda leaf: leaf[-1, : cfg.learn.actor_batch or None], observations)
        state, actor_loss = learner.update_actor(state, heightmap.unpack(last))
    losses = {
        "critic_loss": jnp.mean(info.critic_loss),
        "actor_loss": actor_loss,
        "td_error": jnp.mean(jnp.abs(info.error)),
        "q_mean": jnp.mean(info.q),
    }
    return state, priority, losses


def draw(
    program: Program, keys: list[jax.Array], replay: ReplayState, progress: jax.Array
) -> tuple[jax.Array, jax.Array, Transition]:
    """Draws a batch by the sampler and augments it: slots [B], weights [B], leaves [B, ...].

    Args: keys, to sample and to augment; progress [], share of all updates that are done.
    """
    cfg, (key_sample, key_augment) = program.cfg, keys
    slots, weights = program.sampler.sample(key_sample, replay, progress, cfg.learn.batch)
    batch = sharding.shard_batch(program.mesh, ring.gather(replay, slots))
    augmented = jax.vmap(augment.augment, (0, None, 0))
    return slots, weights, augmented(numbered_keys(key_augment, cfg.learn.batch), cfg, batch)


def first_to_learn(cfg: Config) -> int:
    """Returns the first training step whose updates are kept."""
    return -(-cfg.train.learning_starts // cfg.train.scenes) - 1


def updates_done(cfg: Config, step: jax.Array) -> jax.Array:
    """Returns how many updates [] int32 were kept before training step `step` []."""
    return jnp.maximum(step - first_to_learn(cfg), 0) * cfg.learn.updates_per_step


def numbered_keys(key: jax.Array, num: int) -> jax.Array:
    """Returns `num` keys; unlike `jax.random.split` the first do not depend on `num`."""
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(num))


def _step_keys(key: jax.Array, step: jax.Array) -> tuple[jax.Array, ...]:
    """Returns the keys to act, to learn and to reset."""
    return tuple(jax.random.split(jax.random.fold_in(key, step), 3))


def _is_finite(tree: Any) -> jax.Array:
    floats = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.all(jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in floats], bool))
