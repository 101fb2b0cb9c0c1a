"""A run on the terminal: a live line there, plain lines where the output goes to a file."""

import time
from collections.abc import Sequence
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from csac_jax.training.loop import Record, Reporter

PLAIN_INTERVAL = 10.0  # s between lines where there is no terminal


def text(record: Record, eta: float) -> str:
    """Speed, success, losses and remaining time in one line."""
    parts = [f"{record.actions_per_second:.1f}/s"]
    if record.grasp_success is not None:
        parts.append(f"grasp success {record.grasp_success:.0%} of last {record.grasps_counted}")
    if record.critic_loss is not None and record.actor_loss is not None:
        parts.append(f"loss critic {record.critic_loss:.3f} actor {record.actor_loss:.3f}")
    else:
        parts.append("warming up")
    return ", ".join([*parts, f"{duration(eta)} left"])


def duration(seconds: float) -> str:
    """Hours, minutes and seconds, as in `1:02:03` or `2:03`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


class Terminal:
    """Reporter with a bar if `console` is a terminal, else with a line every `PLAIN_INTERVAL`. Use
    it in a `with`."""

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
        self._shown = -PLAIN_INTERVAL

    def __enter__(self) -> "Terminal":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def say(self, text: str) -> None:
        """Prints a line, above the bar if there is one."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def progress(self, record: Record, total_actions: int, eta: float) -> None:
        """Moves the bar, or prints a line if the last one is some time ago or this is the last
        chunk."""
        if not self._console.is_terminal:
            self._plain(record, total_actions, eta)
            return
        if self._task is None:
            self._bar.start()
            self._task = self._bar.add_task("", total=total_actions)
        self._bar.update(
            self._task, completed=record.actions, description=text(record, eta), refresh=True
        )

    def _plain(self, record: Record, total_actions: int, eta: float) -> None:
        now = time.monotonic()
        if now - self._shown >= PLAIN_INTERVAL or record.actions >= total_actions:
            self._shown = now
            self.say(f"{record.actions} of {total_actions} actions, {text(record, eta)}")


class Group:
    """Several reporters as one."""

    def __init__(self, reporters: Sequence[Reporter]) -> None:
        self._reporters = reporters

    def say(self, text: str) -> None:
        """Passes a line on."""
        for reporter in self._reporters:
            reporter.say(text)

    def progress(self, record: Record, total_actions: int, eta: float) -> None:
        """Passes a chunk's record on."""
        for reporter in self._reporters:
            reporter.progress(record, total_actions, eta)
