"""The command line: bad input is one line and an exit code, and nothing is overwritten."""

import hashlib
import json
import logging
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import jax
import pytest

import csac_jax
from csac_jax import algorithms, api, cli, presets
from csac_jax.cli import sweep, train
from csac_jax.config import BetaReplay, Config, DenseNet121, UniformReplay
from csac_jax.errors import DataWarning, SettingsError
from csac_jax.evaluation import policies, suites
from csac_jax.io import checkpoint
from csac_jax.runtime import modules, signals
from csac_jax.section import Section
from csac_jax.sweeps import runner
from csac_jax.training.callbacks import RunInfo, RunRecord, Summary
from csac_jax.training.progress import Terminal

ROOT = Path(csac_jax.__file__).parents[1]
SMOKE = presets.smoke()
_STOPPED = runner.SweepResult({"settings": []}, [], 2)
SUMMARY = Summary(4, 8, 1.5, 0.5, None, 0, None)


@pytest.fixture(autouse=True)
def no_training(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Fails a test that trains; no test of this file takes over signals."""

    def forbidden(*_):
        raise AssertionError("training began")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(api, "Terminal", forbidden)
    monkeypatch.setattr(signals, "install", signals.Stop)


def _fails(capsys: pytest.CaptureFixture, code: int, arguments: str, message: str = "") -> str:
    """Runs a command that must fail with this code; returns its one line on stderr."""
    assert cli.main(arguments.split()) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("csac-jax: ")
    assert captured.err.count("\n") == 1, captured.err
    assert message in captured.err
    return captured.err


def _saved(folder: Path, cfg: Config, step: int = 4) -> Path:
    """Saves a run with one checkpoint."""
    state = {"step": jax.numpy.int32(step)}
    checkpoint.save(folder, step, state, cfg, {"seconds": 1.0, "grasps": [], "score": [0.5, 0.5]})
    return folder


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A run of `smoke` with one checkpoint."""
    return _saved(tmp_path / "runs" / "one", SMOKE)


def test_long_work_is_logged(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    """Claim: the package's log is one line on stderr while a command runs, also where a library has
    given the root logger a handler; a repeated warning is one line of a command."""

    def work(_: list[str]) -> int:
        logger.info("1 of 6")
        warnings.warn("odd\nfile", DataWarning, stacklevel=1)
        for level in (1, 2):
            warnings.warn("odd file", DataWarning, stacklevel=level)
        return 0

    logger, root = logging.getLogger("csac_jax.scenes.pool"), logging.StreamHandler(sys.stderr)
    monkeypatch.setattr(logging.getLogger(), "handlers", [root])
    monkeypatch.setitem(cli.COMMANDS, "doctor", work)
    for _ in range(2):
        assert cli.main(["doctor"]) == 0
        assert capsys.readouterr() == ("", "1 of 6\ncsac-jax: warning: odd file\n")
    logger.info("2 of 6")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "command", ["train --resume {}", "eval {}", "export {} p.safetensors", "play --policy {}"]
)
def test_missing_or_damaged_run(capsys: pytest.CaptureFixture, run_dir: Path, command: str):
    """Claim: a run that is not there, has no checkpoint or a damaged one is one line and exit code
    1."""
    line = _fails(capsys, 1, command.format("nowhere"))
    assert re.search(f"there is no {'checkpoint' if 'resume' in command else 'folder'}", line)
    Path("empty").mkdir()
    _fails(capsys, 1, command.format("empty"), "there is no checkpoint")
    (run_dir / "checkpoints/4" / checkpoint.MANIFEST).unlink()
    _fails(capsys, 1, command.format(run_dir), "half-written")


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("--resume {} --learn.tau 0.5 --seed 3", "other values of seed, learn.tau;"),
        ("--resume {} --algo csac", "other values of algo, replay;"),
        ("quick --resume {}", "other values of preset;"),
        ("--resume {} --run-dir x", "takes no --run-dir, --init or --config"),
        ("smoke --run-dir {}", "exists; give another --run-dir"),
        ("--resume {} --train.actions 32", "train.actions;"),
        ("--resume {} --train.actions 96 --train.save-every 3", "train.save_every;"),
    ],
)
def test_run_is_not_changed(
    capsys: pytest.CaptureFixture, run_dir: Path, command: str, message: str
):
    """Claim: a run resumes with its own settings and no fewer actions; other ones are exit code 2,
    each is named, and no file of the run changes."""
    before = {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file()}
    line = _fails(capsys, 2, f"train {command.format(run_dir)}")
    assert message.split(",")[0].rstrip(";") in line
    assert {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    "command", ["--resume {}", "smoke --resume={} --learn.batch 8", "--resume {} --algo vpg"]
)
def test_resume_takes_the_config_of_the_run(tmp_path: Path, command: str):
    """Claim: a resumed run needs no settings, and may be given its own."""
    cfg = algorithms.configure(SMOKE, "vpg") if "algo" in command else SMOKE
    folder = _saved(tmp_path / "runs", cfg)
    options, resumed = train.read(command.format(folder).split())
    assert (options.resume, resumed) == (folder, cfg)


