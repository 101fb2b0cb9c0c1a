"""The benchmark of record: its cells, what is kept, its table."""

import json
import typing

import jax
import numpy as np
import pytest

from csac_jax import cli
from csac_jax.cli import benchmark as command
from csac_jax.evaluation import policies, suites
from csac_jax.report import benchmark


def _share(value: float | None, n: int = 10) -> dict[str, typing.Any]:
    return {"value": value, "low": value, "high": value, "n": 0 if value is None else n}


def _result(grasps: float, **parts: float) -> dict[str, typing.Any]:
    """A result of one part, or of these parts, with this success of grasps."""
    if parts:
        return {"parts": {name: _result(value) for name, value in parts.items()}}
    metrics = dict.fromkeys(benchmark.METRICS, _share(0.5))
    return {**metrics, "grasp_success": _share(grasps), "declutter_rate": _share(None)}


def test_names_of_the_command():
    """Claim: the command names every suite and policy of the benchmark, and each suite is one."""
    assert typing.get_args(command.SuiteName) == tuple(benchmark.EPISODES)
    assert typing.get_args(command.PolicyName) == tuple(benchmark.POLICIES)
    assert benchmark.EPISODES.keys() <= suites.SUITES.keys()
    assert benchmark.PUBLISHED.keys() <= benchmark.EPISODES.keys()


def test_cells():
    """Claim: a share of the episodes, at least one, of each suite and policy; where there are
    targets, of the learned ones that alone which was trained for them, and it nowhere else."""
    every = list(benchmark.cells(1.0))
    assert {cell.suite for cell in every} == benchmark.EPISODES.keys()
    assert all(cell.episodes == benchmark.EPISODES[cell.suite] for cell in every)
    of_targets = {cell.policy for cell in every if cell.suite in ("target", "target_objects")}
    assert of_targets == {"shipped_target", "geometric", "random", "oracle"}
    of_piles = {cell.policy for cell in every if cell.suite == "pile"}
    assert of_piles == benchmark.POLICIES.keys() - {"shipped_target"}
    assert [cell.episodes for cell in benchmark.cells(0.1, ("pile",), ("random",))] == [100]
    assert [cell.episodes for cell in benchmark.cells(1e-9, ("pile",), ("random",))] == [1]


