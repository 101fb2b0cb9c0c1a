"""Learning from n stored transitions, which fill the ring: a training step without scenes."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax.agent import actor_critic
from csac_jax.agent.csac import CSAC
from csac_jax.agent.learner import Transition
from csac_jax.config import Config
from csac_jax.replay import ring, samplers
from csac_jax.runtime import compiler
from csac_jax.training import programs, step
from csac_jax.training.step import Program


@struct.dataclass
class OfflineState:
    """The state from step to step."""

    key: jax.Array  # [] typed key, root of all randomness, never consumed
    step: jax.Array  # [] int32, steps done, each of `learn.updates_per_step` updates
    learner: Any
    replay: ring.ReplayState


@functools.lru_cache(maxsize=2)
def make(cfg: Config) -> Program:
    """Makes the program of a config, without environment; cached."""
    no_env: Any = None
    learner = CSAC(actor_critic.make(cfg))
    return Program(cfg, no_env, learner, samplers.make(cfg.replay))


def init(program: Program, params: actor_critic.Params) -> Any:
    """Creates the learner's initial state with copies of these networks; the state is donated."""
    fresh = jax.jit(program.learner.init)(jax.random.key(0))
    return actor_critic.with_params(fresh, jax.tree.map(jnp.array, params))


def fill(program: Program, transitions: Transition) -> ring.ReplayState:
    """Creates a ring that these transitions, leaves [n, ...], fill."""
    num = transitions.reward.shape[0]
    empty = ring.init(program.sampler.init(num), programs.example(program.cfg))
    return ring.add(empty, transitions, jnp.ones(num, bool))


@functools.lru_cache(maxsize=2)
def compile_step(program: Program):
    """Returns a jitted function state -> (state, losses), of one step; the state is donated."""
    cfg = program.cfg

    def one(state: OfflineState) -> tuple[OfflineState, dict[str, jax.Array]]:
        key, done = (
            jax.random.fold_in(state.key, state.step),
            state.step * cfg.learn.updates_per_step,
        )
        learner, priority, losses = step.learn(program, key, state.learner, state.replay, done)
        replay = state.replay.replace(priority=priority)
        return OfflineState(state.key, state.step + 1, learner, replay), losses

    return jax.jit(one, donate_argnums=0, compiler_options=compiler.options(cfg))