def test_networks_of_other_settings(capsys: pytest.CaptureFixture):
    """Claim: --init brings the settings of its networks, and as many cells as they learned with,
    unless options say otherwise; other networks given as options are refused."""
    cfg = train.read(["smoke", "--init", "shipped_clutter"])[1]
    assert cfg.net == policies.load_config("shipped_clutter").net
    assert cfg.learn.batch == SMOKE.learn.batch
    for flags, size in (([], 96), (["--heightmap.size", "64"], 64)):
        assert train.read(["smoke", "--init", "shipped", *flags])[1].heightmap.size == size
    message = "its networks are not those of these settings"
    _fails(capsys, 2, "train fast --init shipped_clutter --net.growth 8", message)


@pytest.mark.parametrize(
    ("flags", "changes"),
    [
        (
            "--seed 3 --scene.slots box prism --replay.end 2 3",
            {"seed": 3, "scene": {"slots": ("box", "prism")}, "replay": {"end": (2.0, 3.0)}},
        ),
        ("--replay.sampler=uniform", {"replay": UniformReplay(capacity=SMOKE.replay.capacity)}),
        (
            "--net.head 8 --net.kind densenet121 --net.norm batch",
            {"net": DenseNet121(rotations=4, head=8, norm="batch")},
        ),
        (
            "--algo csac --replay.sampler beta --replay.end 1 5",
            {"algo": "csac", "replay": BetaReplay(capacity=SMOKE.replay.capacity, end=(1.0, 5.0))},
        ),
    ],
)
def test_flags_reach_the_config(flags: str, changes: dict[str, Any]):
    """Claim: settings on the command line reach the config, the rest is the preset's;
    --replay.sampler and --net.kind choose their section, which keeps what both have."""
    assert train.read(["smoke", *flags.split()])[1] == SMOKE.change(**changes)


@pytest.fixture
def config_file(tmp_path: Path) -> Path:
    """A file of settings."""
    path = tmp_path / "my.toml"
    path.write_text('preset = "smoke"\nseed = 5\n[learn]\ntau = 0.5\nbatch = 4\n')
    return path


def test_flags_win_over_the_config_file(config_file: Path):
    """Claim: --config is the base in place of a preset, --algo and settings given as flags win over
    it, before or after; a sweep's points have them too."""
    wanted = SMOKE.change(seed=5, learn={"tau": 0.5, "batch": 4})
    file = ["--config", str(config_file)]
    assert train.read(file)[1] == wanted
    assert train.read(["smoke", *file])[1] == wanted
    wanted = algorithms.configure(SMOKE, "csac").change(seed=6, learn={"tau": 0.1, "batch": 4})
    flags = ["--learn.tau", "0.1", "--algo", "csac", "--seed", "6"]
    assert train.read([*file, *flags])[1] == wanted
    assert train.read([*flags, f"--config={config_file}"])[1] == wanted
    _, plan = sweep.read(
        [*file, *flags, "--vary", "learn.updates_per_step=1,2", "--sim.physics", "mjx"]
    )
    updates = [wanted.change(learn={"updates_per_step": n}, sim={"physics": "mjx"}) for n in (1, 2)]
    assert [point.cfg for point in plan.points] == updates


