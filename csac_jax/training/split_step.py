"""A chunk of training steps as two programs, the halves of `step.train_step`.

On a CPU compiling takes longer than a run's first steps. So acting begins while the other half
compiles, and updates that would be dropped are not made. Elsewhere a chunk is one program.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from csac_jax.config import Config
from csac_jax.runtime import compiler
from csac_jax.training import programs, step, trace_cache
from csac_jax.training.step import Program, TrainState
from csac_jax.training.transitions import StepMetrics


def compile_chunk(program: Program, num_steps: int, cached: bool = False) -> Any:
    """Returns a chunk as `programs.compile_chunk` does, or one that has `lower` alone; `cached`, a
    program without custom parts, is kept on disk, see `trace_cache`."""
    whole = program.mesh is not None or program.cfg.train.overlap
    if jax.default_backend() != "cpu" or whole:
        return programs.compile_chunk(program, num_steps)
    return _Split(program, num_steps, cached)


class _Split(NamedTuple):
    """A chunk that is lowered and compiled half by half."""

    program: Program
    num_steps: int
    cached: bool
    act: Any = None  # the first half, lowered

    def lower(self, state: Any) -> "_Split":
        """Traces the half that acts; the other one is traced while that compiles."""
        half = trace_cache.jit(self.program, step.act_half, self.cached)
        return self._replace(act=compiler.lower(half, state))

    def compile(self) -> "Chunk":
        """Compiles acting now and learning in a background thread."""
        learning = ThreadPoolExecutor(1)
        half = trace_cache.jit(self.program, step.learn_half, self.cached)
        tracing = learning.submit(compiler.lower, half, *self.act.out_info)
        act = self.act.compile()
        learn = learning.submit(tracing.result().compile)
        learning.shutdown(wait=False)
        return Chunk(self.program.cfg, self.num_steps, act, learn)


class Chunk(NamedTuple):
    """A compiled chunk: state -> (state, StepMetrics [T, ...]), which uses up its argument."""

    cfg: Config
    num_steps: int
    act: Any
    learn: Future[Any]  # waited for by the first step that learns

    def __call__(self, state: TrainState) -> tuple[TrainState, StepMetrics]:
        done, begins, steps = int(state.step), step.first_to_learn(self.cfg), []
        for number in range(done, done + self.num_steps):
            state, metrics = self.act(state)
            if number >= begins:
                state, metrics = self.learn.result()(state, metrics)
            steps.append(metrics)
        return state, jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(steps))
