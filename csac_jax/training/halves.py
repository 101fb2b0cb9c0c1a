"""A chunk of training steps as two programs: one acts, the other learns.

On a CPU compiling takes longer than what a run does before it learns. So acting begins while what
learns still compiles, and updates that would be dropped are not made. Elsewhere a chunk is one
program, as a step is many small kernels there, which the host would keep waiting.
"""

import functools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from csac_jax.config import Config
from csac_jax.runtime import compiler
from csac_jax.training import step, traced
from csac_jax.training.step import Program, StepMetrics, TrainState


def compile_chunk(program: Program, num_steps: int, keep: bool = False) -> Any:
    """As `step.compile_chunk`; what it gives has `lower` alone. With `keep`, traced programs are
    kept on disk where they can be, see `traced`: for a program without parts of your own."""
    if jax.default_backend() != "cpu" or program.mesh is not None:
        return step.compile_chunk(program, num_steps)
    return _Traceable(program, num_steps, keep)


class _Traceable(NamedTuple):
    """What is traced part by part."""

    program: Program
    num_steps: int
    keep: bool

    def lower(self, state: Any) -> "_Lowered":
        """Traces what acts; the other part is traced while that compiles."""
        return _Lowered(self, compiler.lower(self.part(step.act_step), state))

    def part(self, function: Callable[..., Any]) -> Any:
        """A part of the step, jitted; the state is donated."""
        bound = functools.partial(function, self.program)
        options = compiler.options(self.program.cfg)
        jitted = jax.jit(bound, donate_argnums=0, compiler_options=options)
        return traced.keep(self.program, function.__name__, jitted) if self.keep else jitted


class _Lowered(NamedTuple):
    """The chunk, of which one part is traced."""

    traceable: _Traceable
    act: Any

    def compile(self) -> "Chunk":
        """The chunk that can act; a thread goes on with what learns."""
        given, learning = self.traceable, ThreadPoolExecutor(1)
        part = given.part(step.learn_step)
        tracing = learning.submit(compiler.lower, part, *self.act.out_info)
        act = self.act.compile()
        learn = learning.submit(tracing.result().compile)
        learning.shutdown(wait=False)
        return Chunk(given.program.cfg, given.num_steps, act, learn)


class Chunk(NamedTuple):
    """A compiled chunk: state -> (state, StepMetrics [T, ...]), which uses up its argument."""

    cfg: Config
    num_steps: int
    act: Any
    learn: Future[Any]  # waited for by the first step that learns

    def __call__(self, state: TrainState) -> tuple[TrainState, StepMetrics]:
        done, begins, every = int(state.step), step.first_to_learn(self.cfg), []
        for number in range(done, done + self.num_steps):
            state, metrics = self.act(state)
            if number >= begins:
                state, metrics = self.learn.result()(state, metrics)
            every.append(metrics)
        return state, jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(every))
