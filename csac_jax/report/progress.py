"""Progress of a run: a live bar on a terminal, plain lines in a file."""

import time
from collections.abc import Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from csac_jax.training.loop import Record, Reporter

PLAIN_INTERVAL = 10.0  # s between lines where there is no terminal


def describe(record: Record, eta: float) -> str:
    """Speed, success, losses and remaining time `eta`, s, in one line."""
    parts = [f"{record.actions_per_second:.1f}/s"]
    if record.grasp_success is not None:
        parts.append(f"grasp success {record.grasp_success:.0%} of last {record.grasps_counted}")
    if record.critic_loss is not None and record.actor_loss is not None:
        parts.append(f"loss critic {record.critic_loss:.3f} actor {record.actor_loss:.3f}")
    else:
        parts.append("warming up")
    return ", ".join([*parts, f"{_duration(eta)} left"])


def _duration(seconds: float) -> str:
    """As in `1:02:03` or `2:03`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


class Terminal:
    """A reporter with a bar on a terminal, else with a line every PLAIN_INTERVAL. Its `with` ends
    the bar."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bar = Progress(
            TextColumn("actions"),
            MofNCompleteColumn(),
            BarColumn(20),
            TextColumn("{task.description}"),
            console=console,
        )
        self._task: TaskID | None = None
        self._printed_at = -PLAIN_INTERVAL

    def __enter__(self) -> "Terminal":
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def say(self, text: str) -> None:
        """Prints a line above the bar."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def progress(self, record: Record, total_actions: int, eta: float) -> None:
        """Moves the bar; without a terminal, prints a line if one is due."""
        if not self._console.is_terminal:
            self._print_if_due(record, total_actions, eta)
            return
        if self._task is None:
            self._bar.start()
            self._task = self._bar.add_task("", total=total_actions)
        description = describe(record, eta)
        self._bar.update(
            self._task, completed=record.actions, description=description, refresh=True
        )

    def _print_if_due(self, record: Record, total_actions: int, eta: float) -> None:
        now = time.monotonic()
        if now - self._printed_at >= PLAIN_INTERVAL or record.actions >= total_actions:
            self._printed_at = now
            self.say(f"{record.actions} of {total_actions} actions, {describe(record, eta)}")


class Reporters:
    """Several reporters as one."""

    def __init__(self, reporters: Sequence[Reporter]) -> None:
        self._reporters = reporters

    def say(self, text: str) -> None:
        """Passes the line on."""
        for reporter in self._reporters:
            reporter.say(text)

    def progress(self, record: Record, total_actions: int, eta: float) -> None:
        """Passes the record on."""
        for reporter in self._reporters:
            reporter.progress(record, total_actions, eta)
