"""The host loop, with a tiny program in place of the learner."""

import functools
import json
import math
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from csac_jax import presets
from csac_jax.config import Config, TrainConfig
from csac_jax.errors import SettingsError
from csac_jax.io import checkpoint, configs
from csac_jax.io.checkpoint import CheckpointError
from csac_jax.runtime.signals import Stop
from csac_jax.training import loop
from csac_jax.training.callbacks import Record, Summary
from csac_jax.training.loop import TrainingError
from tests.metrics import step_metrics

E = 3
TRAIN = TrainConfig(scenes=E, actions=72, learning_starts=12, chunk=4, save_every=2)
CFG = presets.smoke().change(train=TRAIN, seed=5)  # 24 steps, 6 chunks
LONGER = CFG.change(train={"actions": 96})  # 32 steps, 8 chunks
UNTIMED = ("seconds", "actions_per_second")


@struct.dataclass
class State:
    key: jax.Array
    step: jax.Array
    total: jax.Array


def _init() -> State:
    return State(jax.random.key(CFG.seed), jnp.int32(0), jnp.zeros(4, jnp.float32))


class Fake:
    """A program of random metrics that counts compilations and can fail in several ways."""

    def __init__(self, nan_at=-1, ill_from=99, ill_to=99, lost_at=-1) -> None:
        self.compiled: list[int] = []
        self._nan_at, self._ill, self._lost_at = nan_at, (ill_from, ill_to), lost_at

    def compile_chunk(self, num_steps: int):
        """Stands in for `programs.compile_chunk`, with the program bound."""
        self.compiled.append(num_steps)
        scan = functools.partial(jax.lax.scan, self._step, length=num_steps)
        return jax.jit(lambda state: scan(state), donate_argnums=0)

    def _step(self, state: State, _):
        keys = jax.random.split(jax.random.fold_in(state.key, state.step), 4)
        outcome = jax.random.randint(keys[0], (E,), 0, 5)
        loss = jnp.where(state.step == self._nan_at, jnp.nan, jax.random.uniform(keys[1]))
        ill = (state.step >= self._ill[0]) & (state.step < self._ill[1])
        metrics = step_metrics(
            E,
            loss=loss,
            primitive=jax.random.bernoulli(keys[2], 0.7, (E,)).astype(jnp.int32),
            outcome=outcome,
            cleared=(outcome == 4).astype(jnp.int32),
            reward=outcome.astype(jnp.float32),
            physics_diverged=jnp.arange(E) == jnp.where(ill, 0, E),
            learned=state.step >= 4,
            finite=state.step != self._lost_at,
        )
        total = state.total + jax.random.normal(keys[3], (4,))
        return State(state.key, state.step + 1, total), metrics


class Listener:
    """Keeps what a run of `total` actions reports; sets the stop flag after `stop_after` chunks."""

    def __init__(self, stop_after: int | None = None, signal: int = 2, total: int = 72) -> None:
        self.stop, self.said, self.records, self.etas = Stop(), [], [], []
        self._stop_after, self._signal, self._total = stop_after, signal, total
        if stop_after == 0:
            self.stop.signal = signal

    def log(self, text: str) -> None:
        self.said.append(text)

    def progress(self, record: Record, total_actions: int, eta: float | None) -> None:
        assert total_actions == self._total
        assert eta is None or eta >= 0.0
        self.records.append(record)
        self.etas.append(eta)
        if len(self.records) == self._stop_after:
            self.stop.signal = self._signal


def _run(
    run_dir: Path, listener: Listener, fake: Fake, resume: bool = False, cfg: Config = CFG
) -> Summary:
    return loop.run(cfg, run_dir, _init, fake.compile_chunk, listener, listener.stop, resume)


def _final(run_dir: Path) -> list[bytes]:
    state, _ = checkpoint.restore(run_dir, jax.eval_shape(_init))
    leaves = (jax.random.key_data(state.key), state.step, state.total)
    return [np.asarray(leaf).tobytes() for leaf in leaves]


