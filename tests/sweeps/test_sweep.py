"""The host's side of a sweep, with a tiny program in place of the learner."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.io import checkpoint
from csac_jax.runtime.signals import Stop
from csac_jax.sweeps import sweep
from csac_jax.sweeps.replicas import Engine, Group
from csac_jax.sweeps.sweep import Plan, Setting, SweepError
from tests.training import test_loop
from tests.training.test_loop import CFG, Fake, State

CHUNKS = 6  # of a group
MEMBERS = 2


def _setting(name: str, **sections: dict[str, Any]) -> Setting:
    changed = {
        key: dataclasses.replace(getattr(CFG, key), **fields) for key, fields in sections.items()
    }
    return Setting(name, {"x": name}, dataclasses.replace(CFG, **changed))


PLAN = Plan(
    MEMBERS,
    [
        _setting("a"),
        _setting("b", replay={"sampler": "uniform"}),
        _setting("c", learn={"tau": 0.5}),
    ],
)


class Engines:
    """Programs that draw their metrics at random; remembers groups and compilations."""

    def __init__(self, nan_member: int = -1) -> None:
        self.groups: list[Group] = []
        self.compiled = 0
        self._nan_member = nan_member

    def __call__(self, group: Group) -> Engine:
        self.groups.append(group)
        uniform = 200 * (group.configs[0].replay.sampler == "uniform")
        seeds = [cfg.seed + 100 * (cfg.learn.tau == 0.5) + uniform for cfg in group.configs]

        def init() -> State:
            states = [State(jax.random.key(seed), jnp.int32(0), jnp.zeros(4)) for seed in seeds]
            return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states).replace(
                step=jnp.int32(0)
            )

        def chunk(num_steps: int):
            self.compiled += 1
            axes: Any = State(key=0, step=None, total=0)
            fail = jnp.arange(len(seeds)) == self._nan_member

            def one(state: State, fails: jax.Array):
                state, metrics = Fake()._step(state, None)
                late = fails & (state.step > 8)
                return state, metrics._replace(
                    critic_loss=jnp.where(late, jnp.nan, metrics.critic_loss)
                )

            every = jax.vmap(one, in_axes=(axes, 0), out_axes=(axes, 0))
            return jax.jit(
                lambda state: jax.lax.scan(lambda s, _: every(s, fail), state, length=num_steps)
            )

        def member(state: State, index: int) -> State:
            return State(state.key[index], state.step, state.total[index])

        return Engine(init, lambda: jax.eval_shape(init), chunk, member)


class Listener(test_loop.Listener):
    """Keeps what a sweep reports; sets the stop flag after `stop_after` chunks."""

    def progress(self, record, total_actions, eta) -> None:
        """Reporter."""
        assert total_actions == 72 * MEMBERS * len(PLAN.settings)
        super().progress(record, 72, eta)


def _run(
    folder: Path, listener: Listener, engines: Engines | None = None, resume: bool = False
) -> sweep.Result:
    return sweep.run(PLAN, folder, engines or Engines(), listener, listener.stop, resume)


def _members() -> list[tuple[str, int]]:
    return [(one.name, CFG.seed + k) for one in PLAN.settings for k in range(MEMBERS)]


def _final(folder: Path) -> dict[tuple[str, int], list[bytes]]:
    """State and log, without what depends on the clock, of every member."""
    found = {}
    for name, seed in _members():
        path = folder / name / f"seed-{seed}"
        state, _ = checkpoint.restore(path, jax.eval_shape(test_loop._init))
        leaves = (jax.random.key_data(state.key), state.step, state.total)
        log = json.dumps(test_loop._log(path)).encode()
        found[name, seed] = [*(np.asarray(leaf).tobytes() for leaf in leaves), log]
    return found


@pytest.fixture(scope="module")
def uninterrupted(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, Listener, Engines, sweep.Result]:
    """A sweep that nobody stopped."""
    folder, listener, engines = tmp_path_factory.mktemp("sweep") / "one", Listener(), Engines()
    return folder, listener, engines, _run(folder, listener, engines)


def test_every_member_is_a_run(uninterrupted):
    """Claim: each member has a folder with config, log and checkpoint, as a run of `train` has; no
    two are alike."""
    folder, *_ = uninterrupted
    configs = [checkpoint.load_config(folder / name / f"seed-{seed}") for name, seed in _members()]
    assert configs == [one.cfg for one in sweep.members_of(PLAN)]
    for name, seed in _members():
        log = test_loop._log(folder / name / f"seed-{seed}")
        assert [line["step"] for line in log] == [4 * n for n in range(1, CHUNKS + 1)]
    found = list(_final(folder).values())
    assert len({one[2] for one in found}) == len(found)


def test_group_is_compiled_once(uninterrupted):
    """Claim: settings that differ in numbers are one group, and a group is compiled once; the
    others have their own."""
    _, _, engines, result = uninterrupted
    names = [[cfg.replay.sampler for cfg in group.configs] for group in engines.groups]
    assert names == [[CFG.replay.sampler] * 4, ["uniform"] * 2]
    assert engines.groups[0].numbers == ("learn.tau",)
    assert engines.compiled == len(result.compile_seconds) == 2


def test_groups_make_room(uninterrupted):
    """Claim: once its members are saved, nothing is left of a group but the mark that it is
    done."""
    folder, *_ = uninterrupted
    left = sorted(
        path.relative_to(folder).as_posix()
        for path in (folder / "groups").rglob("*")
        if path.is_file()
    )
    assert left == ["groups/0/done", "groups/1/done"]


def test_progress_is_of_the_whole_sweep(uninterrupted):
    """Claim: a line per chunk, whose actions grow to those of all members of all settings."""
    _, listener, *_ = uninterrupted
    actions = [record.actions for record in listener.records]
    assert actions == [*range(48, 289, 48), *range(312, 433, 24)]


def test_summary_is_that_of_the_logs(uninterrupted):
    """Claim: the combined file has each setting's interquartile mean over the last grasps of its
    seeds, each member's own and where it lies."""
    folder, _, _, result = uninterrupted
    stored = json.loads((folder / "summary.json").read_text())
    assert stored == result.summary
    assert stored["complete"]
    for one, setting in zip(stored["settings"], PLAN.settings, strict=True):
        logs = [test_loop._log(folder / row["run_dir"])[-1] for row in one["members"]]
        assert [row["seed"] for row in one["members"]] == [5, 6]
        assert [row["grasp_success"] for row in one["members"]] == [
            line["grasp_success"] for line in logs
        ]
        success = one["grasp_success"]
        assert success["value"] == pytest.approx(np.mean([line["grasp_success"] for line in logs]))
        assert (one["name"], one["values"], success["n"]) == (setting.name, setting.values, MEMBERS)