def test_grasps_alone_are_the_shipped_policys():
    """Claim: the policy that never pushes has the networks of the shipped one."""
    alone, shipped = (benchmark.POLICIES[name]() for name in ("shipped_grasp_only", "shipped"))
    assert (alone.cfg.policy.primitive, shipped.cfg.policy.primitive) == ("grasp", "argmax")
    for a, b in zip(*(jax.tree.leaves(policy) for policy in (alone, shipped)), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("policy", ["shipped", "oracle", "shipped_objects"])
def test_tips_go_as_low_for_all(policy: str):
    """Claim: among objects every policy grasps as low as `shipped_objects` learned to; among blocks
    as its config says."""
    trained = policies.load_config("shipped_objects").sim.clearance
    among = {suite: benchmark.Cell(suite, policy, 1).acting() for suite in ("pile", "random10")}
    assert among["pile"].cfg.sim.clearance == trained
    own = policies.load_config(policy if policy.startswith("shipped") else "shipped")
    assert among["random10"].cfg.sim.clearance == own.sim.clearance


def test_the_table_by_hand():
    """Claim: a row for each part, a dash for what has no cases, published numbers below those of
    their suite."""
    results = [
        {"suite": "pile", "policy": "random", "episodes": 7, **_result(0.25)},
        {"suite": "cases", "policy": "oracle", "episodes": 3, **_result(0.0, row=1.0, hole=0.75)},
    ]
    rows = [line.split("|")[1:-1] for line in benchmark.markdown(results).splitlines()[:-2]]
    cells = [[cell.strip() for cell in row] for row in rows]
    assert cells[2][:3] == ["random30", "VPG, 30 blocks (arXiv:1803.09956)", "published"]
    named = {(row[0], row[1]): row[2:] for row in cells[2:]}
    assert named["cases, row", "oracle"][:2] == ["3", "100.0 % (100.0 to 100.0)"]
    assert named["cases, hole", "oracle"][1] == "75.0 % (75.0 to 75.0)"
    assert named["pile", "random"] == [
        "7",
        "25.0 % (25.0 to 25.0)",
        "50.0 % (50.0 to 50.0)",
        "-",
        "0.500 (0.500 to 0.500)",
    ]
    orbit = named["pile", "OrbitGrasp, random view (arXiv:2407.03531)"]
    assert orbit == ["published", "96.7 %", "-", "97.9 %", "-"]
    order = [row[0] for row in cells[2:]]
    assert order.index("pile") > order.index("cases, hole")


def test_the_command_goes_on_where_it_was(
    tmp_path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    """Claim: each cell is measured once, written with its provenance, and the table with it;
    another share, another policy file and a damaged result are measured again."""
    measured = []

    def measure(cell: benchmark.Cell, progress: object) -> dict[str, typing.Any]:
        measured.append(cell)
        if len(measured) == 2:
            raise KeyboardInterrupt
        return {**cell.asked(), **_result(0.9)}

    monkeypatch.setattr(benchmark, "measure", measure)
    monkeypatch.setattr("csac_jax.runtime.cache.enable", lambda: None)
    asked = ["benchmark", "--out", str(tmp_path / "b"), "--suites", "pile", "--policies"]
    both = [*asked, "random", "oracle", "--share", "0.01", "--jobs", "1"]
    assert cli.main(both) == 130
    first = json.loads((tmp_path / "b/pile/random.json").read_text())
    assert (first["episodes"], first["physics"], first["objects"]) == (10, "c", benchmark.OBJECTS)
    assert {"commit", "versions", "seconds"} <= first.keys()
    assert "| pile | random | 10 | 90.0 %" in (tmp_path / "b/benchmark.md").read_text()
    assert json.loads((tmp_path / "b/benchmark.json").read_text())["results"] == [first]
    capsys.readouterr()
    assert cli.main(both) == 0
    assert "1 of 2: random in pile, kept from before" in capsys.readouterr().out
    assert [cell.policy for cell in measured] == ["random", "oracle", "oracle"]
    assert cli.main(both) == 0
    assert len(measured) == 3
    assert cli.main([*asked, "random", "--share", "0.02"]) == 0
    assert measured[3:] == [benchmark.Cell("pile", "random", 20)]
    shipped = tmp_path / "other.safetensors"
    shipped.write_bytes(b"another policy")
    monkeypatch.setitem(benchmark.policy_file.SHIPPED, "shipped", shipped)
    assert cli.main([*asked, "random", "--share", "0.02"]) == 0
    assert len(measured) == 5
    (tmp_path / "b/pile/random.json").write_text('{"suite": "pi')
    assert cli.main([*asked, "random", "--share", "0.02"]) == 0
    assert len(measured) == 6


@pytest.mark.mjx
@pytest.mark.slow
def test_side_by_side_as_one_by_one(tmp_path):
    """Claim: cells that are measured at the same time get the numbers of one after the other."""

    def found(jobs: str) -> list[dict[str, typing.Any]]:
        asked = ["--suites", "pile", "objects_packed", "--policies", "random", "oracle"]
        asked += ["--share", "0.002", "--jobs", jobs, "--out", str(tmp_path / jobs)]
        assert cli.main(["benchmark", *asked]) == 0
        results = json.loads((tmp_path / jobs / "benchmark.json").read_text())["results"]
        return [{name: one[name] for name in ("policy", "counts", "outcomes")} for one in results]

    apart = found("2")
    assert len(apart) == 4
    assert apart == found("1")


@pytest.mark.mjx
@pytest.mark.slow
def test_a_cell_is_the_evaluation():
    """Claim: a cell's result is that of `evaluate` with what acts, its suite and library."""
    from csac_jax.evaluation import rollout

    cell = next(benchmark.cells(0.001, ("pile",), ("random",)))
    result = benchmark.measure(cell)
    other = rollout.evaluate(cell.acting(), "pile", 1, 0, "c", objects=benchmark.OBJECTS)
    assert result == {**cell.asked(), **other}