def _log(run_dir: Path) -> list[dict]:
    """The log without what depends on the clock."""
    lines = [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name not in UNTIMED} for line in lines]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an uninterrupted run."""
    run_dir = tmp_path_factory.mktemp("whole") / "run"
    _run(run_dir, Listener(), Fake())
    return run_dir


def test_run_ends_complete(tmp_path: Path):
    """Claim: a run takes its actions, compiles once, logs a line per chunk, and saves its end. The
    time left is not said of the first chunk, which may have waited."""
    listener, fake = Listener(), Fake()
    summary = _run(tmp_path / "a/run", listener, fake)
    assert (summary.step, summary.actions, summary.stopped_by) == (24, 72, None)
    assert fake.compiled == [4]
    assert [line["step"] for line in _log(tmp_path / "a/run")] == [4, 8, 12, 16, 20, 24]
    assert checkpoint.latest_step(tmp_path / "a/run") == 24
    assert json.loads((tmp_path / "a/run/config.json").read_text())["seed"] == 5
    assert any("compiled in" in text for text in listener.said)
    assert listener.etas[0] is None
    assert None not in listener.etas[1:]


def test_saves_on_the_way(tmp_path: Path):
    """Claim: steps are rounded up to whole chunks; every `save_every` chunks a run saves."""
    assert loop.total_steps(CFG.change(train={"actions": 73})) == 28
    saved, listener = [], Listener()
    listener.progress = lambda *_: saved.append(checkpoint.latest_step(tmp_path / "run"))
    _run(tmp_path / "run", listener, Fake())
    assert saved == [None, None, 8, 8, 16, 16]  # as seen before the save of the same chunk


@pytest.mark.parametrize("stop_after", [0, 1, 5, 6])
def test_resumed_run_ends_as_the_uninterrupted_one(tmp_path: Path, whole: Path, stop_after: int):
    """Claim: a run that is stopped and resumed ends bit for bit as one that is not, with the same
    log but for times."""
    first = Listener(stop_after, signal=15)
    summary = _run(tmp_path / "run", first, Fake())
    assert (summary.step, summary.stopped_by) == (4 * stop_after, 15)
    assert first.stop.exit_code == 143
    assert checkpoint.latest_step(tmp_path / "run") == 4 * stop_after
    assert "stopped and saved" in first.said[-1]
    second = Listener()
    summary = _run(tmp_path / "run", second, Fake(), resume=True)
    assert (summary.step, summary.stopped_by) == (24, None)
    assert _final(tmp_path / "run") == _final(whole)
    assert _log(tmp_path / "run") == _log(whole)
    fake = Fake()  # a complete run compiles nothing
    assert _run(tmp_path / "run", Listener(), fake, resume=True).step == 24
    assert (fake.compiled, _final(tmp_path / "run")) == ([], _final(whole))


def test_lines_newer_than_the_checkpoint_are_dropped(tmp_path: Path, whole: Path):
    """Claim: after a kill, lines of the log newer than the checkpoint, and a half-written one, are
    written again; `seconds` counts resumed parts too."""
    before = _run(tmp_path / "run", Listener(2), Fake()).seconds
    log = tmp_path / "run/metrics.jsonl"
    newer = {**_log(tmp_path / "run")[-1], "step": 12, "actions": -1, "seconds": 9.0}
    log.write_text(log.read_text() + json.dumps(newer) + '\n{"step": 16, "act')
    listener = Listener()
    _run(tmp_path / "run", listener, Fake(), resume=True)
    assert _log(tmp_path / "run") == _log(whole)
    seconds = [record.seconds for record in listener.records]
    assert [round(before, 3), *seconds] == sorted([round(before, 3), *seconds])


@pytest.mark.parametrize(
    ("fault", "step", "message"),
    [
        ("nan_at", 9, "critic_loss is not finite.*step 8 is kept.*learning_rate"),
        ("lost_at", 2, "a parameter is not finite"),  # in the warm-up
    ],
)
def test_what_is_not_finite_stops_the_run(tmp_path: Path, fault: str, step: int, message: str):
    """Claim: a loss or parameter that is not finite ends the run with one line; the last good
    checkpoint stays the newest."""
    with pytest.raises(TrainingError, match=message) as caught:
        _run(tmp_path / "run", Listener(), Fake(**{fault: step}))
    assert "\n" not in str(caught.value)
    assert checkpoint.latest_step(tmp_path / "run") == ((step // 8) * 8 or None)
    assert all(math.isfinite(line["reward"]) for line in _log(tmp_path / "run"))


def test_loss_of_the_warm_up_does_not_count(tmp_path: Path):
    """Claim: before the first update there is no loss: it may be NaN, and none is logged."""
    listener = Listener(2)
    _run(tmp_path / "run", listener, Fake(nan_at=2))
    assert listener.records[0].critic_loss is None
    assert listener.records[1].critic_loss is not None


def test_warnings_come_once(tmp_path: Path):
    """Claim: physics that fails again and again is logged once, a single failure not at all; the
    build of Warp's kernels is announced, and that MJX compiles long on a CPU."""
    mjx = CFG.change(sim={"physics": "mjx"})
    warp = CFG.change(scene={"size_jitter": (0.1, 0.0)}, sim={"physics": "warp"})
    cases: Any = (
        ("many", Fake(ill_from=5), CFG, "physics failed", 1),
        ("one", Fake(ill_from=5, ill_to=6), CFG, "physics failed", 0),
        ("warp", Fake(), warp, "Warp builds its kernels", 1),
        ("mjx", Fake(), mjx, "Warp builds its kernels", 0),
        ("slow", Fake(), mjx, "MJX compiles for minutes on a CPU", 1),
    )
    for name, fake, cfg, text, times in cases:
        listener = Listener()
        _run(tmp_path / name, listener, fake, cfg=cfg)
        assert sum(text in line for line in listener.said) == times, name
        counted = sum(record.physics_diverged for record in listener.records)
        assert name != "one" or counted == 1


