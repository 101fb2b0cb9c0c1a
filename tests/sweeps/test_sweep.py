"""The host's loop of a sweep, with a tiny program in place of the learner."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.errors import SettingsError
from csac_jax.io import checkpoint, files
from csac_jax.replay import ring
from csac_jax.runtime.signals import Stop
from csac_jax.sweeps import runner
from csac_jax.sweeps.grid import SweepPoint
from csac_jax.sweeps.replicas import ProgramGroup
from csac_jax.sweeps.runner import SweepError, SweepPlan
from csac_jax.training import programs
from tests.training import test_loop
from tests.training.test_loop import CFG, Fake, State

CHUNKS = 6  # of a group
SEEDS = 2


def _point(name: str, **sections: dict[str, Any]) -> SweepPoint:
    return SweepPoint(name, {"x": name}, CFG.change(**sections))


PLAN = SweepPlan(
    SEEDS,
    [_point("a"), _point("b", replay={"sampler": "uniform"}), _point("c", learn={"tau": 0.5})],
)


class Programs:
    """Programs that draw their metrics at random; remembers groups and compilations."""

    def __init__(self, nan_run: int = -1) -> None:
        self.groups: list[ProgramGroup] = []
        self.compiled = 0
        self._nan_run = nan_run

    def __call__(self, group: ProgramGroup) -> SimpleNamespace:
        """Stands in for a `SweepProgram`."""
        self.groups.append(group)
        uniform = 200 * (group.configs[0].replay.sampler == "uniform")
        seeds = [cfg.seed + 100 * (cfg.learn.tau == 0.5) + uniform for cfg in group.configs]

        def init() -> State:
            keys = jnp.stack([jax.random.key(seed) for seed in seeds])
            return State(keys, jnp.int32(0), jnp.zeros((len(seeds), 4)))

        def chunk(num_steps: int):
            self.compiled += 1
            axes: Any = State(key=0, step=None, total=0)
            fail = jnp.arange(len(seeds)) == self._nan_run

            def one(state: State, fails: jax.Array):
                state, metrics = Fake()._step(state, None)
                loss = jnp.where(fails & (state.step > 8), jnp.nan, metrics.critic_loss)
                return state, metrics._replace(critic_loss=loss)

            every = jax.vmap(one, in_axes=(axes, 0), out_axes=(axes, 0))
            return jax.jit(
                lambda state: jax.lax.scan(lambda s, _: every(s, fail), state, length=num_steps)
            )

        def replica(state: State, index: int) -> State:
            return State(state.key[index], state.step, state.total[index])

        parts = {"init": init, "compile_chunk": chunk, "replica": replica}
        return SimpleNamespace(**parts, abstract=lambda: jax.eval_shape(init))


class Listener(test_loop.Listener):
    """Keeps what a sweep reports; sets the stop flag after `stop_after` chunks."""

    def progress(self, record, total_actions, eta) -> None:
        assert total_actions == 72 * SEEDS * len(PLAN.points)
        super().progress(record, 72, eta)


def _run(
    folder: Path, listener: Listener, programs: Programs | None = None, resume: bool = False
) -> runner.SweepResult:
    return runner.run(PLAN, folder, programs or Programs(), listener, listener.stop, resume)


def _runs() -> list[tuple[str, int]]:
    return [(one.name, CFG.seed + k) for one in PLAN.points for k in range(SEEDS)]


def _final(folder: Path) -> dict[tuple[str, int], list[bytes]]:
    """State and log, without what depends on the clock, of every run."""
    found = {}
    for name, seed in _runs():
        path = folder / name / f"seed-{seed}"
        state, _ = checkpoint.restore(path, jax.eval_shape(test_loop._init))
        leaves = (jax.random.key_data(state.key), state.step, state.total)
        log = json.dumps(test_loop._log(path)).encode()
        found[name, seed] = [*(np.asarray(leaf).tobytes() for leaf in leaves), log]
    return found


@pytest.fixture(scope="module")
def uninterrupted(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, Listener, Programs, runner.SweepResult]:
    """A sweep that nobody stopped."""
    folder, listener, programs = tmp_path_factory.mktemp("sweep") / "one", Listener(), Programs()
    return folder, listener, programs, _run(folder, listener, programs)


def test_every_run_is_one_of_train(uninterrupted):
    """Claim: each run has a folder with config, log and checkpoint, as one of `train` has; no
    two are alike."""
    folder, *_ = uninterrupted
    configs = [checkpoint.load_config(folder / name / f"seed-{seed}") for name, seed in _runs()]
    assert configs == list(runner.runs_of(PLAN).values())
    for name, seed in _runs():
        log = test_loop._log(folder / name / f"seed-{seed}")
        assert [line["step"] for line in log] == [4 * n for n in range(1, CHUNKS + 1)]
    found = list(_final(folder).values())
    assert len({one[2] for one in found}) == len(found)


def test_group_is_compiled_once(uninterrupted):
    """Claim: points that differ in numbers are one group, compiled once; the others have their own.
    Of a group that is done the mark alone is left. Lines show actions of all runs of all points."""
    folder, listener, programs, result = uninterrupted
    names = [[cfg.replay.sampler for cfg in group.configs] for group in programs.groups]
    assert names == [[CFG.replay.sampler] * 4, ["uniform"] * 2]
    assert programs.groups[0].hyperparams == ("learn.tau",)
    assert programs.compiled == len(result.compile_seconds) == 2
    left = [path for path in (folder / "groups").rglob("*") if path.is_file()]
    assert sorted(left) == [folder / "groups" / str(k) / "done" for k in range(2)]
    actions = [record.actions for record in listener.records]  # shown a line per chunk
    assert actions == [*range(48, 289, 48), *range(312, 433, 24)]


def test_summary_is_that_of_the_logs(uninterrupted):
    """Claim: the combined file has each point's interquartile mean over the last grasps of its
    seeds, each run's own and where it lies."""
    folder, _, _, result = uninterrupted
    stored = json.loads((folder / "summary.json").read_text())
    assert stored == result.summary
    assert stored["complete"]
    for row, point in zip(stored["settings"], PLAN.points, strict=True):
        logs = [test_loop._log(folder / run["run_dir"])[-1] for run in row["runs"]]
        assert [run["seed"] for run in row["runs"]] == [5, 6]
        rates = [line["grasp_success"] for line in logs]
        assert [run["grasp_success"] for run in row["runs"]] == rates
        success = row["grasp_success"]
        assert success["value"] == pytest.approx(np.mean(rates))
        assert (row["name"], row["values"], success["n"]) == (point.name, point.values, SEEDS)


