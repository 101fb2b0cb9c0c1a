"""`csac-jax eval` over several suites."""

import json
import pickle
import sys
from pathlib import Path
from typing import Any

import pytest

from csac_jax import cli
from csac_jax.cli import evaluate
from csac_jax.errors import SettingsError
from csac_jax.evaluation import policies, rollout, suites
from csac_jax.report import suite_table

METRIC = {"value": 0.5, "low": 0.25, "high": 0.75, "n": 8}
NO_CASES = {"value": None, "low": None, "high": None, "n": 0}
TABLE = {**dict.fromkeys(suite_table.METRICS, METRIC), "declutter_rate": NO_CASES}


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Suites and episodes that are measured, in place of measuring them."""
    calls: list[tuple[str, int]] = []

    def measure(
        on_progress: Any, options: Any, changes: Any, suite: str, episodes: int, *_: Any
    ) -> dict[str, Any]:
        calls.append((suite, episodes))
        if len(calls) == 2:
            raise KeyboardInterrupt
        return {"policy": "random", "suite": suite, "episodes": episodes, "seconds": 0.1, **TABLE}

    monkeypatch.setattr(evaluate, "_measure", measure)
    return calls


def test_suites_are_measured_once(
    tmp_path: Path, measured: list[tuple[str, int]], capsys: pytest.CaptureFixture
):
    """Claim: an evaluation that was stopped goes on where it was; another share, other settings and
    a damaged or changed result are measured again; the table has all suites."""
    out = tmp_path / "out"
    command = ["eval", "shipped", "--policy", "random", "--out", str(out), "--jobs", "1"]
    both = [*command, "--suites", "cases", "random10", "--share", "0.01"]
    assert cli.main(both) == 130
    assert cli.main(both) == 0
    assert "cases, kept from before" in capsys.readouterr().out
    assert measured == [("cases", 2), ("random10", 5), ("random10", 5)]
    row = "| random10 | random | 5 | 50.0 % (25.0 to 75.0) | 50.0 % (25.0 to 75.0) | - |"
    assert row in (out / evaluate.TABLE).read_text()
    for change in (["--share", "0.02"], ["--seed", "1"], ["--sim.clearance", "0.004"]):
        before = len(measured)
        assert cli.main([*both, *change]) == 0
        assert len(measured) == before + 2
    before = len(measured)
    (out / "cases.json").write_text('{"suite": "ca')
    assert cli.main([*both, *change]) == 0
    assert [suite for suite, _ in measured[before:]] == ["cases"]
    changed = (out / "cases.json").read_text().replace('"seconds": 0.1', '"seconds": 0.2')
    (out / "cases.json").write_text(changed)
    assert cli.main([*both, *change]) == 0
    assert [suite for suite, _ in measured[before + 1 :]] == ["cases"]


def test_all_suites_are_those_that_fit(tmp_path: Path, measured: list[tuple[str, int]]):
    """Claim: `--suites all` leaves out suites with targets for a policy trained without, those
    without targets for one trained with, none of these for one trained in both tasks, and suites of
    objects where there is no library."""
    clear, both = (policies.load_config(name) for name in ("shipped_clutter", "shipped"))
    options = evaluate.EvalOptions("shipped_clutter")
    of_blocks = {name for name, one in suites.SUITES.items() if not (one.target or one.objects)}
    assert {*evaluate._fitting(options, clear)} == of_blocks >= {"random10", "cases", "camera"}
    with_objects = evaluate.EvalOptions("shipped_clutter", objects="procedural:0:20")
    assert "pile" in evaluate._fitting(with_objects, clear)
    assert evaluate._fitting(with_objects, clear.change(task={"kind": "target"})) == (
        "target",
        "target_objects",
        "enclosed",
        "hidden",
    )
    assert {*evaluate._fitting(options, both)} == set(suites.SUITES)
    anyone = evaluate.EvalOptions("shipped", policy="random", objects="procedural:0:20")
    assert {"target", "random10", "pile"} <= set(evaluate._fitting(anyone, clear))


def test_processes_load_the_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: each suite is measured with the modules of --import, in a process of its own too, to
    which its options can be sent."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    monkeypatch.setattr(evaluate.modules, "_loaded", {})
    Path("my_empty.py").write_text("")
    tasks: list[tuple] = []

    def stopped(_: Any, some: list[tuple], *__: Any) -> None:
        tasks.extend(some)
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate.processes, "each", stopped)
    flags = ["--policy", "random", "--suites", "cases", "tray", "--out", "out"]
    assert cli.main(["eval", "shipped", *flags, "--import", "my_empty"]) == 130
    assert all("my_empty" in task[-1] for task in tasks)
    assert len(tasks) == 2
    assert pickle.loads(pickle.dumps(tasks)) == tasks
    options, changes, suite, episodes, _ = tasks[0]
    with pytest.raises(SettingsError, match="'no_module' cannot be imported"):
        evaluate._measure(lambda *_: None, options, changes, suite, episodes, ("no_module",))


@pytest.mark.mjx
@pytest.mark.slow
def test_a_suite_is_the_evaluation(tmp_path: Path):
    """Claim: the file of a suite has the numbers of `evaluate`, one at a time or side by side."""
    for jobs in ("1", "2"):
        flags = ["--suites", "pile", "random10", "--objects", "procedural:7:40", "--episodes", "2"]
        command = ["eval", "shipped", "--policy", "random", *flags, "--physics", "c"]
        assert cli.main([*command, "--jobs", jobs, "--out", str(tmp_path / jobs)]) == 0
        result = json.loads((tmp_path / jobs / "pile.json").read_text())
        policy = policies.make("random", "shipped")
        table = rollout.evaluate(policy, "pile", 2, 0, "c", objects="procedural:7:40")
        assert {name: result[name] for name in table} == table
        assert {"commit", "versions", "seconds", "config"} <= result.keys()
