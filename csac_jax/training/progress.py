"""A reporter of runs: a live bar on a terminal, plain lines in a file."""

import datetime
import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from csac_jax.training.callbacks import Record

PLAIN_INTERVAL = 10.0  # s between lines where there is no terminal


def _describe(record: Record, eta: float | None) -> str:
    parts = [f"{record.actions_per_second:.1f}/s"]
    if record.grasp_success is not None:
        parts.append(f"grasp success {record.grasp_success:.0%} of last {record.grasps_counted}")
    if record.critic_loss is not None and record.actor_loss is not None:
        parts.append(f"loss critic {record.critic_loss:.3f} actor {record.actor_loss:.3f}")
    else:
        parts.append("warming up")
    if eta is not None:
        parts.append(f"{datetime.timedelta(seconds=round(eta))} left")
    return ", ".join(parts)


class Terminal:
    """Shows a bar on a terminal, else a line every PLAIN_INTERVAL. Its `with` ends the bar."""

    def __init__(self, console: Console) -> None:
        self._console = console
        columns = TextColumn("actions"), MofNCompleteColumn(), BarColumn(20)
        self._bar = Progress(*columns, TextColumn("{task.description}"), console=console)
        self._printed_at = -PLAIN_INTERVAL

    def __enter__(self) -> "Terminal":
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def log(self, text: str) -> None:
        """Prints a line above the bar."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def progress(self, record: Record, total_actions: int, eta: float | None) -> None:
        """Moves the bar; without a terminal, prints a line if one is due. `eta` is the rest, s."""
        text, now, done = _describe(record, eta), time.monotonic(), record.actions
        if self._console.is_terminal:
            if not self._bar.task_ids:
                self._bar.start()
                self._bar.add_task("", total=total_actions)
            task = self._bar.task_ids[0]
            self._bar.update(task, completed=done, description=text, refresh=True)
        elif now - self._printed_at >= PLAIN_INTERVAL or done >= total_actions:
            self._printed_at = now
            self.log(f"{done} of {total_actions} actions, {text}")
