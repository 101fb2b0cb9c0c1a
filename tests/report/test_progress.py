"""Reporters of a run: the terminal, and TensorBoard with a writer that only takes notes."""

import dataclasses
import io
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from csac_jax.report import progress
from csac_jax.training.loop import Record

BLANK = {field.name: 1 for field in dataclasses.fields(Record)}


def _record(actions: int) -> Record:
    return Record(**BLANK | {"actions": actions, "outcomes": {"lifted": 3}, "critic_loss": None})


def test_plain_lines_are_rare_but_the_last_is_there():
    """Claim: without a terminal, a line comes first, then one per PLAIN_INTERVAL, and at the
    end."""
    out = io.StringIO()
    with progress.Terminal(Console(file=out, width=200)) as terminal:
        terminal.say("[bold] stays")
        for actions in (2, 4, 6):
            terminal.progress(_record(actions), 6, 4000.0)
    assert out.getvalue().splitlines() == [
        "[bold] stays",
        *(
            f"{actions} of 6 actions, 1.0/s, grasp success 100% of last 1, warming up, 1:06:40 left"
            for actions in (2, 6)
        ),
        "",
    ]


def test_reporters_pass_everything_on():
    """Claim: each of several reporters gets every line and every record."""
    notes: list[tuple] = []
    one = SimpleNamespace(say=notes.append, progress=lambda *args: notes.append(args))
    both = progress.Reporters([one, one])
    both.say("a")
    both.progress(_record(2), 6, 1.0)
    assert notes == ["a", "a", (_record(2), 6, 1.0), (_record(2), 6, 1.0)]


def test_tensorboard_gets_every_number(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Claim: every number of a record is a scalar over actions, outcomes by name, None left out;
    the first record voids what a killed process wrote after it."""
    notes: list[tuple] = []

    class Writer:
        def __init__(self, folder: str, purge_step: int) -> None:
            notes.append((folder, purge_step))

        def add_scalar(self, *point: object) -> None:
            notes.append(point)

        def flush(self) -> None:
            pass

    monkeypatch.setitem(sys.modules, "tensorboardX", SimpleNamespace(SummaryWriter=Writer))
    board = progress.TensorBoard(tmp_path)
    board.progress(_record(8), 10, 1.0)
    board.progress(_record(9), 10, 1.0)
    first, *points = notes
    assert first == (str(tmp_path / "tensorboard"), 8)
    tags = (BLANK.keys() - {"outcomes", "critic_loss"}) | {"outcomes/lifted"}
    assert {(tag, step) for tag, _, step in points} == {(tag, n) for tag in tags for n in (8, 9)}
    assert ("outcomes/lifted", 3, 9) in points