@pytest.mark.parametrize("moment", [1, CHUNKS, CHUNKS + 2])
def test_stopped_sweep_ends_like_the_uninterrupted(moment: int, uninterrupted, tmp_path: Path):
    """Claim: a sweep stopped after any chunk of any group saves, and the resumed one ends bit for
    bit like the uninterrupted; what is done is not run again."""
    folder = tmp_path / "run"
    listener = Listener(moment)
    assert _run(folder, listener).stopped_by == 2
    assert f"sweep --resume {folder}" in listener.said[-1]
    assert not json.loads((folder / "summary.json").read_text())["complete"]
    engines = Engines()
    again = sweep.run(sweep.read_plan(folder), folder, engines, Listener(), Stop(), resume=True)
    assert again.stopped_by is None
    assert again.summary == uninterrupted[3].summary
    assert len(engines.groups) == (1 if moment >= CHUNKS else 2)
    assert _final(folder) == _final(uninterrupted[0])
    engines = Engines()
    sweep.run(PLAN, folder, engines, Listener(), Stop(), resume=True)
    assert engines.groups == []


def test_interrupted_ending_is_done_again(
    uninterrupted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Claim: a sweep killed while its members' checkpoints are written ends like the uninterrupted
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
    engines = Engines()
    _run(folder, Listener(), engines, resume=True)
    assert _final(folder) == _final(uninterrupted[0])
    assert engines.compiled == 1  # of the group that had not begun


def test_member_without_a_finite_loss_is_given_up(uninterrupted, tmp_path: Path):
    """Claim: a member whose loss is not finite is named, its log ends and it has no checkpoint; the
    others are as they would be without it."""
    folder, listener = tmp_path / "run", Listener()
    result = _run(folder, listener, Engines(nan_member=1))
    assert "a, seed 6: given up at step 12, a loss is not finite" in listener.said
    assert [line["step"] for line in test_loop._log(folder / "a" / "seed-6")] == [4, 8]
    assert not (folder / "a" / "seed-6" / "checkpoints").exists()
    first = result.summary["settings"][0]
    assert first["grasp_success"]["n"] == 1
    assert [row["complete"] for row in first["members"]] == [True, False]
    before = uninterrupted[0] / "a" / "seed-5"
    assert test_loop._log(folder / "a" / "seed-5") == test_loop._log(before)


def test_bad_folders(tmp_path: Path):
    """Claim: a folder that exists is left alone, one without a sweep or with a damaged one cannot
    be resumed."""
    with pytest.raises(FileExistsError):
        _run(tmp_path, Listener())
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SweepError, match=r"no sweep\.json"):
        sweep.read_plan(tmp_path)
    (tmp_path / "sweep.json").write_text("{")
    with pytest.raises(SweepError, match="cannot be read"):
        sweep.read_plan(tmp_path)


