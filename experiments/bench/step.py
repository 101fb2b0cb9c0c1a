"""Where the time of a training step goes, as JSON: `csac-jax bench step [PRESET] [--physics
mjx|warp|c|auto] [--steps N] [--repeats N] [--curve scenes|blocks|map|capacity --smallest A
--largest B] [SETTING ...]`, PRESET `quick` if none is given, physics `auto`, settings as `csac-jax
train` takes them: `--learn.updates 64`.

Each stage of `train_step` is compiled by itself and timed beside the whole step, a compiled loop of
STEPS (2) steps as in training, and beside a bare loop of the engine's own steps of the same scenes
and set-points: in one process, turn by turn, the median of REPEATS (5) rounds, so that what else
the machine does hits all alike. Trust ratios. `learn` is taken apart once more, into single calls:
`draw` a batch, its `next_value`, `update_critic` with that inside, and `update_actor`. With
`--reward.push-effect renewed` there are the `labels` of a batch too, as part of `update_critic`.

With --curve the whole step alone is timed at A, 2 A, 4 A .. B scenes, blocks, cells along a side of
the map, or transitions in the ring; contact caps grow with the blocks. On an accelerator,
`peak_bytes` is of all measured so far.
"""

import argparse
import concurrent.futures
import contextlib
import functools
import json
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.compilation_cache import compilation_cache

from csac_jax import presets
from csac_jax.agent import actor, critic, policy, values
from csac_jax.agent.actor_critic import ActorCritic
from csac_jax.agent.csac import CSAC
from csac_jax.agent.learner import Transition
from csac_jax.cli import parsing
from csac_jax.cli.failures import BadArgumentsError
from csac_jax.config import Config, PhysicsKind
from csac_jax.nets.convolution import conv2d
from csac_jax.replay import ring
from csac_jax.runtime import cache, compiler, provenance
from csac_jax.sim import backend
from csac_jax.sim.primitives import Action
from csac_jax.training import programs, split_step, step, transitions
from csac_jax.vision import heightmap
from experiments.bench import _bare
from experiments.bench._options import Parser, config, split, with_blocks
from experiments.bench._timing import medians

CURVES = {"scenes": (1, 16), "blocks": (1, 8), "map": (32, 128), "capacity": (1024, 65536)}
_PARTS = ("draw", "next_value", "update_critic", "update_actor")  # of learning
_LABELS = ("labels", "no_labels")  # likewise, where labels are renewed
_SEPARATE = ("dense_maps", "act", "simulate", "reward", "remember", "learn", "replace")


def _compile(program: step.Program, state: Any, steps: int) -> tuple[Any, dict[str, float]]:
    """The compiled chunk, seconds to trace it and to compile it. Of two programs the second is
    traced while the first compiles, and counts as compilation."""
    begun = time.perf_counter()
    lowered = compiler.lower(split_step.compile_chunk(program, steps), state)
    traced = time.perf_counter()
    compiled = lowered.compile()
    if isinstance(compiled, split_step.Chunk):
        compiled.learn.result()  # waits for it
    return compiled, {"trace": traced - begun, "compile": time.perf_counter() - traced}


@contextlib.contextmanager
def _fresh_cache() -> Iterator[None]:
    """An empty cache of compiled programs, in place of the user's."""
    names = (
        "jax_compilation_cache_dir",
        "jax_enable_compilation_cache",
        "jax_persistent_cache_min_compile_time_secs",
    )
    before = {name: getattr(jax.config, name) for name in names}
    with tempfile.TemporaryDirectory() as folder:
        for name, value in zip(names, (folder, True, 0.0), strict=True):
            jax.config.update(name, value)
        compilation_cache.reset_cache()
        cache.enable()  # counts hits
        try:
            yield
        finally:
            for name, value in before.items():
                jax.config.update(name, value)
            compilation_cache.reset_cache()


def _compile_twice(program: step.Program, state: Any, steps: int) -> tuple[Any, dict[str, Any]]:
    """The compiled chunk, and what it took with an empty cache and with a filled one, tracing anew
    both times."""
    with _fresh_cache():
        _, cold = _compile(program, state, steps)
        jax.clear_caches()
        hits = cache.hits()
        chunk, cached = _compile(program, state, steps)
        return chunk, {"cold": cold, "cached": cached, "found_in_cache": cache.hits() > hits}


def _compile_together(programs: dict[str, tuple[Any, tuple[Any, ...]]]) -> dict[str, Any]:
    """Compiled programs from jitted functions and the arguments, or their shapes, that each is for;
    all at a time."""
    with concurrent.futures.ThreadPoolExecutor() as threads:
        compiled = threads.map(lambda pair: pair[0].lower(*pair[1]).compile(), programs.values())
        return dict(zip(programs, compiled, strict=True))


