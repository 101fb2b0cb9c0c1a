"""Replicas divided into parts, so that host and device work at the same time.

On a GPU with C physics the device waits for the host. The host moves the scenes of one part while
the device is at work for another. On a CPU each replica is a part, one after the other: vmapped
convolutions become grouped ones, which take twice as long.
"""

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
from jax.sharding import Mesh

from csac_jax.config import Config
from csac_jax.training import memory

_MOST = 2  # ours: parts on a GPU


def num_parts(cfg: Config, replicas: int, mesh: Mesh | None = None) -> int:
    """How many parts are best for so many replicas.

    One on several devices and for DenseNet-121, which keeps a device busy. One, too, where the
    states do not fit twice: they are taken apart and joined again.
    """
    if mesh is not None or cfg.net.kind != "small":
        return 1
    if 2 * replicas * sum(memory.state_bytes(cfg).values()) > memory.limit():
        return 1
    if jax.default_backend() == "cpu":
        return replicas
    if cfg.sim.physics != "c":
        return 1
    return max(parts for parts in range(1, _MOST + 1) if replicas % parts == 0)


@dataclasses.dataclass(frozen=True, eq=False)
class Pipelined:
    """A function state -> (state, metrics) made of one that serves a part.

    It is lowered and compiled like a jitted function, and callable once compiled. The state is
    donated.
    """

    program: Any  # jitted, lowered or compiled: (state of a part, its share) -> (state, metrics)
    shares: Sequence[Any]  # what else each part's call takes
    split: Callable[[Any], Sequence[Any]]  # jitted: a state -> those of the parts, copied
    join: Callable[[Sequence[Any]], Any]  # jitted: results of the parts -> result of all

    def lower(self, state: Any) -> "Pipelined":
        """As `jax.jit(...).lower`."""
        first, *_ = jax.eval_shape(self.split, state)
        return dataclasses.replace(self, program=self.program.lower(first, self.shares[0]))

    def compile(self) -> "Pipelined":
        """As `jax.stages.Lowered.compile`."""
        return dataclasses.replace(self, program=self.program.compile())

    def memory_analysis(self) -> Any:
        """That of the program of one part."""
        return self.program.memory_analysis()

    def __call__(self, state: Any) -> Any:
        """The result of all parts, once the last one is done."""
        states = jax.block_until_ready(self.split(state))
        for leaf in jax.tree.leaves(state):
            leaf.delete()
        at_once = 1 if jax.default_backend() == "cpu" else len(states)
        with ThreadPoolExecutor(at_once) as threads:
            done = list(threads.map(self._run, states, self.shares))
        return self.join(done)

    def _run(self, state: Any, share: Any) -> Any:
        return jax.block_until_ready(self.program(state, share))
