"""One process of a sweep, with a small step in place of the learner's.

python -m tests.sweeps.one_process FOLDER STOP_AFTER SHARD [COORDINATOR PROCESSES PROCESS_ID]
"""

import sys
from pathlib import Path

import csac_jax  # noqa: F401  (before JAX)
from csac_jax.io import files
from csac_jax.runtime import cluster
from csac_jax.runtime.signals import Stop
from csac_jax.sweeps import replicas, runner
from csac_jax.sweeps.grid import SweepPoint
from csac_jax.training import programs, sharding, step
from tests.training import toys


class Reporter:
    """A silent reporter that, in the last process, stops the sweep after some chunks."""

    def __init__(self, stop: Stop, after: int) -> None:
        self._stop, self._after = stop, after

    def log(self, text: str) -> None:
        """Ignores a line."""

    def progress(self, record: object, total_actions: int, eta: float | None) -> None:
        """Counts chunks."""
        self._after -= 1
        if self._after == 0:
            self._stop.signal = 15


def main(folder: str, after: str, shard: str, *place: str) -> int:
    """Returns the exit code: 0 if the sweep is done, 15 if it was stopped."""
    if place:
        cluster.join(place[0], int(place[1]), int(place[2]))
    programs.init_state, step.train_step = toys.init_state, toys.train_step
    programs.make = toys.program
    line, stop = sharding.make(None), Stop()
    assert (line is not None) == bool(place)
    plan = runner.SweepPlan(2, [SweepPoint("a", {}, toys.CFG)])
    last = not place or place[2] == "1"
    reporter = Reporter(stop, int(after) if last else 0)
    resume = (Path(folder) / files.SWEEP_PLAN).exists()
    cluster.wait("looked")

    def make_program(group: replicas.ProgramGroup) -> replicas.SweepProgram:
        return replicas.sweep_program(group, line, shard)

    return runner.run(plan, Path(folder), make_program, reporter, stop, resume).stopped_by or 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