def _stages(program: step.Program, state: step.TrainState) -> dict[str, Callable[[], Any]]:
    """The stages of `train_step`, each a call of a program of its own."""
    cfg, env, learner = program.cfg, program.env, program.learner
    assert isinstance(learner, CSAC)
    parts = learner.parts
    scenes, nets, num = state.scenes, state.learner, cfg.train.scenes
    keys, key = step.numbered_keys(jax.random.key(1), num), jax.random.key(2)
    choose = jax.vmap(policy.act, (0, None, 0, 0, None))

    def act(keys: jax.Array, maps: Any, steps_without_change: jax.Array) -> Action:
        return choose(keys, parts, maps, steps_without_change, jnp.int32(0))

    def reward(nets: Any, before: Any, action: Action, after: Any) -> jax.Array:
        result = transitions.to_action_result(
            action, transitions.with_reward_outcome(cfg.reward, after).info
        )
        return learner.reward(cfg.reward, nets, before.obs, after.obs, result)[0]

    def remember(replay: Any, before: Any, action: Action, after: Any) -> Any:
        packed = heightmap.pack(before.obs), heightmap.pack(after.obs)
        ended = after.terminated
        label = ended if cfg.reward.renewed else None
        transition = Transition(packed[0], action, jnp.zeros(num), packed[1], ended, label)
        return ring.add(replay, transition, ~after.info.physics_diverged)

    def replace(keys: jax.Array, after: Any) -> Any:
        return transitions.where(after.done, jax.vmap(env.auto_reset)(keys, after), after)

    jit = functools.partial(jax.jit, compiler_options=compiler.options(cfg))
    stages = {
        "dense_maps": jit(lambda params, obs: values.dense_maps(parts, params, obs)),
        "act": jax.jit(act),
        "simulate": jax.jit(jax.vmap(env.step)),
        "reward": jit(reward),
        "remember": jax.jit(remember, donate_argnums=0),
        "learn": jit(
            lambda key, nets, replay: step.learn(program, key, nets, replay, nets.updates)
        ),
        "replace": jax.jit(replace),
    }
    maps = jax.eval_shape(stages["dense_maps"], nets.online, scenes.obs)
    action = jax.eval_shape(stages["act"], keys, maps, scenes.steps_without_change)
    after = jax.eval_shape(stages["simulate"], scenes, action)
    shapes = {
        "dense_maps": (nets.online, scenes.obs),
        "act": (keys, maps, scenes.steps_without_change),
        "simulate": (scenes, action),
        "reward": (nets, scenes, action, after),
        "remember": (state.replay, scenes, action, after),
        "learn": (key, nets, state.replay),
        "replace": (keys, after),
    }
    run = _compile_together({name: (stages[name], arguments) for name, arguments in shapes.items()})

    maps = run["dense_maps"](nets.online, scenes.obs)
    action = run["act"](keys, maps, scenes.steps_without_change)
    after = run["simulate"](scenes, action)
    replay = run["remember"](jax.tree.map(jnp.copy, state.replay), scenes, action, after)
    filled = jax.tree.map(jnp.copy, replay)

    def remember_again() -> Any:
        nonlocal replay
        replay = run["remember"](replay, scenes, action, after)
        return replay.head

    calls: dict[str, Callable[[], Any]] = {
        "dense_maps": lambda: run["dense_maps"](nets.online, scenes.obs),
        "act": lambda: run["act"](keys, maps, scenes.steps_without_change),
        "simulate": lambda: run["simulate"](scenes, action),
        "reward": lambda: run["reward"](nets, scenes, action, after),
        "remember": remember_again,
        "learn": lambda: run["learn"](key, nets, filled),
        "replace": lambda: run["replace"](keys, after),
    }
    calls |= _learning(program, parts, nets, filled)
    calls["bare_loop"] = _bare.loop(
        env.physics, scenes.scene, _bare.joint_trajectories(cfg, scenes.obs.height, action)
    )
    return calls


