"""Programs: a config's parts put together, the first state, and chunks of training steps."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import env as environment
from csac_jax.agent import actor_critic
from csac_jax.agent.csac import CSAC
from csac_jax.agent.learner import Learner, Transition
from csac_jax.config import Config
from csac_jax.replay import ring, samplers
from csac_jax.robot.primitives import Action
from csac_jax.runtime import compiler
from csac_jax.sim import physics as simulation
from csac_jax.training import step
from csac_jax.training.step import Program, TrainState
from csac_jax.training.transitions import StepMetrics
from csac_jax.vision import heightmap
from csac_jax.world import scene_state


class Hyperparams(NamedTuple):
    """Settings that enter the program as arguments, in place of constants of its config."""

    values: dict[str, Any]  # value [...] of each setting by its dotted name, such as `learn.tau`
    return_bounds: tuple[Any, Any]  # smallest and largest possible return, []


def make(
    cfg: Config,
    env: environment.Env | None = None,
    learner: Learner | None = None,
    sampler: samplers.Sampler | None = None,
    network: Any = None,
) -> Program:
    """Makes the program of a config; parts that are given replace the config's."""
    env = environment.make_env(cfg) if env is None else env
    learner = CSAC(actor_critic.make(cfg, network)) if learner is None else learner
    sampler = samplers.make(cfg.replay, cfg.train.scenes) if sampler is None else sampler
    return Program(cfg, env, learner, sampler)


def replace_hyperparams(program: Program, hyperparams: Hyperparams | None) -> Program:
    """Replaces settings of a program by values that may be traced; a custom learner keeps its."""
    if hyperparams is None:
        return program
    cfg, learner = replace_settings(program.cfg, hyperparams.values), program.learner
    if isinstance(learner, CSAC):
        learner = learner.replace_hyperparams(cfg, hyperparams.return_bounds)
    sampler = program.sampler.replace_hyperparams(cfg.replay)
    return dataclasses.replace(program, cfg=cfg, learner=learner, sampler=sampler)


def replace_settings(cfg: Config, values: dict[str, Any]) -> Config:
    """Replaces settings of a config, by dotted name; traced values are not checked."""
    sections: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        section, field = name.split(".")
        sections.setdefault(section, {})[field] = value
    return cfg.change(**sections)


def init(program: Program) -> TrainState:
    """Creates the initial state. A step keeps its shapes and dtypes."""
    return compile_init(program)()


def compile_init(program: Program) -> Callable[[], TrainState]:
    """Returns a function that creates the initial state; it compiles when it is called."""
    begin = jax.jit(functools.partial(init_state, program))  # traced once, for shapes and values

    def first() -> TrainState:
        key = jax.random.key(program.cfg.seed)
        if isinstance(key, jax.core.Tracer):  # for shapes alone; no options within a trace
            return begin(key)
        return begin.lower(key).compile(compiler.options(program.cfg))(key)

    return first


def init_state(
    program: Program, key: jax.Array, hyperparams: Hyperparams | None = None
) -> TrainState:
    """Creates the initial state from the root key: scenes, networks, an empty ring (lines 1-4)."""
    program = replace_hyperparams(program, hyperparams)
    cfg = program.cfg
    key_scenes, key_nets = jax.random.split(jax.random.fold_in(key, np.uint32(2**32 - 1)))
    scenes = jax.vmap(program.env.reset)(step.numbered_keys(key_scenes, cfg.train.scenes))
    learner = program.learner.init(key_nets)
    replay = ring.init(program.sampler.init(cfg.replay.capacity), example(cfg))
    return TrainState(key, jnp.int32(0), scenes, learner, replay)


def prepare(program: Program) -> None:
    """Prepares what else delays the first step; callable in another thread."""
    simulation.prepare(program.env.physics, program.cfg.train.scenes)


def example(cfg: Config) -> Transition:
    """Returns the shapes and dtypes of a stored transition, without arrays."""

    def build() -> Transition:
        rows, no = (cfg.heightmap.size, cfg.heightmap.size), jnp.zeros((), bool)
        fingers = jnp.zeros(3) if cfg.net.gripper else None
        maps = jnp.zeros((*rows, 3)), jnp.zeros(rows), jnp.zeros(rows, bool)
        obs = heightmap.pack(heightmap.Observation(*maps, fingers))
        label = no if cfg.reward.relabels else None
        action = Action(primitive=jnp.int32(0), pose=jnp.zeros(3))
        return Transition(obs, action, jnp.zeros(()), obs, no, label)

    return jax.eval_shape(build)


def abstract_state(cfg: Config, learner: Learner | None = None, network: Any = None) -> Any:
    """Returns the shapes and dtypes of a run's state; nothing is settled or compiled."""
    no_physics: Any = None
    blank = jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene_state.parked(cfg.scene.slots))
    program = make(cfg, environment.Env(cfg, no_physics, blank), learner, network=network)
    return jax.eval_shape(lambda: init(program))


def compile_chunk(program: Program, num_steps: int) -> Any:
    """Returns a jitted function state -> (state, StepMetrics [T, ...]) of T = `num_steps` steps.

    The state is donated: the replay is updated in place.
    """
    chunk = functools.partial(run_steps, program, num_steps)
    return jax.jit(chunk, donate_argnums=0, compiler_options=compiler.options(program.cfg))


def run_steps(
    program: Program, num_steps: int, state: TrainState
) -> tuple[TrainState, StepMetrics]:
    """Scans over training steps; the metrics have leaves [T, ...], T = `num_steps`."""
    return jax.lax.scan(lambda carry, _: step.train_step(program, carry), state, length=num_steps)
