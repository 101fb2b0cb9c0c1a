"""The search of settings: equal budgets, and seeds that no result has."""

import inspect
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.errors import SettingsError
from csac_jax.io import configs
from csac_jax.runtime import signals
from csac_jax.sweeps import runner
from csac_jax.sweeps.replicas import group_configs
from csac_jax.training import programs, step
from csac_jax.training.step import Program, TrainState
from experiments import search
from tests.training import toys

CFG = presets.smoke().change(sim={"physics": "c"}, train={"actions": 24})
METHODS = ("grasp_only", "vpg", "csac", "csac_per", "csac_beta")


def test_every_method_has_the_same_budget():
    """Claim: every method tries as many settings with as many seeds: its defaults, then the same
    values, but for what makes it that method; one program serves all of its trials."""
    plan = search.plan(CFG, METHODS, 5, 3)
    runs = runner.runs_of(plan)
    by_method = {algo: [run for run in runs if run.cfg.algo == algo] for algo in METHODS}
    assert {len(own) for own in by_method.values()} == {5 * 3}
    assert search.trials("vpg", 5) == search.trials("csac_beta", 5)
    assert search.trials("vpg", 5)[0] == {}
    for one, other in zip(search.trials("vpg", 5), search.trials("grasp_only", 5), strict=True):
        assert other == {key: value for key, value in one.items() if key != "target.gamma"}
    assert {run.cfg.target.gamma for run in by_method["grasp_only"]} == {0.0}
    assert len({run.cfg.learn.learning_rate for run in by_method["vpg"]}) == 5
    assert len(group_configs([run.cfg for run in runs])) == len(METHODS)


def test_the_task_is_that_of_the_paper():
    """Claim: unless told otherwise, settings are searched for the target task, as in `paper`."""
    task = inspect.signature(search.run).parameters["task"].default
    assert task == presets.paper().task.kind == presets.paper_small().task.kind == "target"


def test_values_fill_their_ranges():
    """Claim: values are drawn over the whole of each range, rates by their logarithm."""
    drawn = search.trials("csac", 400)[1:]
    for name, low, high, middle in (
        ("learn.learning_rate", 1e-4, 3e-3, np.sqrt(1e-4 * 3e-3)),
        ("learn.lr_final_fraction", 0.05, 1.0, np.sqrt(0.05)),
        ("target.gamma", 0.0, 0.8, 0.4),
        ("explore.decay", 0.99, 0.9999, 0.999),
    ):
        values = np.array([one[name] for one in drawn])
        assert low <= values.min()
        assert values.max() <= high
        assert 0.42 < np.mean(values < middle) < 0.58, name  # a binomial's 3 sigma: 0.075


def _train_step(program: Program, state: TrainState):
    """The small step, with grasps that succeed more often for a larger discount."""
    state, metrics = toys.train_step(program, state)
    gamma = program.cfg.target.gamma
    outcome = jnp.where(jnp.abs(state.scenes) < 0.2 + gamma, 4, 2).astype(jnp.int32)
    return state, metrics._replace(outcome=outcome)


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A search of two methods, three settings and two seeds, stopped once; a small step stands in
    for the learner's."""
    monkeypatch.setattr(programs, "make", lambda cfg, *_, **__: toys.program(cfg))
    monkeypatch.setattr(programs, "init_state", toys.init_state)
    monkeypatch.setattr(step, "train_step", _train_step)
    folder, stop = tmp_path / "search", signals.Stop()
    stop.signal = 15
    asked = (CFG, folder, ("vpg", "csac_beta"), 3, 2)
    assert search.search(*asked, stop).stopped_by == 15
    assert not list(folder.glob("vpg.json"))
    stop.signal = None
    assert search.search(*asked, stop).stopped_by is None
    return folder


