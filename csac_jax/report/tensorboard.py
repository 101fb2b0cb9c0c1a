"""Progress of a run in TensorBoard. Needs the extra `tensorboard`."""

import dataclasses
from pathlib import Path

from tensorboardX import SummaryWriter

from csac_jax.training.loop import Record


class TensorBoard:
    """A reporter that writes every number of a record as a scalar over actions, into
    RUN/tensorboard."""

    def __init__(self, run_dir: Path) -> None:
        self._folder = run_dir / "tensorboard"
        self._writer: SummaryWriter | None = (
            None  # the run makes its folder before the first record
        )

    def say(self, text: str) -> None:
        """Writes nothing."""

    def progress(self, record: Record, total_actions: int, eta: float) -> None:
        """Writes one point per number. The first record voids later points of a killed process."""
        if self._writer is None:
            self._writer = SummaryWriter(str(self._folder), purge_step=record.actions)
        numbers = dataclasses.asdict(record)
        outcomes = {f"outcomes/{name}": count for name, count in numbers.pop("outcomes").items()}
        for name, number in (numbers | outcomes).items():
            if number is not None:
                self._writer.add_scalar(name, number, record.actions)
        self._writer.flush()
