"""Runs side by side in lanes: an equal share of them each, which has the program to itself.

On a GPU with C's physics, a callback in which a program waits, the host moves the scenes of one
lane while the device is at work for another. On a CPU each run is a lane, one after the other:
vmapped, their convolutions would become grouped ones, and a step of four runs would take twice as
long.
"""

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
from jax.sharding import Mesh

from csac_jax.config import Config
from csac_jax.training import memory

_MOST = 2  # ours: lanes on a GPU


def number(cfg: Config, members: int, mesh: Mesh | None = None) -> int:
    """How many lanes so many runs are best in.

    One on several devices, for networks of DenseNet-121, which keep a device busy as they are, and
    where there is no room for the states twice: they are taken apart and put together again.
    """
    if (
        mesh is not None
        or cfg.net.kind != "small"
        or 2 * memory.sure(cfg, members) > memory.limit()
    ):
        return 1
    if jax.default_backend() == "cpu":
        return members
    if cfg.sim.physics != "c":
        return 1
    return max(lanes for lanes in range(1, _MOST + 1) if members % lanes == 0)


@dataclasses.dataclass(frozen=True, eq=False)
class InLanes:
    """In place of a jitted, lowered or compiled function state -> (state, metrics): that of one
    lane, for all of them.

    The state is donated. It may be called once it is compiled.
    """

    program: Any  # jitted, lowered or compiled, of what one lane has of the state and of `shares`
    shares: Sequence[Any]  # what else it is given, of each lane
    split: Callable[
        [Any], Sequence[Any]
    ]  # jitted: a state -> those of the lanes, in memory of their own
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
        at_once = 1 if jax.default_backend() == "cpu" else len(parts)
        with ThreadPoolExecutor(at_once) as threads:
            done = list(threads.map(self._run, parts, self.shares))
        return self.join(done)

    def _run(self, part: Any, share: Any) -> Any:
        return jax.block_until_ready(self.program(part, share))
