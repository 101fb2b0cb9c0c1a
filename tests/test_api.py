"""The public names of the package, and what `train` and `sweep` do with their arguments."""

import dataclasses
import functools
import importlib
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import csac_jax
from csac_jax import algorithms, api, cli, presets
from csac_jax.agent import actor_critic, values
from csac_jax.agent.actor_critic import LearnerState, Params
from csac_jax.config import Config
from csac_jax.errors import SettingsError
from csac_jax.evaluation import monitor, policies, suites
from csac_jax.io import checkpoint, configs, files, policy_file
from csac_jax.runtime import provenance
from csac_jax.runtime.signals import Stop
from csac_jax.sweeps.replicas import group_configs
from csac_jax.sweeps.runner import SweepResult
from csac_jax.training import own_parts, programs, step
from csac_jax.training.callbacks import Record, Summary
from csac_jax.vision.heightmap import Observation
from tests.networks import learner_state, random_params

PlainNet = importlib.import_module("examples.04_own_network").PlainNet
QLearner = importlib.import_module("examples.05_own_learner").QLearner
SMOKE = presets.smoke().change(sim={"physics": "c"})  # compiles in half of the time

SUMMARY = Summary(4, 8, 1.5, 0.5, None, 0, None)


def test_public_names_exist():
    """Claim: every name of `__all__` is there, `dir` lists them, and no other name exists."""
    for name in csac_jax.__all__:
        assert getattr(csac_jax, name).__doc__, name
    assert set(csac_jax.__all__) < set(dir(csac_jax))
    assert not hasattr(csac_jax, "make_robot")


def test_public_objects_have_short_texts(tiny: str):
    """Claim: the text of a policy, an environment, a state, a suite or a run is one short line."""
    env, learned = csac_jax.make_env(SMOKE), csac_jax.load_policy(tiny)
    state = jax.jit(env.reset)(jax.random.key(0))
    objects = [env, csac_jax.AutoResetEnv(env), state, state.obs, learned]
    objects += [kind(SMOKE) for kind in policies.BASELINES.values()]
    objects += [csac_jax.deploy.CameraPolicy.load(tiny), policies.PlannerPolicy(SMOKE, learned)]
    objects += [
        suites.prepare(SMOKE, "in_distribution", 2),
        api.Run(Path("run"), SMOKE, SUMMARY, {}),
    ]
    assert [text for text in map(repr, objects) if len(text) > 400 or "\n" in text] == []
    assert re.search(r"params=<\d+ arrays, [\d,]+ numbers>", repr(learned))


def _policy(path: Path, cfg: Config) -> Params:
    """Networks that no seed gives, saved as a policy file."""
    params = random_params(cfg, 7)
    policy_file.save(path, params, cfg)
    return params


def _equal(one: Any, other: Any) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(*pair) for pair in pairs)


def _assert_same(one: Any, other: Any) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    assert _equal(one, other)


def _assert_starts_from(state: LearnerState, params: Params, fresh: LearnerState) -> None:
    """`state` has these networks as online and target ones, and all else as a fresh one has it."""
    _assert_same(state.online, params)
    _assert_same(state.target, params)
    assert not _equal(fresh.online.critic, params.critic)
    _assert_same(state.critic_optimiser, fresh.critic_optimiser)
    _assert_same(state.actor_optimiser, fresh.actor_optimiser)
    assert int(state.updates) == 0


def test_task_without_targets_starts_from_a_policy_that_sees_them(tmp_path: Path):
    """Claim: a net that knows both tasks starts the task `clear`, whose net then sees the mask too;
    with all marked, the maps and valid cells are the same."""
    path, both = tmp_path / "policy.safetensors", SMOKE.change(task={"kind": "both"})
    params = _policy(path, both)
    cfg = api.match_networks(SMOKE, path)
    assert cfg == SMOKE.change(net={"mask": True})
    assert not api.match_networks(both, path).net.mask
    start = api.initial_networks(cfg, path)
    assert start is not None
    state, rows = start(learner_state(cfg)), (1, SMOKE.heightmap.size, SMOKE.heightmap.size)
    obs = Observation(jnp.ones((*rows, 3)), jnp.full(rows, 0.05), jnp.ones(rows, bool))
    found, wanted = (
        jax.jit(functools.partial(values.dense_maps, actor_critic.make(one)))(networks, obs)
        for one, networks in ((cfg, state.online), (both, params))
    )
    np.testing.assert_array_equal(found.q, wanted.q)
    np.testing.assert_array_equal(found.valid, wanted.valid)