@pytest.mark.parametrize("moment", [1, CHUNKS, CHUNKS + 2])
def test_stopped_sweep_ends_like_the_uninterrupted(moment: int, uninterrupted, tmp_path: Path):
    """Claim: a sweep stopped after any chunk of any group saves, and the resumed one ends bit for
    bit like the uninterrupted; what is done is not run again."""
    folder = tmp_path / "run"
    listener = Listener(moment)
    assert _run(folder, listener).stopped_by == 2
    assert f"sweep --resume {folder}" in listener.said[-1]
    assert not json.loads((folder / "summary.json").read_text())["complete"]
    programs = Programs()
    again = runner.run(runner.read_plan(folder), folder, programs, Listener(), Stop(), resume=True)
    assert again.stopped_by is None
    assert again.summary == uninterrupted[3].summary
    assert len(programs.groups) == (1 if moment >= CHUNKS else 2)
    assert _final(folder) == _final(uninterrupted[0])
    programs = Programs()
    runner.run(PLAN, folder, programs, Listener(), Stop(), resume=True)
    assert programs.groups == []


def test_interrupted_ending_is_done_again(
    uninterrupted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Claim: a sweep killed while its runs' checkpoints are written ends like the uninterrupted
    once resumed."""
    save, folder = checkpoint.save, tmp_path / "run"

    def killed(path, *rest):
        if path.name == "seed-6":
            (path / "checkpoints" / "24").mkdir(parents=True)
            raise KeyboardInterrupt
        return save(path, *rest)

    monkeypatch.setattr(checkpoint, "save", killed)
    with pytest.raises(KeyboardInterrupt):
        _run(folder, Listener())
    monkeypatch.setattr(checkpoint, "save", save)
    programs = Programs()
    _run(folder, Listener(), programs, resume=True)
    assert _final(folder) == _final(uninterrupted[0])
    assert programs.compiled == 1  # of the group that had not begun


def test_run_without_a_finite_loss_is_given_up(uninterrupted, tmp_path: Path):
    """Claim: a run whose loss is not finite is named, its log ends and it has no checkpoint; the
    others are as they would be without it."""
    folder, listener = tmp_path / "run", Listener()
    result = _run(folder, listener, Programs(nan_run=1))
    assert "a, seed 6: given up at step 12, critic_loss is not finite" in listener.said
    assert [line["step"] for line in test_loop._log(folder / "a" / "seed-6")] == [4, 8]
    assert not (folder / "a" / "seed-6" / "checkpoints").exists()
    first = result.summary["settings"][0]
    assert first["grasp_success"]["n"] == 1
    assert [row["complete"] for row in first["runs"]] == [True, False]
    before = uninterrupted[0] / "a" / "seed-5"
    assert test_loop._log(folder / "a" / "seed-5") == test_loop._log(before)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep that was stopped in its second group."""
    folder = tmp_path_factory.mktemp("stopped") / "run"
    _run(folder, Listener(CHUNKS + 2))
    return folder


@pytest.mark.parametrize("target", ["another sweep", "another part of it"])
@pytest.mark.parametrize(
    "link", ["groups", "groups/1", "groups/1/checkpoints", "b", "b/seed-5", "b/seed-5/checkpoints"]
)
def test_links_below_a_sweep_are_not_followed(stopped: Path, tmp_path: Path, link: str, target):
    """Claim: a link below a sweep, to another sweep or within it, ends it in one line; what the
    link leads to stays as it was."""
    folder, other = tmp_path / "run", tmp_path / "other"
    shutil.copytree(stopped, folder)
    shutil.copytree(stopped, other)
    place = folder / link
    away = place.with_name("away") if target == "another part of it" else other / link
    if place.exists():
        place.rename(place.with_name("away"))
    away.mkdir(exist_ok=True)
    place.symlink_to(away)
    before = _content(away)
    with pytest.raises(files.LinkError, match="is a link; put") as caught:
        runner.run(runner.read_plan(folder), folder, Programs(), Listener(), Stop(), resume=True)
    assert "\n" not in str(caught.value)
    assert _content(away) == before


def _content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "name", ["../victim", "..", ".", "", "/", "a/../../victim", "a\0b", None, 7, "groups"]
)
def test_names_that_lead_elsewhere_are_refused(tmp_path: Path, name: Any):
    """Claim: a sweep.json whose runs would lie elsewhere, or in the sweep's own folders, is refused
    in one line."""
    plan = SweepPlan(2, [SweepPoint(name, {}, CFG)])
    (tmp_path / "sweep.json").write_text(runner.plan_text(plan))
    with pytest.raises(SweepError, match=r"sweep\.json") as caught:
        runner.read_plan(tmp_path)
    assert "\n" not in str(caught.value)


