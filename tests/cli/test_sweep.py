"""`csac-jax sweep`: bad input is one line, exit code 2 and nothing started; settings reach their
configs."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from csac_jax import algorithms, cli, presets
from csac_jax.cli import sweep as command
from csac_jax.config import Config
from csac_jax.evaluation import metrics
from csac_jax.evaluation.suites import PreparedSuite
from csac_jax.io import files
from csac_jax.runtime import signals
from csac_jax.sweeps import final, runner
from csac_jax.training import programs, step
from tests.training import toys

SMOKE = presets.smoke()
RUN = runner.run


@pytest.fixture(autouse=True)
def nothing_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """No test of this file trains or takes over signals."""

    def forbidden(*_, **__):
        raise AssertionError("the sweep began")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runner, "run", forbidden)
    monkeypatch.setattr(signals, "install", signals.Stop)


def test_settings_reach_their_configs():
    """Claim: each setting is the preset with its algorithm, the flags for all, and its own values,
    which win."""
    flags = "--seeds 3 --seed 7 --sim.physics c --learn.batch 4"
    flags += " --vary algo=csac,vpg --vary target.gamma=0.1,0.3"
    options, plan = command.read(["smoke", *flags.split()])
    assert (options.seeds, plan.seeds, options.devices, options.shard) == (3, 3, None, "seeds")
    same = {"seed": 7, "sim": {"physics": "c"}, "learn": {"batch": 4}}
    changes = [{**same, "target": {"gamma": gamma}} for gamma in (0.1, 0.3)]
    assert [one.cfg for one in plan.points] == [
        algorithms.configure(SMOKE, algo).change(**change)
        for algo in ("csac", "vpg")
        for change in changes
    ]
    assert plan.points[1].name == "algo=csac,target.gamma=0.3"
    assert [cfg.seed for cfg in runner.runs_of(plan).values()][:3] == [7, 8, 9]


def test_plan_survives_its_file(tmp_path: Path):
    """Claim: a resumed sweep has the settings of its folder, with no need of flags; one with no
    number of episodes is refused."""
    arguments = ["smoke", "--seeds", "2", "--vary", "replay.end=1:4,1:12", "--evaluate", "7"]
    _, plan = command.read(arguments)
    path = tmp_path / files.SWEEP_PLAN
    path.write_text(runner.plan_text(plan))
    assert command.read(["--resume", str(tmp_path)])[1] == plan
    content = json.loads(path.read_text())
    del content["sha256"]
    path.write_text(json.dumps({**content, "episodes": "7"}))
    with pytest.raises(runner.SweepError, match="episodes: 0 to"):
        command.read(["--resume", str(tmp_path)])


METHODS = ("CSAC-beta", "VPG")
STUDY = "--seeds 2 --vary algo=csac_beta,vpg --vary task=clear,packed"


def _episodes(lifted: int) -> metrics.Episodes:
    """Builds four episodes of one block and one grasp: so many lift it, the others touch it."""
    done, ones = np.arange(4) < lifted, np.ones((4, 1), np.int32)
    return metrics.Episodes(
        valid=ones > 0,
        primitive=ones,
        outcome=np.where(done, 4, 2)[:, None],
        cleared=done[:, None].astype(np.int32),
        blocks_lost=0 * ones[:, 0],
        changed=ones > 0,
        wrong=ones < 0,
        unreachable=ones < 0,
        blocks=ones[:, 0],
        completed=done,
        ending=np.where(done, 0, 1),
    )


@pytest.mark.optax
def test_study(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    """Claim: `sweep --evaluate` over methods and tasks evaluates every final policy once, also
    where it was interrupted, and writes the tables of `report`. A small step and a law of successes
    stand in for the learner's."""
    monkeypatch.setattr(runner, "run", RUN)
    _with_toys(monkeypatch)
    measured: list[str] = []
    stop = signals.Stop()
    monkeypatch.setattr(signals, "install", lambda: stop)

    def measure(folder: Path, suite: PreparedSuite) -> dict:
        assert (suite.parts, suite.episodes) == ({"packed": "packed" in str(folder)}, 4)
        measured.append(str(folder))
        stop.signal = 15 if len(measured) == 5 else None
        return metrics.summarise(_episodes(4 if "vpg" in str(folder) else 2 + int(folder.name[-1])))

    def prepare(cfg: Config, suite: str, episodes: int, seed: int, *_) -> PreparedSuite:
        parts: Any = {"packed": cfg.scene.packed_fraction == 1.0}
        return PreparedSuite(suite, cfg, parts, episodes, seed)

    monkeypatch.setattr(final.policies, "load", lambda folder, *_: folder)
    monkeypatch.setattr(final.suites, "prepare", prepare)
    monkeypatch.setattr(final.rollout, "evaluate", measure)
    begun = cli.main(["sweep", "smoke", *STUDY.split(), "--evaluate", "4", "--run-dir", "run"])
    assert (begun, len(measured), Path("run/study.md").exists()) == (128 + 15, 5, False)
    stop.signal = None
    assert cli.main(["sweep", "--resume", "run"]) == 0
    assert len(measured) == len(set(measured)) == 2 * 2 * 2
    text = Path("run/study.md").read_text().split("## Evaluation")[1].split("## ")[0]
    _, _, *table = [line for line in text.splitlines() if "|" in line]
    assert [sum(method in line for line in table) for method in METHODS] == [2, 2]
    assert all(("100.0 % (100.0 to 100.0)" in line) == ("VPG" in line) for line in table)
    assert all(("62.5 % (50.0 to 75.0)" in line) == ("CSAC-beta" in line) for line in table)
    assert "study.md" in capsys.readouterr().out
    assert cli.main(["eval", "run", "--suite", "cases", "--episodes", "4"]) == 0
    assert len(measured) == 2 * len(set(measured))
    found = json.loads(Path(measured[-1], "eval-cases.json").read_text())
    assert (found["suite"], found["seed"], found["completion"]["n"]) == ("cases", 0, 4)
    assert cli.main(["eval", "run", "--suite", "cases", "--episodes", "4"]) == 0
    assert len(measured) == 2 * len(set(measured))
    assert "2 policies have their eval-cases.json already" in capsys.readouterr().out
    assert cli.main(["eval", "run", "--seed", "1"]) == 2
    assert "eval SWEEP: takes --suite and --episodes alone" in capsys.readouterr().err