def _learning(
    program: step.Program, parts: ActorCritic, nets: Any, replay: Any
) -> dict[str, Callable[[], Any]]:
    """What learning is made of, each a call of a program of its own; a call of each but
    `update_actor` is an update."""
    cfg = program.cfg
    key, keys = jax.random.key(3), jax.random.split(jax.random.key(4), cfg.learn.batch)
    jit = functools.partial(jax.jit, compiler_options=compiler.options(cfg))

    def next_value(nets: Any, batch: Transition) -> jax.Array:
        maps = values.dense_maps(parts, nets.target, heightmap.unpack(batch.next_obs))
        return jax.vmap(critic.next_value, (None, 0, 0))(parts, keys, maps)

    draw = jit(
        lambda replay: step.draw(program, list(jax.random.split(key)), replay, jnp.float32(0.5))
    )
    value = jit(next_value)
    learn_critic = jit(lambda nets, batch, weights: critic.update(key, parts, nets, batch, weights))
    learn_actor = jit(lambda nets, obs: actor.update(parts, nets, heightmap.unpack(obs)))
    _, weights, batch = draw(replay)
    obs = jax.tree.map(lambda leaf: leaf[: cfg.learn.actor_batch or None], batch.obs)
    calls: dict[str, Callable[[], Any]] = {
        "draw": lambda: draw(replay),
        "next_value": lambda: value(nets, batch),
        "update_critic": lambda: learn_critic(nets, batch, weights),
        "update_actor": lambda: learn_actor(nets, obs),
    }
    return calls | _labels(parts, nets, batch)


def _labels(parts: ActorCritic, nets: Any, batch: Transition) -> dict[str, Callable[[], Any]]:
    """The labels that an update renews, of a batch of which every fourth is a push, and of none."""
    if not parts.cfg.reward.renewed:
        return {}
    fourth = jnp.arange(parts.cfg.learn.batch) % 4 == 0
    obs = jax.jit(heightmap.unpack)(batch.obs)
    jit = functools.partial(jax.jit, compiler_options=compiler.options(parts.cfg))
    best = jit(lambda params, asked: values.best_grasps(parts, params, obs, asked))
    return {
        "labels": lambda: best(nets.target, fourth),
        "no_labels": lambda: best(nets.target, jnp.zeros_like(fourth)),
    }


def _whole(chunk: Any, cfg: Config, state: step.TrainState) -> Callable[[], Any]:
    """A call of the compiled chunk, going on from where the last one ended; all its steps learn."""
    state = state.replace(step=jnp.int32(step.first_to_learn(cfg)))

    def call() -> Any:
        nonlocal state
        state, metrics = chunk(state)
        return metrics

    return call


def _rates(cfg: Config, seconds: float) -> dict[str, float]:
    """What a training step of so many seconds comes to."""
    return {
        "actions_per_second": cfg.train.scenes / seconds,
        "physics_steps_per_second": cfg.train.scenes * cfg.sim.substeps / seconds,
        "updates_per_second": cfg.learn.updates / seconds,
    }