_DENSENET = {"net": {"kind": "densenet121"}}
_TARGET = {"task": {"kind": "target"}}


@pytest.mark.parametrize(
    "changes",
    [
        {"net": {"growth": 8}},
        {"net": {"colour": False}},
        {"learn": {"critics": 2}} | _TARGET,
        pytest.param(_DENSENET | _TARGET, marks=pytest.mark.slow),
    ],
)
def test_other_networks_are_refused(tmp_path: Path, changes: dict[str, Any]):
    """Claim: networks of other sizes, or of another number, than the config's are a SettingsError
    of one line, before there is a folder."""
    path = tmp_path / "policy.safetensors"
    _policy(path, SMOKE)
    with pytest.raises(SettingsError, match=f"^init {path}: its networks are not") as caught:
        api.train(SMOKE.change(**changes), tmp_path / "run", init=path, verbose=False)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_networks_of_a_policy_can_be_asked_for(tmp_path: Path):
    """Claim: a config takes over a policy's net, its number of critics and whether it has an actor,
    and then starts from it; nothing else changes."""
    given = SMOKE.change(net={"growth": 8}, learn={"critics": 2, "tau": 0.5})
    path = tmp_path / "policy.safetensors"
    params = _policy(path, given)
    cfg = api.match_networks(SMOKE, path)
    assert cfg == SMOKE.change(net={"growth": 8}, learn={"critics": 2})
    start, fresh = api.initial_networks(cfg, path), learner_state(cfg)
    assert start is not None
    _assert_starts_from(start(fresh), params, fresh)


def _saved(run: api.Run) -> step.TrainState:
    state, _ = checkpoint.restore(run.run_dir, programs.abstract_state(run.cfg))
    return state


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[api.Run, list[Record]]:
    """A run, and what its callback was given."""
    records: list[Record] = []
    folder = tmp_path_factory.mktemp("api") / "run"
    return api.train(SMOKE, folder, callbacks=[records.append], verbose=False), records


@pytest.mark.mjx
@pytest.mark.optax
def test_run_is_complete(trained, capsys: pytest.CaptureFixture):
    """Claim: a run returns its folder, config and summary; each chunk's record reaches the
    callbacks. Its own record is that of the command: its end, wall time, config, device, versions
    and commit."""
    run, records = trained
    assert (run.cfg, run.summary.actions, run.summary.stopped_by) == (SMOKE, 64, None)
    assert [record.actions for record in records] == [8 * n for n in range(1, 9)]
    assert capsys.readouterr().out == ""
    assert configs.load_config(run.run_dir / "config.json") == run.cfg
    record = files.read_object(run.run_dir / files.RECORD)
    assert record["run_dir"] == str(run.run_dir)
    assert record["wall_seconds"] >= record["seconds"]
    assert configs.from_dict(record["config"]) == run.cfg
    for known in (run.summary._asdict(), provenance.record()):
        assert {name: record[name] for name in known} == known


@pytest.mark.slow
@pytest.mark.mjx
@pytest.mark.optax
def test_evaluated_run_is_the_same(trained, tmp_path: Path):
    """Claim: evaluations change no bit of a run's end; each is what `evaluate` says of the state
    then; RUN/best is a run like any other."""
    run, _ = trained

    class Tables(csac_jax.Callback):
        def __init__(self) -> None:
            self.tables: dict[int, Any] = {}

        def evaluated(self, record: Record, table: dict[str, Any]) -> None:
            self.tables[record.actions] = table

    seen = Tables()
    plan = {"eval_every": 24, "eval_episodes": 3, "eval_suite": "in_distribution"}
    done = api.train(SMOKE, tmp_path / "run", callbacks=[seen], verbose=False, **plan)
    for part in ("step", "scenes", "learner", "replay"):
        _assert_same(getattr(_saved(done), part), getattr(_saved(run), part))
    assert list(seen.tables) == [24, 48, 64]
    last = csac_jax.evaluate(done.policy, episodes=3, seed=monitor.SEED)
    assert last == seen.tables[64]
    best = max(seen.tables, key=lambda n: (monitor.score_of(seen.tables[n]), -n))
    policy = csac_jax.load_policy(done.run_dir, which="best")
    assert csac_jax.evaluate(policy, episodes=3, seed=monitor.SEED) == seen.tables[best]
    assert policy.params is not None