@pytest.mark.parametrize("command", ["train", "sweep"])
@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("quick --config my.toml", "my.toml: preset: is 'smoke'; leave out quick"),
        ("--config my.toml --learn.batch 100", "learn.batch: 100 transitions cannot be drawn"),
        ("--config other.yaml", "other.yaml: No such file"),
        ("--config bad.json", "bad.json: learn.bath: unknown setting"),
        ("--resume . --config my.toml", ""),
    ],
)
def test_bad_config_file(
    capsys: pytest.CaptureFixture, config_file: Path, command: str, flags: str, message: str
):
    """Claim: a file that cannot be is one line with its name and the key, and exit code 2."""
    Path("bad.json").write_text('{"preset": "smoke", "learn": {"bath": 1}}')
    if command == "train" and "resume" in flags:
        _saved(Path("."), SMOKE)
    _fails(capsys, 2, f"{command} {flags}", message)


def test_which_checkpoint(capsys: pytest.CaptureFixture, run_dir: Path):
    """Claim: `--which` is the newest checkpoint, one by its step, or that of RUN/best; one that is
    not there is a line with the remedy."""
    assert policies.load_config(run_dir, 4) == policies.load_config(run_dir) == SMOKE
    for which, message in (("best", "keeps its best with eval_every"), ("3", "saved are: 4")):
        _fails(capsys, 1, f"eval {run_dir} --policy random --which {which}", message)
    _saved(run_dir / "best", SMOKE.change(seed=9), 2)
    assert policies.load_config(run_dir, "best") == SMOKE.change(seed=9)
    assert policies.load_config(run_dir, "last") == SMOKE


def _help(capsys: pytest.CaptureFixture, *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code in (0, None)
    return capsys.readouterr().out


def test_every_setting_is_a_flag(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    """Claim: --help-all shows every setting of a config as a flag with its meaning, those of the
    chosen alternative among them."""
    monkeypatch.setenv("COLUMNS", "200")
    shown = _help(capsys, "train", "quick", "--help-all", "--replay.sampler", "uniform")
    cfg = presets.quick().change(replay={"sampler": "uniform"})
    sections = [one for one in vars(cfg).values() if isinstance(one, Section)]
    assert len(sections) == 15
    for section in sections:
        for name in vars(section):
            assert f"--{section.SECTION}.{name} ".replace("_", "-") in shown.replace(",", " ")
    assert {"--seed", "--algo"} <= set(shown.split())
    assert "--preset" not in shown
    assert "--replay.end" not in shown
    assert "Fewest blocks in play in a scene" in shown


def test_examples_of_the_help_are_read(run_dir: Path, config_file: Path):
    """Claim: the parser takes every example that the help shows."""
    for example in (*train.EXAMPLES, *sweep.EXAMPLES):
        words = example.split("#")[0].replace("runs/a", str(run_dir)).split()
        command = sweep if example in sweep.EXAMPLES else train
        if "--devices" not in words:
            command.read(words)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("report nowhere --device cpu", "there is no file or folder nowhere; give folders of runs"),
        (
            "report nowhere --device gpu",
            "device gpu: JAX finds none here; leave it out for the cpu",
        ),
        ("train smoke", "JAX finds no device of JAX_PLATFORMS=tpu; unset it"),
        ("doctor", "JAX finds no device of JAX_PLATFORMS=tpu; unset it"),
    ],
)
def test_device_is_selected(arguments: str, line: str, tmp_path: Path):
    """Claim: `--device cpu` is taken by any command, whatever JAX_PLATFORMS says; `--device gpu`
    without one, and a JAX_PLATFORMS that this machine lacks, is one line and exit code 2."""
    if "gpu" in arguments and jax.default_backend() == "gpu":
        pytest.skip("there is a GPU")
    command = [sys.executable, "-m", "csac_jax", *arguments.split()]
    environment = {**os.environ, "JAX_PLATFORMS": "tpu", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, list(tmp_path.iterdir())) == (2, "", [])
    assert line in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Config]:
    """Configs that a suite is asked to build; the command ends there."""
    configs: list[Config] = []

    def build(cfg, *_):
        configs.append(cfg)
        raise SettingsError("enough")

    for name in ("random10", "in_distribution"):
        monkeypatch.setitem(suites.SUITES, name, suites.Suite(build))
    return configs


