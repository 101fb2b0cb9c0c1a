"""A run in TensorBoard; needs the extra `tensorboard`."""

import dataclasses
from pathlib import Path

from tensorboardX import SummaryWriter

from csac_jax.training.loop import Record


class TensorBoard:
    """Reporter that writes each number of a record as a scalar over actions, into
    RUN/tensorboard."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._writer: SummaryWriter | None = (
            None  # made with the first record: a new run makes its folder itself
        )

    def say(self, text: str) -> None:
        """Events are not written."""

    def progress(self, record: Record, total_actions: int, eta: float) -> None:
        """Writes one point per number. What a killed process wrote from here on is marked as
        void."""
        if self._writer is None:
            self._writer = SummaryWriter(
                str(self._run_dir / "tensorboard"), purge_step=record.actions
            )
        for name, value in dataclasses.asdict(record).items():
            group = (
                {f"outcomes/{key}": count for key, count in value.items()}
                if isinstance(value, dict)
                else {name: value}
            )
            for tag, number in group.items():
                if number is not None:
                    self._writer.add_scalar(tag, number, record.actions)
        self._writer.flush()
