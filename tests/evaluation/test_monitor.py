"""Evaluations on the way, in the host loop with a tiny program and scripted scores."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from csac_jax import presets
from csac_jax.config import Config
from csac_jax.errors import DataWarning, SettingsError
from csac_jax.evaluation import monitor, policies
from csac_jax.evaluation.monitor import EvalPlan, Monitor
from csac_jax.io import checkpoint, files
from csac_jax.io.checkpoint import CheckpointError
from csac_jax.runtime.signals import Stop
from csac_jax.training import loop
from csac_jax.training.callbacks import Callback, Record, RunInfo, Summary
from tests.metrics import step_metrics

E = 8
CFG = presets.smoke().change(train={"scenes": E, "actions": 20 * E})  # 5 chunks of 4 steps
UNTIMED = ("seconds", "actions_per_second")


@struct.dataclass
class State:
    """A state like a run's, small."""

    key: jax.Array
    step: jax.Array
    learner: jax.Array


class Notes(Callback):
    """Keeps what it is told, and the states of all chunks; stops the run after some."""

    def __init__(self, stop_after: int = 99) -> None:
        self.stop, self._stop_after, self.states = Stop(), stop_after, {}
        self.begun, self.tables, self.ends, self.lines = [], [], [], []

    def begin(self, run: RunInfo) -> None:
        self.begun.append(run)

    def chunk(self, record: Record, state: Any) -> None:
        self.states[record.step] = jax.device_get(state.learner)
        if len(self.states) == self._stop_after:
            self.stop.signal = 15

    def evaluated(self, record: Record, table: dict[str, Any]) -> None:
        self.tables.append((record.actions, table))

    def end(self, summary: Summary | None) -> None:
        self.ends.append(summary)

    def log(self, text: str) -> None:
        self.lines.append(text)

    def progress(self, record: Record, total_actions: int, eta: float | None) -> None:
        """Reporter."""


def _table(completion: float, success: float | None) -> dict[str, Any]:
    values = {"completion": completion, "grasp_success": success}
    return {name: {"value": value} for name, value in values.items()} | {"counts": {"grasps": 4}}