def test_bad_folders(tmp_path: Path):
    """Claim: a new run never writes into a folder that exists; one without a checkpoint cannot be
    resumed."""
    for resume, error in ((False, FileExistsError), (True, CheckpointError)):
        with pytest.raises(error):
            _run(tmp_path, Listener(), Fake(), resume=resume)
        assert resume or list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("stop_after", [3, None])
def test_resumed_with_more_actions_ends_as_the_longer_run(tmp_path: Path, stop_after: int):
    """Claim: a stopped or complete run that is resumed with more `train.actions` ends bit for bit
    as one that had them from the start; its folder holds the new number, and can be resumed."""
    _run(tmp_path / "whole", Listener(total=96), Fake(), cfg=LONGER)
    run_dir = tmp_path / "run"
    _run(run_dir, Listener(stop_after), Fake())
    second = Listener(5, total=96)
    _run(run_dir, second, Fake(), resume=True, cfg=LONGER)
    summary = _run(run_dir, Listener(total=96), Fake(), resume=True, cfg=LONGER)
    assert (summary.step, summary.actions, summary.stopped_by) == (32, 96, None)
    assert _final(run_dir) == _final(tmp_path / "whole")
    assert _log(run_dir) == _log(tmp_path / "whole")
    assert checkpoint.load_config(run_dir) == LONGER
    assert configs.from_dict(json.loads((run_dir / "config.json").read_text())) == LONGER


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"learn": {"tau": 0.5}, "train": {"actions": 96}}, "learn.tau"),
        ({"train": {"actions": 60}}, "train.actions"),
        ({"train": {"actions": 96, "save_every": 3}}, "train.save_every"),
        ({"seed": 6, "replay": {"sampler": "uniform"}}, "seed, replay.sampler, replay.end"),
    ],
)
def test_resume_needs_the_same_config(tmp_path: Path, changes: dict[str, Any], named: str):
    """Claim: a run is resumed with its own config and no fewer actions; the message names, in one
    line, what differs, and the run is left as it was."""
    run_dir = tmp_path / "run"
    _run(run_dir, Listener(1), Fake())
    before = _final(run_dir), _log(run_dir), (run_dir / "config.json").read_text()
    fake = Fake()
    with pytest.raises(SettingsError, match=rf"other values of {re.escape(named)}") as caught:
        _run(run_dir, Listener(), fake, resume=True, cfg=CFG.change(**changes))
    assert "\n" not in str(caught.value)
    assert fake.compiled == []
    assert (_final(run_dir), _log(run_dir), (run_dir / "config.json").read_text()) == before


def test_success_is_over_the_last_200_grasps():
    """Claim: grasp success is over the last 200 grasps, pushes not counted, oldest dropped
    first."""
    before = loop.LoopState(0.0, [1] * 150 + [0] * 49)  # 199 grasps
    done = zip([1, 0, 1, 1], [4, 4, 3, 4], strict=True)  # primitive and outcome of one scene
    steps = [step_metrics(1, primitive=np.array([a]), outcome=np.array([b])) for a, b in done]
    metrics = jax.tree.map(lambda *leaves: np.stack(leaves), *steps)
    after, record = loop.record_chunk(CFG, 4, metrics, before, 0.5)
    assert after.grasps == [1] * 148 + [0] * 49 + [1, 0, 1]
    assert (record.grasp_success, record.grasps_counted) == (150 / 200, 200)
    assert (record.pushes, record.grasps) == (1, 3)
    assert record.outcomes == {"nothing": 0, "empty": 0, "touched": 0, "dropped": 1, "lifted": 2}
    assert (record.seconds, record.actions_per_second) == (0.5, 8.0)