def test_policies_are_measured_with_their_own_robot(monkeypatch: pytest.MonkeyPatch):
    """Claim: the final policies of a point are evaluated with the point's robot."""
    seen: list[str] = []
    note = lambda cfg, *_: seen.append(cfg.sim.robot)  # noqa: E731
    monkeypatch.setitem(final.suites.SUITES, final.OWN, final.suites.Suite(note))
    for robot in ("ur5", "hand"):
        cfg = presets.smoke().change(sim={"robot": robot})
        final._measure_point(4, final.OWN, cfg, {}, signals.Stop())
    assert seen == ["ur5", "hand"]


def _with_toys(monkeypatch: pytest.MonkeyPatch) -> None:
    """Puts a small step in place of the learner's."""
    monkeypatch.setattr(programs, "make", lambda cfg, *_, **__: toys.program(cfg))
    monkeypatch.setattr(programs, "init_state", toys.init_state)
    monkeypatch.setattr(step, "train_step", toys.train_step)


@pytest.mark.optax
def test_exit_codes(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    """Claim: a sweep that is stopped by a signal exits with 130 or 143 and says how to go on;
    resumed, it ends with 0 and its results. A small step stands in for the learner's."""
    monkeypatch.setattr(runner, "run", RUN)
    _with_toys(monkeypatch)
    for number in (2, 15):
        stopped = signals.Stop()
        stopped.signal = number
        monkeypatch.setattr(signals, "install", lambda stopped=stopped: stopped)
        first = "smoke --seeds 2 --run-dir run" if number == 2 else "--resume run"
        assert cli.main(["sweep", *first.split()]) == 128 + number
        assert "continue with: csac-jax sweep --resume run" in capsys.readouterr().out
    monkeypatch.setattr(signals, "install", signals.Stop)
    assert cli.main(["sweep", "--resume", "run", "--json", "out.json"]) == 0
    assert "interquartile mean of 2 seeds" in capsys.readouterr().out
    result = json.loads(Path("out.json").read_text())
    assert result["complete"]
    assert len(result["compile_seconds"]) == 1
    runs = [row["run_dir"] for row in result["settings"][0]["runs"]]
    assert runs == ["base/seed-0", "base/seed-1"]
    assert cli.main(["sweep", "smoke", "--run-dir", "run"]) == 2
