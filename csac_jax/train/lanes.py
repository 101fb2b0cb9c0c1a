"""Runs side by side in lanes: while the host moves the scenes of one lane, the device is at work for another.

C's physics is a callback, in which a program waits for the host. So each lane, an equal share of the runs, has the
program to itself, called by a thread of its own.
"""

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

from csac_jax.config import Config
from csac_jax.train import memory

_MOST = 2  # ours


def number(cfg: Config, members: int) -> int:
    """How many lanes for so many runs: two where host and device take turns, on a GPU with C's physics.

    One for networks of DenseNet-121, which keep a device busy as it is, and where there is no room for their states
    twice: they are taken apart and put together again.
    """
    if cfg.sim.physics != "c" or cfg.net.kind != "small" or jax.default_backend() != "gpu":
        return 1
    if 2 * memory.sure(cfg, members) > memory.limit():
        return 1
    return max(lanes for lanes in range(1, _MOST + 1) if members % lanes == 0)


@dataclasses.dataclass(frozen=True, eq=False)
class InLanes:
    """In place of a jitted, lowered or compiled function state -> (state, metrics): that of one lane, for all of them.

    The state is donated. It may be called once it is compiled.
    """

    program: Any  # jitted, lowered or compiled, of what one lane has of the state and of `shares`
    shares: Sequence[Any]  # what else it is given, of each lane
    split: Callable[[Any], Sequence[Any]]  # jitted: a state -> those of the lanes, in memory of their own
    join: Callable[[Sequence[Any]], Any]  # jitted: what the lanes return -> what all return

    def lower(self, state: Any) -> "InLanes":
        """As `jax.jit(...).lower`."""
        first, *_ = jax.eval_shape(self.split, state)
        return dataclasses.replace(self, program=self.program.lower(first, self.shares[0]))

    def compile(self) -> "InLanes":
        """As `jax.stages.Lowered.compile`."""
        return dataclasses.replace(self, program=self.program.compile())

    def memory_analysis(self) -> Any:
        """Of the program of one lane."""
        return self.program.memory_analysis()

    def __call__(self, state: Any) -> Any:
        """What all lanes return, when the last one has."""
        parts = jax.block_until_ready(self.split(state))
        for leaf in jax.tree.leaves(state):
            leaf.delete()
        with ThreadPoolExecutor(len(parts)) as threads:
            done = list(threads.map(self._run, parts, self.shares))
        return self.join(done)

    def _run(self, part: Any, share: Any) -> Any:
        return jax.block_until_ready(self.program(part, share))
