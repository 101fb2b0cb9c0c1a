"""Callbacks of a run: trackers, evaluations during training, functions of your own."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from csac_jax.config import Config
from csac_jax.io import configs, files
from csac_jax.runtime import provenance


@dataclasses.dataclass(frozen=True)
class Record:
    """One line of metrics.jsonl: progress of the run, and sums and means of a chunk."""

    step: int  # training steps done
    actions: int  # actions done, over all scenes
    seconds: float  # spent in chunks since the run began, resumed parts included, compilation not
    actions_per_second: float  # of this chunk
    grasp_success: float | None  # share of the last `grasps_counted` grasps that lifted a block
    grasps_counted: int  # min(grasps so far, GRASP_WINDOW); without any, success is None
    pushes: int
    grasps: int
    outcomes: dict[str, int]  # grasps by their outcome
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
    """The end of a run."""

    step: int
    actions: int
    seconds: float  # as in `Record`
    compile_seconds: float  # 0 if nothing was compiled
    grasp_success: float | None  # as in `Record`
    grasps_counted: int
    stopped_by: int | None  # number of the signal; None if the run is complete


class RunInfo(NamedTuple):
    """A run that begins."""

    cfg: Config
    run_dir: Path
    step: int  # training steps done: 0, or that of the checkpoint which is resumed


class Callback:
    """A base for what follows a run; its methods do nothing. Exceptions end the run."""

    def begin(self, run: RunInfo) -> None:
        """Runs before the first chunk; the folder exists."""

    def chunk(self, record: Record, state: Any) -> None:
        """Runs after each chunk. The next chunk overwrites `state`: copy what you keep."""

    def evaluated(self, record: Record, table: dict[str, Any]) -> None:
        """Runs after an evaluation during training; `table` is as of `evaluate`."""

    def end(self, summary: Summary | None) -> None:
        """Runs after the last chunk; no summary if the run has failed."""


class RunRecord(Callback):
    """A callback that writes RUN/train.json: config, device, versions, commit; then the end."""

    def __init__(self) -> None:
        self._begun = time.time()

    def begin(self, run: RunInfo) -> None:
        self._path = run.run_dir / files.RECORD
        self._known = {"config": configs.to_dict(run.cfg), **provenance.record()}
        files.write_json(self._path, {"run_dir": str(run.run_dir), **self._known})

    def end(self, summary: Summary | None) -> None:
        if summary is not None:
            end = {"run_dir": str(self._path.parent), **summary._asdict()}
            seconds = {"wall_seconds": round(time.time() - self._begun, 1)}
            files.write_json(self._path, end | seconds | self._known)


@dataclasses.dataclass
class FunctionCallback(Callback):
    """A function that is called with each chunk's record."""

    call: Callable[[Record], None]

    def chunk(self, record: Record, state: Any) -> None:
        self.call(record)