@pytest.mark.optax
def test_search_records_every_method_and_its_best(searched: Path):
    """Claim: a search, interrupted and gone on with, records for each method what it tried, with
    the area under each curve, and the settings of the largest mean; the result trains those with
    seeds that the search has not used, and refuses the others."""
    found = {record["algo"]: record for record in search.records(searched)}
    assert set(found) == {"vpg", "csac_beta"}
    for algo, record in found.items():
        assert record["budget"] == {"settings": 3, "seeds": [10**6, 10**6 + 1], "actions": 24}
        means = [np.mean(one["areas"]) for one in record["tried"]]
        assert len(set(means)) == 3
        assert record["best"] == record["tried"][int(np.argmax(means))]["settings"]
        log = (searched / f"{algo}-1" / "seed-1000001" / "metrics.jsonl").read_text()
        points = [json.loads(line) for line in log.splitlines()]
        x, y = ([point[name] for point in points] for name in ("actions", "grasp_success"))
        fine = np.linspace(0.0, x[-1], 100_001)
        area = np.mean(np.interp(fine, x, y))  # brute force
        assert record["tried"][1]["areas"][1] == pytest.approx(area, abs=1e-4)

    plan = search.result_plan(list(found.values()), 4, 0, 500)
    assert (plan.seeds, plan.episodes) == (4, 500)
    for point in plan.points:
        best, flat = found[point.name]["best"], configs.flat(configs.to_dict(point.cfg))
        assert (point.cfg.algo, {name: flat[name] for name in best}) == (point.name, best)
    used = {run.cfg.seed for run in runner.runs_of(search.plan(CFG, METHODS, 3, 2))}
    assert not used & {run.cfg.seed for run in runner.runs_of(plan)}
    for first in (10**6 + 1, 10**6 - 3):
        with pytest.raises(SettingsError, match=r"--seed: the search has used seed 1000"):
            search.result_plan(list(found.values()), 4, first, 500)
    with pytest.raises(SettingsError, match="holds another search"):
        search.search(CFG, searched, ("vpg", "csac_beta"), 3, 1, signals.Stop())


@pytest.mark.optax
def test_a_stopped_search_is_judged_by_what_all_have_done(searched: Path):
    """Claim: `record` judges every run by the first actions of its curve, one that did not come so
    far by 0, and keeps where the search was made, not where it is recorded."""
    (searched / "provenance.json").write_text('{"device": "another"}')
    path = searched / "vpg-1" / "seed-1000001" / "metrics.jsonl"
    lines = path.read_text().splitlines()
    search.record(searched, 16)
    before = json.loads((searched / "vpg.json").read_text())
    points = [json.loads(line) for line in lines]
    x, y = ([point[name] for point in points] for name in ("actions", "grasp_success"))
    fine = np.linspace(0.0, 16.0, 100_001)
    area = np.mean(np.interp(fine, x, y))  # brute force
    assert before["tried"][1]["areas"][1] == pytest.approx(area, abs=1e-4)
    assert (before["budget"]["actions"], before["device"]) == (16, "another")
    path.write_text("\n".join(lines[: x.index(8) + 1]) + "\n")
    search.record(searched, 16)
    assert json.loads((searched / "vpg.json").read_text())["tried"][1]["areas"][1] == 0.0
    with pytest.raises(SettingsError, match="--actions"):
        search.record(searched, 25)


@pytest.mark.optax
def test_unequal_budgets_are_refused(searched: Path):
    """Claim: records of methods that tried more settings, or had other seeds, are no comparison."""
    path = searched / "vpg.json"
    record = json.loads(path.read_text())
    record["budget"]["settings"] = 4
    path.write_text(json.dumps(record))
    with pytest.raises(SettingsError, match="methods had different budgets"):
        search.records(searched)
    with pytest.raises(SettingsError, match="holds no finished search"):
        search.records(searched / "vpg-0")


def test_a_lost_run_counts_as_nothing(tmp_path: Path):
    """Claim: a run that was given up, or never grasped, counts with the area 0."""
    plan = search.plan(CFG, ("vpg",), 1, 1)
    (run,) = runner.runs_of(plan)
    folder = tmp_path / run.folder
    folder.mkdir(parents=True)
    (folder / "config.json").write_text('{"seed": 1000000}')
    assert search._area(tmp_path, run, 24) == 0.0
    line = {"step": 4, "actions": 8, "seconds": 1.0, "grasps_counted": 5, "grasp_success": 0.9}
    (folder / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    assert search._area(tmp_path, run, 24) == 0.0
