"""Speed of this machine, as JSON: `csac-jax bench step [PRESET]`, with PRESET `quick` if none is given.

The training step is timed beside a bare `mjx.step` loop of the same scenes and set-points in the same process, and
each part is the median of several calls; machines are noisy, so trust ratios.
"""

import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from csac_jax import presets
from csac_jax.agent import learner as learning
from csac_jax.cli import BadArgumentsError
from csac_jax.nets.convolution import conv2d
from csac_jax.sim.primitives import Action
from csac_jax.train import provenance, step
from experiments.bench import _bare

REPEATS = 5


def _median_seconds(call: Callable[[], Any]) -> float:
    jax.block_until_ready(call())
    seconds = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - begun)
    return statistics.median(seconds)


def _conv_gradient(conv: Callable[[jax.Array, jax.Array], jax.Array]) -> float:
    """Seconds per kernel gradient of a 3 x 3 convolution, 64 maps of 36 x 36, 16 to 16 channels, in `lax.scan`."""
    maps = jax.random.normal(jax.random.key(0), (64, 36, 36, 16))
    kernel = jax.random.normal(jax.random.key(1), (3, 3, 16, 16))
    gradient = jax.grad(lambda kernel, shift: jnp.sum(conv(maps + shift, kernel) ** 2))

    def loop(kernel: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda total, i: (total + gradient(kernel, i), None), kernel, jnp.arange(2.0))[0]

    compiled = jax.jit(loop)
    return _median_seconds(lambda: compiled(kernel)) / 2


def _autodiff_conv(maps: jax.Array, kernel: jax.Array) -> jax.Array:
    return jax.lax.conv_general_dilated(maps, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


def measure(preset: str) -> dict[str, Any]:
    """Timings of one preset, s and actions/s."""
    cfg = presets.get(preset)
    program = step.make(cfg)
    scenes, learner = cfg.train.scenes, program.learner
    begun = time.perf_counter()
    chunk = step.compile_chunk(program, 1).lower(step.init(program)).compile()
    compile_seconds = time.perf_counter() - begun
    state = step.init(program)

    actions = Action(primitive=jnp.ones(scenes, jnp.int32), pose=jnp.zeros((scenes, 3)))
    drives = _bare.drives(cfg, state.scenes.obs.height, actions)
    simulate = jax.jit(jax.vmap(program.env.step))
    look = jax.jit(lambda params, obs: learning.look(learner, params, obs))
    parts = {
        "simulate": _median_seconds(lambda: simulate(state.scenes, actions)),
        "look": _median_seconds(lambda: look(state.learner.online, state.scenes.obs)),
        "bare_mjx_loop": _median_seconds(_bare.loop(program.env.physics, state.scenes.scene, drives)),
    }

    def train() -> Any:
        nonlocal state
        state, metrics = chunk(state)
        return metrics

    parts["train_step"] = _median_seconds(train)
    return {
        "preset": preset,
        "scenes": scenes,
        "substeps": cfg.sim.substeps,
        "compile_seconds": compile_seconds,
        "median_seconds": parts,
        "actions_per_second": scenes / parts["train_step"],
        "physics_share": parts["simulate"] / parts["train_step"],
        "conv_gradient_in_scan": {
            "ours": _conv_gradient(lambda maps, kernel: conv2d(maps, kernel, 1, 1, 1)),
            "autodiff": _conv_gradient(_autodiff_conv),
        },
        "bare_loop_over_simulate": parts["bare_mjx_loop"] / parts["simulate"],
    }


def main(arguments: list[str]) -> None:
    """Prints the result."""
    if len(arguments) > 1 or not presets.PRESETS.keys() >= set(arguments):
        raise BadArgumentsError(f"bench step: give one preset of: {', '.join(presets.PRESETS)}; or none, for quick")
    print(json.dumps(measure(*arguments or ["quick"]) | provenance.record(), indent=2))