def _memory(chunk: Any) -> dict[str, int | None]:
    """Bytes of the program, of two that of the one that learns, which needs more."""
    program = chunk.learn.result() if isinstance(chunk, split_step.Chunk) else chunk
    stats, device = program.memory_analysis(), jax.devices()[0].memory_stats() or {}
    return {
        "state_bytes": stats.argument_size_in_bytes,
        "temporary_bytes": stats.temp_size_in_bytes,
        "peak_bytes": device.get("peak_bytes_in_use"),
        "process_peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def _conv_gradient(conv: Callable[[jax.Array, jax.Array], jax.Array]) -> Callable[[], Any]:
    """Two kernel gradients of a 3 x 3 convolution, 64 maps of 36 x 36, 16 to 16 channels, in
    `lax.scan`."""
    maps = jax.random.normal(jax.random.key(0), (64, 36, 36, 16))
    kernel = jax.random.normal(jax.random.key(1), (3, 3, 16, 16))
    gradient = jax.grad(lambda kernel, shift: jnp.sum(conv(maps + shift, kernel) ** 2))

    def loop(kernel: jax.Array) -> jax.Array:
        return jax.lax.scan(
            lambda total, i: (total + gradient(kernel, i), None), kernel, jnp.arange(2.0)
        )[0]

    compiled = jax.jit(loop)
    return lambda: compiled(kernel)


def _autodiff_conv(maps: jax.Array, kernel: jax.Array) -> jax.Array:
    return jax.lax.conv_general_dilated(
        maps, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def measure(cfg: Config, steps: int, repeats: int) -> dict[str, Any]:
    """Times of one config's step and of its stages."""
    program = programs.make(cfg)
    state = programs.init(program)
    chunk, compiling = _compile_twice(program, state, steps)
    calls = _stages(program, state)
    seconds = medians(
        {**calls, "whole": _whole(chunk, cfg, jax.tree.map(jnp.copy, state))}, repeats
    )  # it uses it up
    whole = seconds["whole"] / steps
    stages = {name: seconds[name] for name in _SEPARATE}
    total = sum(stages.values())
    bare = seconds["bare_loop"]
    gradients = {
        "ours": lambda maps, kernel: conv2d(maps, kernel, 1, 1, 1),
        "autodiff": _autodiff_conv,
    }
    return {
        "stage_seconds": stages,
        "stage_shares": {name: value / total for name, value in stages.items()},
        "learn_call_seconds": {
            name: seconds[name] for name in (*_PARTS, *_LABELS) if name in seconds
        },
        "step_seconds": whole,
        "sum_of_stages_over_step": total / whole,
        **_rates(cfg, whole),
        "bare_loop_seconds": bare,
        "bare_loop_over_simulate": bare / stages["simulate"],
        "bare_loop_over_step": bare / whole,
        "compile_seconds": compiling,
        "conv_gradients_in_scan": medians(
            {name: _conv_gradient(conv) for name, conv in gradients.items()}, repeats
        ),
        **_memory(chunk),
    }


def _at(cfg: Config, curve: str, value: int) -> Config:
    """The config with `value` scenes, blocks, cells along a side or transitions."""
    if curve == "scenes":
        capacity = max(cfg.replay.capacity, value)
        return cfg.change(train={"scenes": value}, replay={"capacity": capacity})
    if curve == "map":
        return cfg.change(heightmap={"size": value})
    if curve == "capacity":
        return cfg.change(replay={"capacity": value})
    return with_blocks(cfg, value)


def _point(cfg: Config, curve: str, value: int, steps: int, repeats: int) -> dict[str, Any]:
    """One point of a curve: the whole step alone."""
    program = programs.make(cfg)
    state = programs.init(program)
    chunk, compiling = _compile(program, state, steps)
    seconds = medians({"whole": _whole(chunk, cfg, state)}, repeats)["whole"] / steps
    return {
        curve: value,
        "step_seconds": seconds,
        **_rates(cfg, seconds),
        "compile_seconds": compiling,
    } | _memory(chunk)


def _options(arguments: list[str]) -> tuple[str, argparse.Namespace, list[str]]:
    """The preset, the benchmark's options and the preset's settings."""
    parser = Parser(prog="bench step", allow_abbrev=False)
    parser.add_argument("--physics", choices=("mjx", "warp", "c", "auto"))
    parser.add_argument("--curve", choices=tuple(CURVES))
    for name, default in {"steps": 2, "repeats": 5, "smallest": 0, "largest": 0}.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    preset, options, flags = split(parser, arguments)
    if preset not in presets.PRESETS:
        raise BadArgumentsError(
            f"bench step: give one preset of: {', '.join(presets.PRESETS)}; or none, for quick"
        )
    if min(options.steps, options.repeats) < 1:
        raise BadArgumentsError("bench step: --steps, --repeats: at least 1")
    if options.curve is None:
        if options.smallest or options.largest:
            raise BadArgumentsError("bench step: --smallest and --largest belong to --curve")
        return preset, options, flags
    smallest, largest = CURVES[options.curve]
    options.smallest, options.largest = options.smallest or smallest, options.largest or largest
    if not 1 <= options.smallest <= options.largest:
        raise BadArgumentsError(
            "bench step: --smallest, --largest: 1 <= smallest <= largest is needed"
        )
    return preset, options, flags


def _config(preset: str, flags: list[str], physics: PhysicsKind | None) -> Config:
    cfg = config("step", preset, flags)
    if physics is None:
        physics = cfg.sim.physics if parsing.take(flags, "--sim.physics")[0] else "auto"
    if physics == "warp":
        cfg = cfg.change(scene={"size_jitter": (cfg.scene.size_jitter[0], 0.0)})
    return backend.resolve(cfg.change(sim={"physics": physics}))


def _values(smallest: int, largest: int) -> list[int]:
    return [smallest << i for i in range(32) if smallest << i <= largest]


def main(arguments: list[str]) -> None:
    """Prints the result."""
    preset, options, flags = _options(arguments)
    try:
        cfg = _config(preset, flags, options.physics)
        points = (
            [_at(cfg, options.curve, v) for v in _values(options.smallest, options.largest)]
            if options.curve
            else []
        )
    except ValueError as error:
        raise BadArgumentsError(f"bench step: {error}") from None
    result = {
        "preset": preset,
        "settings": flags,
        "physics": cfg.sim.physics,
        "scenes": cfg.train.scenes,
    } | {name: getattr(options, name) for name in ("steps", "repeats")}
    if options.curve:
        values = _values(options.smallest, options.largest)
        rows = [
            _point(p, options.curve, v, options.steps, options.repeats)
            for p, v in zip(points, values, strict=True)
        ]
        result |= {"curve": options.curve, "points": rows}
    else:
        result |= {"substeps": cfg.sim.substeps, "updates": cfg.learn.updates}
        result |= measure(cfg, options.steps, options.repeats)
    print(json.dumps(result | provenance.record(), indent=2))
