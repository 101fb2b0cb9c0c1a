"""Times the stages of a training step, as JSON: `csac-jax bench step [PRESET] [--steps N]
[--repeats N] [SETTING ...]`, PRESET `quick` if none is given, settings as `csac-jax train` takes
them: `--learn.updates_per_step 64`.

Each stage of `train_step` is compiled by itself. It is timed beside the whole step, a compiled loop
of STEPS (2) steps as in training. Calls take turns in one process, and the median of REPEATS (5)
rounds counts, so other load slows all alike. Trust ratios. `bench start` times compilation with a
filled cache.
"""

import functools
import itertools
import resource
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from csac_jax.agent import policy, values
from csac_jax.agent.csac import CSAC
from csac_jax.agent.learner import Transition
from csac_jax.config import Config
from csac_jax.replay import ring
from csac_jax.robot.primitives import Action
from csac_jax.runtime import compiler
from csac_jax.sim import backend
from csac_jax.training import programs, split_step, step, transitions
from csac_jax.vision import heightmap
from experiments.bench._options import config, emit, read_preset
from experiments.bench._timing import medians


def _compile(program: step.Program, state: Any, steps: int) -> tuple[Any, dict[str, float]]:
    """Compiles a chunk; returns it and the seconds to trace and to compile it.

    Of two programs the second is traced while the first compiles, and counts as compilation.
    """
    begun = time.perf_counter()
    lowered = compiler.lower(split_step.compile_chunk(program, steps), state)
    traced = time.perf_counter()
    compiled = lowered.compile()
    if isinstance(compiled, split_step.Chunk):
        compiled.learn.result()  # waits for it
    return compiled, {"trace": traced - begun, "compile": time.perf_counter() - traced}


def _stages(program: step.Program, state: step.TrainState) -> dict[str, Callable[[], Any]]:
    """Returns a call of each stage of `train_step`, compiled by itself."""
    cfg, env, learner = program.cfg, program.env, program.learner
    assert isinstance(learner, CSAC)
    parts = learner.parts
    scenes, nets, num = state.scenes, state.learner, cfg.train.scenes
    key, numbers = jax.random.key(1), itertools.count()  # each call has a key of its own number
    choose = jax.vmap(policy.act, (0, None, 0, 0, None))

    def scene_keys(number: jax.Array) -> jax.Array:
        return step.numbered_keys(jax.random.fold_in(key, number), num)

    def act(number: jax.Array, maps: Any, steps_without_change: jax.Array) -> Action:
        return choose(scene_keys(number), parts, maps, steps_without_change, jnp.int32(0))

    def reward(nets: Any, before: Any, action: Action, after: Any) -> jax.Array:
        result = transitions.to_action_result(
            action, transitions.with_reward_outcome(cfg.reward, after).info
        )
        return learner.reward(cfg.reward, nets, before.obs, after.obs, result)[0]

    def remember(replay: Any, before: Any, action: Action, after: Any) -> Any:
        packed = heightmap.pack(before.obs), heightmap.pack(after.obs)
        ended = after.terminated
        label = ended if cfg.reward.relabels else None
        transition = Transition(packed[0], action, jnp.zeros(num), packed[1], ended, label)
        return ring.add(replay, transition, ~after.info.physics_diverged)

    def learn(number: jax.Array, nets: Any, replay: Any) -> Any:
        return step.learn(program, jax.random.fold_in(key, number), nets, replay, nets.updates)

    def replace(number: jax.Array, after: Any) -> Any:
        fresh = jax.vmap(env.auto_reset)(scene_keys(number), after)
        return transitions.where(after.done, fresh, after)

    jit = functools.partial(jax.jit, compiler_options=compiler.options(cfg))
    run = {
        "dense_maps": jit(lambda params, obs: values.dense_maps(parts, params, obs)),
        "act": jax.jit(act),
        "simulate": jax.jit(jax.vmap(env.step)),
        "reward": jit(reward),
        "remember": jax.jit(remember, donate_argnums=0),
        "learn": jit(learn),
        "replace": jax.jit(replace),
    }
    maps = run["dense_maps"](nets.online, scenes.obs)
    action = run["act"](next(numbers), maps, scenes.steps_without_change)
    after = run["simulate"](scenes, action)
    replay = run["remember"](jax.tree.map(jnp.copy, state.replay), scenes, action, after)
    filled = jax.tree.map(jnp.copy, replay)

    def remember_again() -> Any:
        nonlocal replay
        replay = run["remember"](replay, scenes, action, after)
        return replay.head

    return {
        "dense_maps": lambda: run["dense_maps"](nets.online, scenes.obs),
        "act": lambda: run["act"](next(numbers), maps, scenes.steps_without_change),
        "simulate": lambda: run["simulate"](scenes, action),
        "reward": lambda: run["reward"](nets, scenes, action, after),
        "remember": remember_again,
        "learn": lambda: run["learn"](next(numbers), nets, filled),
        "replace": lambda: run["replace"](next(numbers), after),
    }


def _whole(chunk: Any, cfg: Config, state: step.TrainState) -> Callable[[], Any]:
    """Returns a call that runs the chunk from the last call's state; all steps learn."""
    state = state.replace(step=jnp.int32(step.first_to_learn(cfg)))

    def call() -> Any:
        nonlocal state
        state, metrics = chunk(state)
        return metrics

    return call


def _memory(chunk: Any) -> dict[str, int | None]:
    """Returns the bytes of the program; of two, those of the one that learns."""
    program = chunk.learn.result() if isinstance(chunk, split_step.Chunk) else chunk
    stats, device = program.memory_analysis(), jax.devices()[0].memory_stats() or {}
    return {
        "state_bytes": stats.argument_size_in_bytes,
        "temporary_bytes": stats.temp_size_in_bytes,
        "peak_bytes": device.get("peak_bytes_in_use"),
        "process_peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def measure(cfg: Config, steps: int, repeats: int) -> dict[str, Any]:
    """Times one config's step and its stages."""
    program = programs.make(cfg)
    state = programs.init(program)
    chunk, compiling = _compile(program, state, steps)
    calls = _stages(program, state)
    calls["whole"] = _whole(chunk, cfg, jax.tree.map(jnp.copy, state))  # it uses it up
    seconds = medians(calls, repeats)
    whole = seconds.pop("whole") / steps
    total = sum(seconds.values())
    return {
        "stage_seconds": seconds,
        "stage_shares": {name: value / total for name, value in seconds.items()},
        "step_seconds": whole,
        "sum_of_stages_over_step": total / whole,
        "actions_per_second": cfg.train.scenes / whole,
        "physics_steps_per_second": cfg.train.scenes * cfg.sim.substeps / whole,
        "updates_per_second": cfg.learn.updates_per_step / whole,
        "compile_seconds": compiling,
        **_memory(chunk),
    }


def main(arguments: list[str]) -> None:
    """Prints the result."""
    preset, numbers, flags = read_preset("step", arguments, steps=2, repeats=5)
    cfg = backend.resolve(config("step", preset, flags))
    result = {"preset": preset, "settings": flags, "physics": cfg.sim.physics}
    result |= {"scenes": cfg.train.scenes, "substeps": cfg.sim.substeps, **numbers}
    emit(result | {"updates": cfg.learn.updates_per_step} | measure(cfg, **numbers))
