"""The reporter of a run: the terminal."""

import dataclasses
import io

from rich.console import Console

from csac_jax.training import progress
from csac_jax.training.callbacks import Record

BLANK = {field.name: 1 for field in dataclasses.fields(Record)}


def _record(actions: int) -> Record:
    return Record(**BLANK | {"actions": actions, "outcomes": {"lifted": 3}, "critic_loss": None})


def test_plain_lines_are_rare_but_the_last_is_there():
    """Claim: without a terminal, a line comes first, then one per PLAIN_INTERVAL, and at the
    end; the time left is said where it is known."""
    out = io.StringIO()
    with progress.Terminal(Console(file=out, width=200)) as terminal:
        terminal.log("[bold] stays")
        for actions in (2, 4, 6):
            terminal.progress(_record(actions), 6, 4000.0 if actions > 2 else None)
    assert out.getvalue().splitlines() == [
        "[bold] stays",
        "2 of 6 actions, 1.0/s, grasp success 100% of last 1, warming up",
        "6 of 6 actions, 1.0/s, grasp success 100% of last 1, warming up, 1:06:40 left",
        "",
    ]