@pytest.mark.parametrize(
    "command", ["eval shipped_clutter --suite random10", "play --policy shipped_clutter"]
)
def test_any_policy_sees_through_another_camera(
    capsys: pytest.CaptureFixture, asked: list[Config], command: str
):
    """Claim: `eval` and `play` change how a policy sees by flags, and nothing else of it."""
    flags = "--heightmap.view oblique --camera.position -0.4 0 0.6 --sensor.kind d435 "
    _fails(capsys, 2, f"{command} {flags} --sensor.colour 0.1")
    trained = policies.load_config("shipped_clutter")
    assert asked[0].change(sim=trained.sim) == trained.change(
        heightmap={"view": "oblique"},
        camera={"position": (-0.4, 0.0, 0.6)},
        sensor={"kind": "d435", "colour": 0.1},
    )


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("", {}),
        ("--augment off", {"augment": False}),
        ("--height-bonus 2", {"height_bonus": 2.0}),
        ("--retry-temperature 0.1", {"retry_temperature": 0.1}),
    ],
)
def test_eval_changes_how_a_policy_decides(
    capsys: pytest.CaptureFixture, asked: list[Config], flags: str, expected: dict[str, Any]
):
    """Claim: `eval --augment off` makes a policy act on one view, not the mean over mirror images,
    `--height-bonus` prefer what lies high and `--retry-temperature` draw another place after
    failures; without them, the policy acts as it was trained to."""
    _fails(capsys, 2, f"eval shipped --suite random10 {flags}")
    assert asked[0].policy == policies.load_config("shipped").change(policy=expected).policy


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    ["start smoke --runs 1", "replay --smallest 6 --largest 7", "step smoke --repeats 1"],
)
def test_benchmarks_run(capfd: pytest.CaptureFixture, arguments: str):
    """Claim: the benchmarks print JSON with times and provenance."""
    pytest.importorskip("flashbax")
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        assert cli.main(["bench", *arguments.split()]) == 0  # flashbax is not strict
    assert {"device", "versions", "commit"} <= json.loads(capfd.readouterr().out).keys()


def test_automatic_physics_is_resolved(monkeypatch: pytest.MonkeyPatch):
    """Claim: `--sim.physics auto` reaches a run as what it stands for here, and may be asked for
    again when the run is resumed; the first line of a run names its physics and device."""
    wanted = SMOKE.change(seed=3, sim={"physics": "c"})
    folder = _saved(Path("runs/three"), wanted)
    begun = []
    monkeypatch.setattr(api, "Terminal", Terminal)
    monkeypatch.setattr(api.cache, "enable", lambda: None)
    monkeypatch.setattr(api.programs, "make", lambda cfg, **_: None)
    monkeypatch.setattr(api.loop, "run", lambda cfg, *_, **__: begun.append(cfg) or SUMMARY)
    for flags in (["smoke", "--seed", "3"], ["--resume", str(folder)]):
        assert cli.main(["train", *flags, "--sim.physics", "auto"]) == 0
    assert begun == [wanted, wanted]
    assert sweep.read(["smoke", "--sim.physics", "auto"])[1].points[0].cfg.sim == wanted.sim
    line = api._first_line(folder, wanted)
    assert line.endswith(
        "preset smoke, algorithm csac_beta, seed 3, 2 scenes, physics c, on 1 x cpu (cpu)"
    )