@pytest.fixture
def scores(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """The tables of the evaluations to come, in place of episodes."""
    given: list[Any] = []
    monkeypatch.setattr(monitor.suites, "prepare", lambda *_, **__: None)
    monkeypatch.setattr(monitor.rollout, "evaluate", lambda *_: given.pop(0))
    yield given
    assert given == []


def _first() -> State:
    return State(jax.random.key(0), jnp.int32(0), jnp.zeros(4))


def _step(state: State, _: None) -> tuple[State, Any]:
    noise = jax.random.normal(jax.random.fold_in(state.key, state.step), (4,))
    metrics = step_metrics(E, loss=jnp.abs(noise[0]), reward=jnp.full(E, noise[1]))
    return State(state.key, state.step + 1, state.learner + noise), metrics


def _chunk(num: int) -> Any:
    return jax.jit(lambda state: jax.lax.scan(_step, state, length=num), donate_argnums=0)


def _run(
    folder: Path, notes: Notes, *others: Callback, every: int = 64, cfg: Config = CFG, **more: Any
) -> Summary:
    """A run of the tiny program, evaluated if `every`."""
    called = [notes, *others]
    if every:
        called.append(Monitor(cfg, EvalPlan(every), lambda state: state, [notes], notes.log))
    return loop.run(cfg, folder, _first, _chunk, notes, notes.stop, callbacks=called, **more)


def _log(path: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return [{name: value for name, value in line.items() if name not in UNTIMED} for line in lines]


def _best(folder: Path) -> Any:
    return checkpoint.restore(folder / "best", jax.eval_shape(_first))[0]


def test_evaluations_come_in_time_and_the_best_is_kept(tmp_path: Path, scores: list[Any]):
    """Claim: there is one at the first chunk after every so many actions, and after the last; the
    state of the best by completion, then by grasp success, lies in RUN/best."""
    tables = [_table(0.5, 0.5), _table(0.5, 0.6), _table(0.5, 0.6)]
    scores += tables
    notes = Notes()
    summary = _run(tmp_path / "run", notes)
    assert notes.tables == list(zip((64, 128, 160), tables, strict=True))
    assert notes.begun == [RunInfo(CFG, tmp_path / "run", 0)]
    assert notes.ends == [summary]
    log = _log(tmp_path / "run" / "evaluations.jsonl")
    assert [(line["step"], line["best"]) for line in log] == [(8, True), (16, True), (20, False)]
    assert [line["table"] for line in log] == tables
    jax.tree.map(np.testing.assert_array_equal, _best(tmp_path / "run").learner, notes.states[16])
    assert sum(line.endswith("the best so far") for line in notes.lines) == 2


def test_run_is_what_it_is_without_evaluations(tmp_path: Path, scores: list[Any]):
    """Claim: the log and the last state of a run are the same bits with and without evaluations."""
    scores += [_table(0.1 * n, 0.0) for n in range(5)]
    plain, watched = Notes(), Notes()
    _run(tmp_path / "plain", plain, every=0)
    _run(tmp_path / "watched", watched, every=32)
    assert _log(tmp_path / "plain/metrics.jsonl") == _log(tmp_path / "watched/metrics.jsonl")
    jax.tree.map(np.testing.assert_array_equal, plain.states, watched.states)


def test_a_best_state_that_is_a_link_is_refused(tmp_path: Path, scores: list[Any]):
    """Claim: a resumed run neither continues nor sets aside the best state of another run, and
    nobody loads it from there."""
    scores += [_table(0.7, 0.9), _table(0.7, 0.9)]
    for name in ("one", "two"):
        _run(tmp_path / name, Notes(stop_after=2))
    best, other = tmp_path / "one" / "best", tmp_path / "two" / "best"
    best.rename(tmp_path / "away")
    best.symlink_to(other)
    before = sorted(other.rglob("*"))
    with pytest.raises(files.LinkError, match="best is a link"):
        _run(tmp_path / "one", Notes(), resume=True)
    with pytest.raises(files.LinkError, match="best is a link"):
        policies.load(tmp_path / "one", which="best")
    assert sorted(other.rglob("*")) == before


def test_resumed_run_keeps_the_best(tmp_path: Path, scores: list[Any]):
    """Claim: a resumed run goes on from the score of its best; only a better one replaces it."""
    scores += [_table(0.7, 0.9), _table(0.7, 0.8), _table(0.1, 1.0)]
    _run(tmp_path / "run", Notes(stop_after=3))
    again = Notes()
    _run(tmp_path / "run", again, resume=True)
    assert [actions for actions, _ in again.tables] == [128, 160]
    assert int(_best(tmp_path / "run").step) == 8
    best = [line["best"] for line in _log(tmp_path / "run/evaluations.jsonl")]
    assert best == [True, False, False]


def test_best_of_a_future_that_is_undone_is_set_aside(tmp_path: Path, scores: list[Any]):
    """Claim: a run that goes back to an earlier step forgets evaluations after it, and the best of
    them is no longer the best; it is moved, not removed."""
    scores += [_table(0.3, 0.3), _table(0.9, 0.9), _table(0.4, 0.4), _table(0.4, 0.4)]
    cfg = CFG.change(train={"save_every": 1})
    _run(tmp_path / "run", Notes(stop_after=4), every=32 * 2, cfg=cfg)
    folder = tmp_path / "run"
    (folder / "checkpoints" / "16").rename(tmp_path / "gone")  # 12 is the last sound one
    scores[:] = [_table(0.4, 0.4), _table(0.2, 0.4)]
    _run(folder, Notes(), resume=True, cfg=cfg)
    assert [line["step"] for line in _log(folder / "evaluations.jsonl")] == [8, 16, 20]
    assert checkpoint.load_extra(folder / "best")["score"] == [0.4, 0.4]
    assert (folder / "best/checkpoints/set-aside/16").is_dir()


def test_score_is_the_mean_of_the_parts():
    """Claim: of a suite with parts their mean counts; a part without a grasp counts 0."""
    parts = {"parts": {"a": _table(1.0, 0.5), "b": _table(0.5, None)}}
    assert monitor.score_of(parts) == (0.75, 0.25)
    assert monitor.score_of(_table(0.2, 0.4)) == (0.2, 0.4)


def test_plan_is_that_of_the_run(tmp_path: Path, scores: list[Any]):
    """Claim: the folder of a run says how it was evaluated; one that was not says so."""
    scores += [_table(0.0, 0.0)]
    assert monitor.read_plan(tmp_path) is None
    _run(tmp_path / "run", Notes(), every=1000)
    assert monitor.read_plan(tmp_path / "run") == EvalPlan(1000)


@pytest.mark.parametrize("text", ["{", "[]", '{"every": "x"}', '{"every": 0}', '{"each": 3}'])
def test_damaged_plan_is_named(tmp_path: Path, text: str):
    """Claim: a damaged plan is one line with the remedy."""
    (tmp_path / monitor.PLAN).write_text(text)
    with pytest.raises(SettingsError, match=r"evaluation\.json is damaged .*remove it") as caught:
        monitor.read_plan(tmp_path)
    assert "\n" not in str(caught.value)


def test_damaged_best_does_not_stop_a_run(tmp_path: Path, scores: list[Any]):
    """Claim: a resumed run whose best is damaged says so, sets it aside and goes on."""
    scores += [_table(0.7, 0.9), _table(0.1, 0.1), _table(0.0, 1.0)]
    _run(tmp_path / "run", Notes(stop_after=2))
    (tmp_path / "run/best/checkpoints/8" / checkpoint.MANIFEST).unlink()
    with pytest.warns(DataWarning, match="the next evaluation is the best"):
        _run(tmp_path / "run", Notes(), resume=True)
    assert checkpoint.load_extra(tmp_path / "run/best")["score"] == [0.1, 0.1]
    assert (tmp_path / "run/best/checkpoints/set-aside/8").is_dir()


def test_failed_run_tells_its_callbacks(tmp_path: Path):
    """Claim: callbacks are told of the end of a run that fails, with no summary."""
    notes = Notes()

    class Failing(Callback):
        def chunk(self, record: Record, state: Any) -> None:
            raise CheckpointError("no room")

    with pytest.raises(CheckpointError):
        _run(tmp_path / "run", notes, Failing(), every=0)
    assert notes.ends == [None]


@pytest.mark.parametrize("plan", [EvalPlan(0), EvalPlan(8, episodes=0), EvalPlan(8, "nowhere")])
def test_plan_that_cannot_be_is_refused(plan: EvalPlan):
    """Claim: numbers below 1 and an unknown suite are a ValueError of one line."""
    with pytest.raises(ValueError, match=r"at least 1|neither a case file") as caught:
        plan.check()
    assert "\n" not in str(caught.value)