def test_runs_must_fit_together(monkeypatch: pytest.MonkeyPatch):
    """Claim: the replays of a group's runs together, those of points that are numbers included,
    must fit into the devices; else it is said how many would."""
    slot = ring.bytes_needed(1, programs.example(CFG))
    monkeypatch.setattr(runner.memory, "limit", lambda: 4 * CFG.replay.capacity * slot)
    plan = SweepPlan(3, [_point("a"), _point("c", learn={"tau": 0.5})])
    runner.check_room(plan._replace(seeds=2), 1)
    runner.check_room(plan, 2)
    with pytest.raises(SettingsError, match=r"replay\.capacity: .* enough for 4 of 6 runs"):
        runner.check_room(plan, 1)
    runner.check_room(plan._replace(together=4), 1)


def test_together_bounds_a_program(uninterrupted, tmp_path: Path):
    """Claim: no program has more runs than `together`; each run is the same, bit for bit, as side
    by side; the plan in the folder keeps the number, which is not negative."""
    plan, programs = PLAN._replace(together=1), Programs()
    runner.run(plan, tmp_path / "a", programs, Listener(), Stop())
    assert [len(group.configs) for group in programs.groups] == [1] * SEEDS * len(PLAN.points)
    assert _final(tmp_path / "a") == _final(uninterrupted[0])
    assert runner.read_plan(tmp_path / "a") == plan
    with pytest.raises(SettingsError, match="together"):
        runner.check_plan(plan._replace(together=-1))