@pytest.mark.mjx
@pytest.mark.optax
def test_run_starts_from_another(trained, tmp_path: Path):
    """Claim: a run with `init` begins with the last networks of that run, in scenes of its own
    seed, and its optimisers are fresh."""
    run, _ = trained
    cfg, stop = SMOKE.change(seed=1), Stop()
    stop.signal = 15  # before the first chunk: a run saves its first state
    plain, begun = (
        api.train(cfg, tmp_path / name, init=init, stop=stop, verbose=False)
        for name, init in (("plain", None), ("begun", run.run_dir))
    )
    assert (begun.summary.step, begun.summary.stopped_by) == (0, 15)
    fresh, state, last = map(_saved, (plain, begun, run))
    _assert_starts_from(state.learner, last.learner.online, fresh.learner)
    _assert_same(begun.policy.params, run.policy.params)
    _assert_same(state.scenes, fresh.scenes)


@dataclasses.dataclass(frozen=True)
class Newest(csac_jax.Sampler):
    """The newest `share` of the ring."""

    share: float = 0.5

    def sample(self, key: jax.Array, state: Any, progress: jax.Array, num: int) -> csac_jax.Sample:
        share = jnp.int32(self.share * jnp.float32(state.size))
        slots = jax.random.randint(key, (num,), 0, jnp.maximum(share, 1), jnp.int32)
        return csac_jax.Sample(slots, jnp.ones(num))