def test_default_run_dirs_do_not_collide():
    """Claim: two runs begun in the same second get folders of their own."""
    first = api.new_folder("smoke-0")
    assert first.name.startswith("smoke-0-20")
    first.mkdir(parents=True)
    assert api.new_folder("smoke-0") != first


def test_help_comes_without_jax():
    """Claim: `import csac_jax`, help and errors load neither JAX nor MuJoCo."""
    source = """
import contextlib, io, sys
import csac_jax
from csac_jax import cli
for line in ("", "--help", "train --help", "sweep --help", "train quick --help-all", "eval --help",
             "train quick --learn.bath 3", "eval x -y"):
    nothing = io.StringIO()
    with contextlib.redirect_stdout(nothing), contextlib.redirect_stderr(nothing):
        with contextlib.suppress(SystemExit):
            cli.main(line.split())
print({"jax", "mujoco", "flax"} & set(sys.modules))
"""
    done = subprocess.run(
        [sys.executable, "-c", source], capture_output=True, text=True, timeout=60, cwd=ROOT
    )
    assert done.stdout == "set()\n", done.stderr


MODULE = """
import csac_jax as csac
from csac_jax.evaluation import policies, suites
def one_box(cfg, episodes, stream):
    scene = {"slots": ("box",), "min_blocks": 1, "packed_fraction": 0.0}
    return csac.make_env(cfg.change(scene=scene, task={"max_actions": 1}), stream, episodes)
csac.presets.register("mine", lambda: csac.presets.smoke().change(train={"actions": 32}))
csac.algorithms.register("far", lambda cfg: cfg.change(target={"gamma": 0.7}))
suites.register("one_box", one_box)
policies.register("tired", policies.RandomPolicy)
"""


@pytest.mark.mjx
def test_commands_load_modules(
    monkeypatch: pytest.MonkeyPatch, tiny: str, capsys: pytest.CaptureFixture
):
    """Claim: presets, algorithms, suites and policies that a module of --import registers work in
    train, sweep and eval; results name the module with a digest of its source. A module that is
    missing or fails is one line."""
    for module, name in ((presets, "PRESETS"), (algorithms, "ALGORITHMS"), (suites, "SUITES")):
        monkeypatch.setattr(module, name, dict(getattr(module, name)))
    monkeypatch.setattr(policies, "BASELINES", dict(policies.BASELINES))
    monkeypatch.setattr(modules, "_loaded", {})
    monkeypatch.setattr(sys, "path", [*sys.path])
    Path("my_module.py").write_text(MODULE)
    trained: list[Any] = []
    monkeypatch.setattr(api, "train", lambda cfg, *_, **__: trained.append(cfg))
    monkeypatch.setattr(api, "run_sweep", lambda plan, *_, **__: trained.append(plan) or _STOPPED)
    assert cli.main(["train", "mine", "--import", "my_module", "--algo", "far"]) == 0
    swept = "sweep mine --vary algo=csac,far --import my_module --seeds 2"
    assert cli.main(swept.split()) == 130
    cfg, plan = trained
    for one in (cfg, plan.points[1].cfg):
        assert (one.preset, one.algo) == ("mine", "far")
        assert (one.target.gamma, one.train.actions) == (0.7, 32)
    measure = f"eval {tiny} --policy tired --suite one_box --episodes 2 --import my_module"
    assert cli.main([*measure.split(), "--json", "eval.json"]) == 0
    result = json.loads(Path("eval.json").read_text())
    assert (result["policy"], result["suite"]) == ("tired", "one_box")
    assert result["counts"]["episodes"] == 2
    assert result["modules"] == {"my_module": hashlib.sha256(MODULE.encode()).hexdigest()[:12]}
    capsys.readouterr()
    Path("my_fault.py").write_text("x = y")
    for arguments, message in (
        ("no_module", "'no_module' cannot be imported (ModuleNotFoundError: No module named"),
        ("my_fault", "'my_fault' cannot be imported (NameError: name 'y' is not defined)"),
        ("", "--import: give the name of a module"),
    ):
        _fails(capsys, 2, f"train smoke --import {arguments}", message)


