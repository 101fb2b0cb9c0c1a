"""`csac-jax sweep`: bad input is one line, exit code 2 and nothing started; settings reach their configs."""

import dataclasses
from pathlib import Path

import pytest

from csac_jax import algorithms, cli, presets
from csac_jax.train import sweep

SMOKE = presets.smoke()


@pytest.fixture(autouse=True)
def nothing_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """No test of this file trains or takes over signals."""

    def forbidden(*_, **__):
        raise AssertionError("the sweep began")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sweep, "run", forbidden)
    monkeypatch.setattr(cli.stopping, "install", cli.stopping.Stop)


def _fails(capsys: pytest.CaptureFixture, arguments: str) -> tuple[int, str]:
    code = cli.main(["sweep", *arguments.split()])
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1, captured.err
    assert list(Path().iterdir()) == []
    return code, captured.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "sweep: give a preset first, one of: smoke, quick"),
        ("smoke --seeds 0", "--seeds: at least 1"),
        ("smoke --vary learn.tua=0.1", "--vary: 'learn.tua' is no setting; perhaps you meant learn.tau"),
        ("smoke --vary learn.tau=", "--vary learn.tau=: give a setting and its values"),
        ("smoke --vary learn.tau=x,0.1", "--learn.tau: could not convert string to float: 'x'"),
        ("smoke --vary learn.tau=0.1,2", "learn.tau: must lie in 0 < tau <= 1"),
        ("smoke --vary algo=csac,dqn", "unknown algorithm 'dqn'"),
        ("smoke --vary learn.tau=0.1,0.10", "--vary: two settings have the same values"),
        ("smoke --devices 4096", "--devices: 4096 asked for, there are "),
        ("smoke --seeds 100000", "lower --replay.capacity or --seeds, or raise --devices"),
        ("smoke --cluster", "several processes need --run-dir"),
        ("smoke --run-dir y --coordinator a:1 --processes 2 --process-id 2", "--process-id: must lie in 0 .. 1"),
        ("smoke --run-dir .", ". exists; give another --run-dir"),
        ("--resume x --learn.tau 0.1", "leave all others out"),
    ],
)
def test_bad_arguments(capsys: pytest.CaptureFixture, arguments: str, message: str):
    """Claim: what cannot be swept is one line that names the thing, exit code 2, and no folder is made."""
    code, line = _fails(capsys, arguments)
    assert code == 2
    assert message in line


def test_no_sweep_to_resume(capsys: pytest.CaptureFixture):
    """Claim: a folder without a sweep is one line and exit code 1."""
    code, line = _fails(capsys, "--resume nowhere")
    assert (code, "there is no sweep.json in nowhere" in line) == (1, True)


def test_settings_reach_their_configs():
    """Claim: each setting is the preset with its algorithm, the flags for all, and its own values, which win."""
    flags = "--seeds 3 --seed 7 --learn.batch 4 --vary algo=csac,vpg --vary target.gamma=0.1,0.3"
    options, plan = cli._read_sweep(["smoke", *flags.split()])
    assert (options.seeds, plan.seeds, options.devices, options.shard) == (3, 3, None, "seeds")
    wanted = []
    for algo in ("csac", "vpg"):
        cfg = algorithms.configure(SMOKE, algo)
        cfg = dataclasses.replace(cfg, seed=7, learn=dataclasses.replace(cfg.learn, batch=4))
        wanted += [
            dataclasses.replace(cfg, target=dataclasses.replace(cfg.target, gamma=gamma)) for gamma in (0.1, 0.3)
        ]
    assert [one.cfg for one in plan.settings] == wanted
    assert plan.settings[1].name == "algo=csac,target.gamma=0.3"
    assert [one.cfg.seed for one in sweep.members_of(plan)[:3]] == [7, 8, 9]


def test_plan_survives_its_file(tmp_path: Path):
    """Claim: a resumed sweep has the settings of its folder, with no need of flags."""
    _, plan = cli._read_sweep(["smoke", "--seeds", "2", "--vary", "replay.beta_end=1:4,1:12"])
    (tmp_path / sweep.PLAN).write_text(sweep.plan_text(plan))
    assert cli._read_sweep(["--resume", str(tmp_path)])[1] == plan
