"""What follows a run: trackers, evaluations on the way, and functions of your own."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from csac_jax.config import Config


@dataclasses.dataclass(frozen=True)
class Record:
    """One line of metrics.jsonl: how far the run is, and what a chunk did, in sums and means."""

    step: int  # training steps done
    actions: int  # actions done, over all scenes
    seconds: float  # spent in chunks since the run began, resumed parts included, compilation not
    actions_per_second: float  # of this chunk
    grasp_success: float | None  # share of the last `grasps_counted` grasps that lifted a block
    grasps_counted: int  # min(grasps so far, GRASP_WINDOW); without any, success is None
    pushes: int
    grasps: int
    outcomes: dict[str, int]  # grasps by what came of them
    pushes_better: int  # pushes that made the best grasp worth more
    cleared: int  # blocks taken from the table
    blocks_lost: int  # blocks that left the workspace
    terminated: int  # episodes that ended with a cleared table
    truncated: int  # episodes that were cut off
    reward: float
    gap_disagrees: int  # grasps whose outcome the finger gap alone names differently
    contact_overflow: int  # substeps in which contacts may have been dropped
    physics_diverged: int  # scenes whose physics failed
    unreachable: int  # actions that the robot could not follow, so that nothing moved
    critic_loss: float | None  # None during the warm-up, as the next three
    actor_loss: float | None
    td_error: float | None
    q_mean: float | None


class Summary(NamedTuple):
    """How a run ended."""

    step: int
    actions: int
    seconds: float  # as in `Record`
    compile_seconds: float  # 0 if nothing was compiled
    grasp_success: float | None  # as in `Record`
    grasps_counted: int
    stopped_by: int | None  # number of the signal; None if the run is complete


class RunInfo(NamedTuple):
    """What a callback is told of the run that begins."""

    cfg: Config
    run_dir: Path
    step: int  # training steps done: 0, or that of the checkpoint which is resumed


class Callback:
    """Follows a run; a method that you leave out does nothing. Exceptions end the run."""

    def begin(self, run: RunInfo) -> None:
        """Before the first chunk; the folder is there."""

    def chunk(self, record: Record, state: Any) -> None:
        """After each chunk. The next one uses up `state`, a `TrainState`: copy what you keep."""

    def evaluated(self, record: Record, table: dict[str, Any]) -> None:
        """After an evaluation on the way; `table` is as of `evaluate`."""

    def end(self, summary: Summary | None) -> None:
        """After the last chunk; no summary if the run has failed."""


def joined(callbacks: Sequence[Callback | Callable[[Record], None]]) -> Callback:
    """Several as one, called in their order; a function is called with the record of each chunk."""
    return _Joined([one if isinstance(one, Callback) else _Function(one) for one in callbacks])


class _Function(Callback):
    def __init__(self, call: Callable[[Record], None]) -> None:
        self._call = call

    def chunk(self, record: Record, state: Any) -> None:
        self._call(record)


class _Joined(Callback):
    def __init__(self, callbacks: Sequence[Callback]) -> None:
        self._callbacks = callbacks

    def begin(self, run: RunInfo) -> None:
        for callback in self._callbacks:
            callback.begin(run)

    def chunk(self, record: Record, state: Any) -> None:
        for callback in self._callbacks:
            callback.chunk(record, state)

    def evaluated(self, record: Record, table: dict[str, Any]) -> None:
        for callback in self._callbacks:
            callback.evaluated(record, table)

    def end(self, summary: Summary | None) -> None:
        for callback in self._callbacks:
            callback.end(summary)


SILENT = Callback()  # does nothing