@pytest.mark.mjx
def test_run_names_its_own_parts(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: a run with a sampler of one's own names it in config, checkpoint and record. It
    resumes with that sampler only, by the command not at all; a run without one takes none."""
    stop, mine = Stop(), Newest()
    stop.signal = 15  # before the first chunk
    quiet: Any = {"stop": stop, "verbose": False}
    run = api.train(SMOKE, tmp_path / "mine", sampler=mine, **quiet)
    api.train(SMOKE, tmp_path / "plain", **quiet)
    name = own_parts.OwnParts(mine).names()
    assert name.startswith(f"sampler {__name__}.Newest(share=0.5) @")
    stored = [configs.load_config(run.run_dir / "config.json"), checkpoint.load_config(run.run_dir)]
    assert [run.cfg.parts, *(cfg.parts for cfg in stored)] == [name] * 3
    assert files.read_object(run.run_dir / files.RECORD)["config"]["parts"] == name
    assert api.train(SMOKE, run.run_dir, resume=True, sampler=mine, **quiet).summary.step == 0
    for folder, other in (("mine", None), ("mine", Newest(0.2)), ("plain", mine)):
        with pytest.raises(SettingsError, match=rf"{folder} was trained with .*; give the same$"):
            api.train(SMOKE, tmp_path / folder, resume=True, sampler=other, **quiet)
    assert cli.main(["train", "--resume", str(run.run_dir)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"these settings are of a run with {name}, none is given" in line


@pytest.mark.slow
@pytest.mark.mjx
@pytest.mark.optax
@pytest.mark.parametrize(
    "own", [{"sampler": Newest()}, {"network": PlainNet()}, {"learner": QLearner()}]
)
def test_sweep_takes_own_parts(tmp_path: Path, own: Any):
    """Claim: a sweep with a part of one's own trains and evaluates it in each seed, beside values
    of settings; every run names it, and the sweep resumes with it only."""
    cfg = SMOKE.change(reward=algorithms.VPG_REWARD)
    vary = {"reward.success_bonus": (0.0, 0.5)}
    asked: Any = {"vary": vary, "run_dir": tmp_path / "sweep", "episodes": 2, "verbose": False}
    summary = api.sweep(cfg, 2, **asked, **own)
    assert summary["complete"]
    names = own_parts.OwnParts(**own).names()
    configured = list((tmp_path / "sweep").glob("*/seed-*/config.json"))
    assert len(configured) == 4
    assert {configs.load_config(path).parts for path in configured} == {names}
    assert len(list((tmp_path / "sweep").glob("*/seed-*/eval.json"))) == 4
    assert files.read_object(tmp_path / "sweep" / files.RECORD)["commit"] == provenance.commit()
    assert api.sweep(cfg, 2, resume=True, **asked, **own) == summary
    with pytest.raises(SettingsError, match=r"^resume: .* is a sweep of other settings, parts"):
        api.sweep(cfg, 2, resume=True, **asked)
    assert cli.main(["sweep", "--resume", str(tmp_path / "sweep")]) == 2


@pytest.fixture
def sweeps(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Any]:
    """What a sweep that trains no run is called with; folders are made in `tmp_path`."""
    called: list[Any] = []

    def run(plan, folder, make_program, reporter, stop, resume=False) -> SweepResult:
        called.append((plan, folder, make_program, stop))
        return SweepResult({"seeds": plan.seeds}, [], None)

    monkeypatch.setattr(api.runner, "run", run)
    monkeypatch.chdir(tmp_path)
    return called


def test_sweep_has_every_combination(sweeps: list[Any], capsys: pytest.CaptureFixture):
    """Claim: `sweep` runs every combination of the values, algorithms before settings, and returns
    the summary; it says which folder it takes, unless told not to. With nothing to vary there is
    one point; folder and stop are the caller's."""
    mine = Stop()
    api.sweep(SMOKE, run_dir="mine", stop=mine, verbose=False)
    ((plan, folder, _, stop),) = sweeps
    assert (plan.seeds, [point.cfg for point in plan.points]) == (4, [SMOKE])
    assert (folder, stop) == (Path("mine"), mine)
    assert capsys.readouterr().out == ""
    sweeps.clear()
    vary = {"learn.tau": (0.1, 0.2), "algo": ("csac", "vpg"), "replay.capacity": (128,)}
    assert api.sweep(SMOKE.change(seed=3), 2, vary) == {"seeds": 2}
    ((plan, folder, _, stop),) = sweeps
    assert (plan.seeds, stop.signal) == (2, None)
    assert folder.parent == Path("runs")
    assert folder.name.startswith("sweep-smoke-20")
    assert f"sweep {folder}" in capsys.readouterr().out
    combinations = [(tau, algo) for tau in (0.1, 0.2) for algo in ("csac", "vpg")]
    assert [point.name for point in plan.points] == [
        f"learn.tau={tau},algo={algo},replay.capacity=128" for tau, algo in combinations
    ]
    for point, (tau, algo) in zip(plan.points, combinations, strict=True):
        assert point.values == {"learn.tau": str(tau), "algo": algo, "replay.capacity": "128"}
        wanted = algorithms.configure(SMOKE.change(seed=3), algo)
        assert point.cfg == wanted.change(learn={"tau": tau}, replay={"capacity": 128})


@pytest.mark.mjx
def test_runs_of_a_sweep_start_from_a_policy(sweeps: list[Any], tmp_path: Path, monkeypatch):
    """Claim: `init` puts a policy's networks into online and target ones of each run of a sweep,
    whose states have an axis of runs, in all groups; the optimisers are those of a fresh run. Parts
    of one's own are in every group's program."""
    mine = Newest()
    params = _policy(tmp_path / "policy.safetensors", SMOKE)
    given = []
    made = api.replicas.sweep_program
    monkeypatch.setattr(api.replicas, "sweep_program", lambda *args: given.append(args))
    api.sweep(SMOKE, 2, init=tmp_path / "policy.safetensors", sampler=mine, verbose=False)
    ((plan, _, make_program, _),) = sweeps
    (group,) = group_configs([dataclasses.replace(plan.points[0].cfg, seed=k) for k in range(2)])
    make_program(group)
    ((asked, mesh, shard, start, own),) = given
    assert (asked, mesh, shard, own) == (group, None, "seeds", own_parts.OwnParts(mine))
    assert made(group, own=own).program.sampler is mine
    states = [learner_state(SMOKE, seed) for seed in range(3)]
    started = start(jax.tree.map(lambda *leaves: jnp.stack(leaves), *states))
    for k, fresh in enumerate(states):
        _assert_starts_from(jax.tree.map(lambda leaf, k=k: leaf[k], started), params, fresh)
    assert api.initial_networks(SMOKE, None) is None
