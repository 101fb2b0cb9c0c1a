"""Learning from transitions that are there already: the updates of a training step, and no scene.

The ring is full from the start and nothing is added. n = transitions.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax.agent import actor_critic
from csac_jax.agent.actor_critic import Params
from csac_jax.agent.csac import CSAC
from csac_jax.agent.learner import Transition
from csac_jax.config import Config
from csac_jax.replay import ring, samplers
from csac_jax.replay.ring import ReplayState
from csac_jax.runtime import compiler
from csac_jax.training import step
from csac_jax.training.step import Program


@struct.dataclass
class OfflineState:
    """What is carried from step to step."""

    key: jax.Array  # [] typed key, root of all randomness, never consumed
    step: jax.Array  # [] int32, steps done, each of `learn.updates` updates
    learner: Any
    replay: ReplayState


@functools.lru_cache(maxsize=2)
def make(cfg: Config) -> Program:
    """The program of a config, without environment; the same for the same config."""
    no_env: Any = None
    learner = CSAC(actor_critic.make(cfg))
    return Program(cfg, no_env, learner, samplers.make(cfg.replay))


def init(program: Program, params: Params) -> Any:
    """The learner's state before the first update, with copies of these networks: the state is
    used up later."""
    fresh = jax.jit(program.learner.init)(jax.random.key(0))
    return actor_critic.with_params(fresh, jax.tree.map(jnp.array, params))


def fill(program: Program, transitions: Transition) -> ReplayState:
    """The ring with transitions, leaves [n, ...], of which it has a slot for each."""
    num = transitions.reward.shape[0]
    empty = ring.init(program.sampler.init(num), step.example(program.cfg))
    return ring.add(empty, transitions, jnp.ones(num, bool))


@functools.lru_cache(maxsize=2)
def compile_step(program: Program):
    """A jitted function state -> (state, losses), of one step; the state is donated."""

    def one(state: OfflineState) -> tuple[OfflineState, dict[str, jax.Array]]:
        key, done = jax.random.fold_in(state.key, state.step), state.step * cfg.learn.updates
        learner, priority, losses = step.learn(program, key, state.learner, state.replay, done)
        replay = state.replay.replace(priority=priority)
        return OfflineState(state.key, state.step + 1, learner, replay), losses

    cfg = program.cfg
    return jax.jit(one, donate_argnums=0, compiler_options=compiler.options(cfg))