def test_equal_settings_are_refused():
    """Claim: two settings that are the same config are an error before anything starts."""
    with pytest.raises(SweepError, match="same values"):
        sweep.check(Plan(1, [_setting("a"), _setting("b")]))


def test_members_must_fit_together(monkeypatch: pytest.MonkeyPatch):
    """Claim: what the members of a group need together, those of settings that are numbers
    included, must fit into the devices; else it is said how many would."""
    monkeypatch.setattr(sweep.memory, "limit", lambda: 4 * sweep.memory.sure(CFG))
    for seeds, devices, fits in ((2, 1, True), (3, 1, False), (3, 2, True)):  # of two settings
        plan = Plan(seeds, [_setting("a"), _setting("c", learn={"tau": 0.5})])
        if fits:
            sweep.check_room(plan, devices)
        else:
            with pytest.raises(ValueError, match=r"--seeds: 6 members .* enough for 4"):
                sweep.check_room(plan, devices)


def test_networks_of_different_numbers_need_room_at_once(monkeypatch: pytest.MonkeyPatch):
    """Claim: six seeds of DenseNet-121 have their networks at work three at a time, six of
    different numbers all at once, for which there must be room."""
    paper = presets.paper()
    settings = [
        Setting(
            name, {}, dataclasses.replace(paper, learn=dataclasses.replace(paper.learn, tau=tau))
        )
        for name, tau in (("a", 0.1), ("b", 0.2))
    ]
    monkeypatch.setattr(sweep.memory, "limit", lambda: sweep.memory.sure(paper, 6))
    sweep.check_room(Plan(6, settings[:1]), 1)
    with pytest.raises(ValueError, match=r"--seeds: 6 members .* enough for 4"):
        sweep.check_room(Plan(3, settings), 1)


def test_members_on_warp_must_fit_its_contacts():
    """Claim: members side by side share Warp's contacts, so that their scenes together are counted;
    in another physics they are not."""
    sections = {
        "scene": {"mesh_size_jitter": 0.0},
        "train": {"scenes": 40},
        "replay": {"capacity": 64},
    }
    for physics, seeds, devices, fits in (
        ("warp", 102, 1, True),
        ("warp", 103, 1, False),
        ("warp", 103, 2, True),
    ):
        plan = Plan(seeds, [_setting("a", sim={"physics": physics}, **sections)])
        if fits:
            sweep.check_room(plan, devices)
        else:
            with pytest.raises(
                ValueError, match=r"--seeds: 103 members of 40 scenes .* room for 4096 scenes"
            ):
                sweep.check_room(plan, devices)
    sweep.check_room(Plan(103, [_setting("a", sim={"physics": "mjx"}, **sections)]), 1)