@pytest.mark.parametrize("code", [0, 130, 143])
def test_exit_code_and_json_of_a_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, code: int):
    """Claim: a stopped run exits with 128 + the signal; --json has the result, the config and where
    it comes from."""

    def trained(cfg, folder, stop, **_):
        stop.signal = code - 128 if code else None
        summary, record = SUMMARY._replace(stopped_by=stop.signal), RunRecord()
        record.begin(RunInfo(cfg, folder, 0))
        assert "commit" in json.loads((folder / "train.json").read_text())  # of a killed run too
        record.end(summary)
        return api.Run(folder, cfg, summary, {})

    monkeypatch.setattr(api, "train", trained)
    assert cli.main(["train", "smoke", "--seed", "3", "--json", "out/result.json"]) == code
    result = json.loads((tmp_path / "out/result.json").read_text())
    assert (result["actions"], result["config"]["seed"]) == (8, 3)
    assert {"device", "versions", "commit", "run_dir", "wall_seconds"} <= result.keys()
    assert json.loads((tmp_path / result["run_dir"] / "train.json").read_text()) == result


@pytest.mark.mjx
def test_doctor_passes(capsys: pytest.CaptureFixture, tmp_path: Path):
    """Claim: on a sound machine `doctor` exits with 0 and names what it checked."""
    assert cli.main(["doctor", "--json", "doctor.json"]) == 0
    shown = capsys.readouterr().out
    assert "jax 0." in shown
    assert shown.count("ok  ") == 3
    result = json.loads((tmp_path / "doctor.json").read_text())
    assert result["thread_pool"]["guarded"]
    assert all(check["passed"] for check in result["self_test"])


@pytest.mark.parametrize("library", [True, False])
def test_doctor_shows_memory(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, library: bool
):
    """Claim: `doctor --preset X`, with any settings, prints the memory of the state of such a run,
    part by part; it names XLA's library of convolutions for training."""
    from csac_jax.runtime import compiler
    from csac_jax.sim import selftest

    monkeypatch.setattr(selftest, "CHECKS", ())
    monkeypatch.setattr(compiler, "has_library", lambda: library)
    flags = "--preset smoke --scene.slots box box --scene.min-blocks 1"
    flags += " --json doctor.json --replay.capacity 128"
    assert cli.main(["doctor", *flags.split()]) == 0
    shown = capsys.readouterr().out
    assert f"convolutions by XLA's {'second' if library else 'default'} library" in shown
    assert re.search(r"memory +0\.00 GiB of [\d.]+ for the state of smoke: replay 0\.00", shown)
    result = json.loads((tmp_path / "doctor.json").read_text())
    assert result["second_library"] is library
    assert result["config"]["scene"]["slots"] == ["box", "box"]
    # packed maps of two observations, action, reward, end, priority; head and size
    transition = 32 * 32 * 2 * (3 + 2 + 1) + 4 + 12 + 4 + 1 + 4
    assert result["memory"]["bytes"]["replay"] == 128 * transition + 8


@pytest.mark.parametrize("error", [1.0, float("nan")])
def test_doctor_fails(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, error: float):
    """Claim: a check that fails, or gives NaN, is exit code 1 and one line that names it."""
    from csac_jax.sim import selftest

    checks = (("sums", lambda: error, 0.5), ("products", lambda: 0.0, 0.5))
    monkeypatch.setattr(selftest, "CHECKS", checks)
    assert cli.main(["doctor"]) == 1
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "self-test failed: sums;" in captured.err
