"""The command line: bad input is one line and an exit code, and nothing is overwritten."""

import contextlib
import dataclasses
import json
import logging
import os
import re
import subprocess
import sys
import tomllib
import types
import warnings
from pathlib import Path
from typing import Any, ClassVar

import jax
import pytest

import csac_jax
from csac_jax import algorithms, api, cli, presets
from csac_jax.cli import bench, evaluation, failures, play, settings, sweep, train
from csac_jax.config import BetaReplay, Config, DenseNet121, SceneConfig, Section, UniformReplay
from csac_jax.errors import DataWarning
from csac_jax.evaluation import policies, rollout, suites
from csac_jax.io import checkpoint
from csac_jax.report.progress import Terminal
from csac_jax.runtime import signals
from csac_jax.scene import pool
from csac_jax.training.callbacks import Summary

ROOT = Path(csac_jax.__file__).parents[1]
SMOKE = presets.smoke()
SUMMARY = Summary(4, 8, 1.5, 0.5, None, 0, None)


@pytest.fixture(autouse=True)
def no_training(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Bad input must be seen before anything is trained; no test of this file trains or takes over
    signals."""

    def forbidden(*_):
        raise AssertionError("training began")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(api, "Terminal", forbidden)
    monkeypatch.setattr(signals, "install", signals.Stop)


def _fails(capsys: pytest.CaptureFixture, *arguments: str) -> tuple[int, str]:
    """Exit code and the one line on stderr."""
    code = cli.main(arguments)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("csac-jax: ")
    assert captured.err.count("\n") == 1, captured.err
    return code, captured.err


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A run of `smoke` with one checkpoint."""
    folder = tmp_path / "runs" / "one"
    checkpoint.save(
        folder, 4, {"step": checkpoint.jax.numpy.int32(4)}, SMOKE, {"seconds": 1.0, "grasps": []}
    )
    return folder


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            "trian quick",
            "unknown command 'trian'; did you mean train? choose one of: train, sweep, eval, bench",
        ),
        ("train", "give a preset first, one of: smoke, quick"),
        ("train --seed 3", "give a preset first, one of: smoke, quick"),
        ("train --config no.toml", "no.toml"),
        ("train smoke --tensorboard", "--tensorboard: it is --log tensorboard now"),
        ("train smoke --log nothing", "invalid choice 'nothing' for argument '--log'"),
        ("train smoke --eval-suite cases", "--eval-suite: give it with --eval-every N"),
        ("train smoke --eval-every -1", "--eval-every, --eval-episodes: at least 1"),
        ("train smoke --eval-every 8 --eval-suite no", "--suite: 'no' is neither a case file"),
        ("eval shipped --step 3", "--step: it is --which STEP now"),
        ("eval shipped --which worst", "--which: 'worst' is neither best, last nor a step"),
        ("train quik", "unknown preset 'quik'; did you mean quick? choose one of: smoke, quick"),
        (
            "train quick --learn.bath 3",
            "--learn.bath, 3; perhaps you meant --learn.batch; see csac-jax train quick --help-all",
        ),
        ("train quick --preset smoke", "--preset"),
        ("train quick --learn.batch", "--learn.batch"),
        ("train quick --learn.batch many", "--learn.batch: invalid literal for int"),
        ("train quick --learn.tau 2", "learn.tau: must be above 0, at most 1, not 2.0"),
        ("train quick --learn.batch 65", "learn.batch: 65 transitions cannot be drawn"),
        (
            "train quick --scene.slots box ball",
            "invalid choice 'ball' for argument '--scene.slots'",
        ),
        (
            "train quick --replay.sampler best",
            "replay.sampler: 'best' is not one of: uniform, prioritised, beta",
        ),
        (
            "train quick --replay.sampler prioritised --replay.end 1 4",
            "--replay.end: --replay.sampler prioritised has no such setting",
        ),
        ("train quick --net.zoom=2", "--net.zoom=2: --net.kind small has no such setting"),
        ("train quick --explore.decay 1.5", "explore.decay: must be above 0, at most 1, not 1.5"),
        ("train quick --replay.capacity 0", "replay.capacity: must lie in 2 .. 1073741824, not 0"),
        ("train quick --seed -1", "seed: must lie in 0 .. 2147483647, not -1"),
        ("train smoke --device tpu", "--device: 'tpu' is not one of: cpu, gpu"),
        ("train quick smoke", "Unrecognized options: smoke"),
        ("train quick --algo csac_bta", "unknown algorithm 'csac_bta'; did you mean csac_beta?"),
        (
            "train smoke --algo dqn",
            "unknown algorithm 'dqn'; choose one of: csac, csac_per, csac_beta, vpg, grasp_only",
        ),
        ("train quick --algo=", "unknown algorithm ''"),
        ("train quick --algo", "Missing value for argument '--algo'"),
        (
            "train quick --algo grasp_only --explore.push-fraction 0.2",
            "explore.push_fraction: must be 0 where",
        ),
        ("train quick --learn.actor-batch 33", "learn.actor_batch: must not exceed learn.batch"),
        ("train quick --learn.critics 3", "invalid choice '3' for argument '--learn.critics'"),
        ("train quick --learn.loss mse", "invalid choice 'mse' for argument '--learn.loss'"),
        ("train quick --cem.elites 65", "cem.elites: must not exceed cem.candidates"),
        (
            "train quick --run-dir .",
            ". exists; give another --run-dir, or go on with it by --resume",
        ),
        ("eval", "A run's folder, a policy file, or one that comes"),
        ("eval . --policy best", "invalid choice 'best' for argument '--policy'"),
        ("eval . --episodes 0", "--episodes: at least 1"),
        ("eval . --seed -2", "--seed: must lie in"),
        (
            "eval shipped --sensor.kind d400",
            "invalid choice 'd400' for argument '--sensor.kind'. "
            "Expected one of ('none', 'd415', 'd435', 'azure_kinect')",
        ),
        ("eval shipped --sensor.kind d415", "sensor.kind: must be none where heightmap.view is"),
        ("eval shipped --camera.size 320 240", "camera.centre: (319.5, 239.5) is not near the"),
        ("play --heightmap.size 60", "heightmap.size: must be a multiple of 8"),
        ("eval . --seed 2147483647", "--seed: must lie in"),
        (
            "eval shipped --suite nowhere",
            "--suite: 'nowhere' is neither a case file nor one of: in_distribution, random10",
        ),
        ("export . policy.bin", "policy.bin: the name of a policy file ends in .safetensors"),
        ("doctor --fix", "Unrecognized options: --fix"),
        (
            "train smoke --sim.physics warp",
            "scene.size_jitter: the second must be 0 where sim.physics is warp",
        ),
        (
            "train smoke --sim.physics warp --scene.size-jitter 0.1 0",
            "--sim.physics: warp computes on CUDA",
        ),
        ("train smoke --sim.gripper rg3", "sim.gripper: 'rg3' is neither one of 2f85, franka_hand"),
        ("eval shipped --sim.gripper rg3", "sim.gripper: 'rg3' is neither one of 2f85, franka_"),
        ("bench", "bench: unknown benchmark ''; choose one of: "),
        ("bench spet", "bench: unknown benchmark 'spet'; choose one of: "),
        ("bench step slow", "bench step: give one preset of: smoke, quick, fast"),
        ("bench step --curve length", "bench step: argument --curve: invalid choice: 'length'"),
        ("bench step --smallest 2", "bench step: --smallest and --largest belong to --curve"),
        (
            "bench step --curve map --smallest 36 --largest 40",
            "bench step: heightmap.size: must be a multiple of 8",
        ),
        ("bench step --repeats 0", "bench step: --steps, --repeats: at least 1"),
        ("bench step --learn.tau 2", "bench step: learn.tau: must be above 0, at most 1"),
        ("bench step smoke --learn.update 2", "bench step: Unrecognized options: --learn.update"),
        ("benchmark --share 0", "--share: above 0, at most 1"),
        ("benchmark --suites piles", "invalid choice 'piles' for argument '--suites"),
        ("benchmark --suites target --policies shipped", "--policies: none of them can act in"),
        ("benchmark --out /dev/null", "--out: /dev/null is a file; give a folder"),
        ("bench learner paper", "bench learner: paper has no small net; give quick or fast"),
        ("bench learner --repeats 0", "bench learner: --repeats: at least 1"),
        ("doctor --preset", "Missing value for argument '--preset'"),
        ("doctor --preset slow", "unknown preset 'slow'; choose one of: smoke, quick"),
        ("doctor --build", "--build: only warp has kernels to build, and sim.physics is c here"),
        ("doctor --preset quick --learn.tau 2", "learn.tau: must be above 0, at most 1"),
        ("doctor --preset quick --learn.bath 2", "perhaps you meant --learn.batch"),
        ("bench closed_loop --episodes 0", "bench closed_loop: --episodes: must be at least 1"),
        ("bench closed_loop --robot ur3", "argument --robot: invalid choice: 'ur3'"),
        ("bench objects --scenes 0", "bench objects: --scenes: must be at least 1"),
        (
            "bench act --pixels 40",
            "bench act: net.margin: DenseNet-121 needs maps of a multiple of 32 cells, not 40",
        ),
        ("bench act --zoom 64", "bench act: net.zoom: must divide 32"),
        (
            "train paper --net.margin 0.1",
            "net.margin: DenseNet-121 needs maps of a multiple of 16 cells, not 246",
        ),
        ("bench parity --poses x", "bench parity: argument --poses: invalid int value: 'x'"),
        ("bench replay 12", "bench replay: give two exponents of 2"),
        ("bench replay 14 12", "bench replay: exponents must lie in 6 .. 24"),
    ],
)
def test_bad_arguments(capsys: pytest.CaptureFixture, arguments: str, message: str):
    """Claim: bad arguments are one line that names the thing, and exit code 2."""
    code, line = _fails(capsys, *arguments.split())
    assert code == 2
    assert message in line


def test_benchmark_without_its_extra(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    """Claim: a benchmark whose package is not installed names it on one line."""
    monkeypatch.setitem(sys.modules, "warp", None)  # importing it raises ModuleNotFoundError
    code, line = _fails(capsys, "bench", "warp_action")
    assert (code, "bench warp_action needs the module warp;" in line) == (2, True)


def test_long_work_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    """Claim: what the package logs about its work is one line on stderr while a command runs, also
    where a library has given the root logger a handler."""
    logger, root = logging.getLogger("csac_jax.scene.pool"), logging.StreamHandler(sys.stderr)
    monkeypatch.setattr(logging.getLogger(), "handlers", [root])
    monkeypatch.setitem(cli.COMMANDS, "doctor", lambda _: print("done") or logger.info("1 of 6"))
    cli.main(["doctor"])
    logger.info("2 of 6")
    assert capsys.readouterr() == ("done\n", "1 of 6\n")


def test_a_warning_is_said_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    """Claim: a warning that comes from several places, or again, is one line of a command."""

    def twice(_: list[str]) -> int:
        warnings.warn("odd\nfile", DataWarning, stacklevel=1)
        for level in (1, 2):
            warnings.warn("odd file", DataWarning, stacklevel=level)
        return 0

    monkeypatch.setitem(cli.COMMANDS, "doctor", twice)
    for _ in range(2):
        assert cli.main(["doctor"]) == 0
        assert capsys.readouterr() == ("", "csac-jax: warning: odd file\n")


READERS = ["train --resume {}", "eval {}", "export {} p.safetensors", "play --policy {}"]


@pytest.mark.parametrize("command", READERS)
def test_missing_run(capsys: pytest.CaptureFixture, tmp_path: Path, command: str):
    """Claim: a run that is not there, or has no checkpoint, is one line and exit code 1."""
    code, line = _fails(capsys, *command.format("nowhere").split())
    what = "checkpoint" if "--resume" in command else "folder"
    assert code == 1
    assert re.search(f"there is no {what} .*nowhere", line)
    (tmp_path / "empty").mkdir()
    code, line = _fails(capsys, *command.format("empty").split())
    assert (code, "there is no checkpoint" in line) == (1, True)


@pytest.mark.parametrize("command", READERS)
def test_damaged_checkpoint(capsys: pytest.CaptureFixture, run_dir: Path, command: str):
    """Claim: a damaged checkpoint is one line and exit code 1."""
    (run_dir / "checkpoints/4" / checkpoint.MANIFEST).unlink()
    code, line = _fails(capsys, *command.format(run_dir).split())
    assert (code, "half-written" in line) == (1, True)


@pytest.mark.slow
def test_scenes_that_never_settle(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, run_dir: Path
):
    """Claim: blocks that do not come to rest are a failure of one line that names what to change,
    not a traceback."""

    class Falling(SceneConfig):  # lands after 0.45 s
        drop_height: ClassVar[float] = 1.0

    falling = Falling(slots=("box",), min_blocks=1, settle_time=0.5)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(pool, "_ROUND", 8)
    monkeypatch.setattr(
        policies, "load_config", lambda *_: dataclasses.replace(SMOKE, scene=falling)
    )
    code, line = _fails(capsys, "eval", str(run_dir), "--policy", "random")
    assert code == 1
    assert "scene.settle_time" in line


@pytest.mark.parametrize(
    ("flags", "names"),
    [
        (["--learn.tau", "0.5", "--seed", "3"], "seed, learn.tau"),
        (["--cem.rounds", "4"], "cem.rounds"),
    ],
)
def test_resume_with_other_settings(
    capsys: pytest.CaptureFixture, run_dir: Path, flags: list[str], names: str
):
    """Claim: to resume with settings that are not the run's is exit code 2, and every one that
    differs is named."""
    code, line = _fails(capsys, "train", "--resume", str(run_dir), *flags)
    assert (code, f"other values of {names};" in line) == (2, True)


def test_resume_with_another_preset(capsys: pytest.CaptureFixture, run_dir: Path):
    """Claim: to resume with a preset that is not the run's is exit code 2."""
    code, line = _fails(capsys, "train", "quick", "--resume", str(run_dir))
    assert (code, "other values of preset;" in line) == (2, True)


def test_resume_excludes_run_dir(capsys: pytest.CaptureFixture, run_dir: Path):
    """Claim: --resume excludes --run-dir, --init and --config."""
    for option in ("--run-dir", "--init", "--config"):
        code, line = _fails(capsys, "train", "--resume", str(run_dir), option, "x")
        assert (code, "takes no --run-dir, --init or --config" in line) == (2, True)


@pytest.mark.parametrize("command", ["train", "sweep"])
@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("nothing", "there is no folder nothing; give the folder of a run, a policy file"),
        ("bad.safetensors", "bad.safetensors cannot be read as .safetensors"),
    ],
)
def test_nothing_to_start_from(
    capsys: pytest.CaptureFixture, tmp_path: Path, command: str, source: str, message: str
):
    """Claim: --init of what holds no networks is one line and exit code 1, or 2 for weights of
    DenseNet-121."""
    (tmp_path / "bad.safetensors").write_bytes(b"bad")
    code, line = _fails(capsys, command, "smoke", "--init", source)
    assert (code, message in line) == (1, True)
    flags = ["--net.kind", "densenet121", "--net.margin", "0", "--init", source]
    code, line = _fails(capsys, command, "smoke", *flags)
    assert (code, message in line) == (1 if source == "nothing" else 2, True)


def test_networks_of_other_settings(capsys: pytest.CaptureFixture):
    """Claim: --init brings the settings of its networks; others given as options are refused."""
    cfg = train.read(["smoke", "--init", "shipped"])[1]
    assert cfg.net == api.load_policy("shipped").cfg.net
    assert cfg.learn.batch == SMOKE.learn.batch
    code, line = _fails(capsys, "train", "fast", "--init", "shipped", "--net.growth", "8")
    assert (code, "--init shipped: its networks are not those of these settings" in line) == (
        2,
        True,
    )


def test_nothing_is_overwritten(capsys: pytest.CaptureFixture, run_dir: Path):
    """Claim: refused arguments change no file of the run."""
    before = {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file()}
    _fails(capsys, "train", "smoke", "--run-dir", str(run_dir))
    _fails(capsys, "train", "--resume", str(run_dir), "--seed", "9")
    assert {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("flag", ["--resume {}", "--resume={}"])
@pytest.mark.parametrize("preset", ["", "smoke "])
def test_resume_takes_the_config_of_the_run(run_dir: Path, flag: str, preset: str):
    """Claim: a resumed run needs no settings, and may be given its own."""
    own = "--learn.batch 8 --seed 0"
    for arguments in (preset + flag.format(run_dir), f"{preset}{flag.format(run_dir)} {own}"):
        options, cfg = train.read(arguments.split())
        assert cfg == SMOKE
        assert options.resume == run_dir


def test_flags_reach_the_config():
    """Claim: settings on the command line reach the config, the rest is the preset's."""
    flags = "--seed 3 --learn.batch 4 --scene.slots box prism --replay.end 2 3"
    _, cfg = train.read(["smoke", *flags.split()])
    assert cfg == dataclasses.replace(
        SMOKE,
        seed=3,
        learn=dataclasses.replace(SMOKE.learn, batch=4),
        scene=dataclasses.replace(SMOKE.scene, slots=("box", "prism")),
        replay=dataclasses.replace(SMOKE.replay, end=(2.0, 3.0)),
    )


def test_flags_choose_the_alternative():
    """Claim: --replay.sampler and --net.kind choose their section, which keeps what it shares with
    the preset's and takes its own settings."""
    flags = "--replay.sampler=uniform --net.margin 0 --net.kind densenet121 --net.zoom 2"
    _, cfg = train.read(["smoke", *flags.split()])
    assert cfg.replay == UniformReplay(capacity=SMOKE.replay.capacity)
    assert cfg.net == DenseNet121(rotations=4, head=4, margin=0.0, zoom=2)
    flags = "--algo csac --replay.sampler beta --replay.end 1 5"
    _, cfg = train.read(["smoke", *flags.split()])
    assert cfg.replay == BetaReplay(capacity=SMOKE.replay.capacity, end=(1.0, 5.0))


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
    _, plan = sweep.read([*file, *flags, "--vary", "learn.updates=1,2", "--sim.physics", "mjx"])
    updates = [wanted.change(learn={"updates": n}, sim={"physics": "mjx"}) for n in (1, 2)]
    assert [point.cfg for point in plan.points] == updates


@pytest.mark.parametrize("command", ["train", "sweep"])
@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("quick", "my.toml: preset: is 'smoke'; leave out quick"),
        ("--learn.batch 100", "learn.batch: 100 transitions cannot be drawn"),
        ("--config other.yaml", "other.yaml: No such file"),
        ("--config bad.json", "bad.json: learn.bath: unknown setting"),
    ],
)
def test_bad_config_file(
    capsys: pytest.CaptureFixture, config_file: Path, command: str, flags: str, message: str
):
    """Claim: a file that cannot be is one line with its name and the key, and exit code 2."""
    Path("bad.json").write_text('{"preset": "smoke", "learn": {"bath": 1}}')
    first = [flags] if flags == "quick" else []
    rest = [] if flags == "quick" else flags.split()
    code, line = _fails(capsys, command, *first, "--config", str(config_file), *rest)
    assert (code, message in line) == (2, True), line


def test_resumed_sweep_takes_no_config_file(capsys: pytest.CaptureFixture, config_file: Path):
    """Claim: a sweep goes on with its own settings; a file is refused even if it changes none."""
    config_file.write_text('preset = "quick"')
    code, line = _fails(capsys, "sweep", "--resume", ".", "--config", str(config_file))
    assert (code, "a sweep goes on with its own settings" in line) == (2, True)


def test_which_checkpoint(capsys: pytest.CaptureFixture, run_dir: Path):
    """Claim: `--which` is the newest checkpoint, one by its step, or that of RUN/best; one that is
    not there is a line with the remedy."""
    assert policies.load_config(run_dir, 4) == policies.load_config(run_dir) == SMOKE
    for which, message in (("best", "keeps its best with --eval-every N"), ("3", "saved are: 4")):
        code, line = _fails(capsys, "eval", str(run_dir), "--policy", "random", "--which", which)
        assert (code, message in line) == (1, True), line
    other = SMOKE.change(seed=9)
    state = {"step": checkpoint.jax.numpy.int32(2)}
    checkpoint.save(run_dir / "best", 2, state, other, {"score": [0.5, 0.5]})
    assert policies.load_config(run_dir, "best") == other
    assert policies.load_config(run_dir, "last") == SMOKE


@pytest.mark.parametrize("flag", ["--algo vpg", "--algo=vpg", "--algo csac --algo vpg"])
def test_algorithm_reaches_the_config(flag: str):
    """Claim: --algo makes the preset one of that algorithm, and settings given as well win over it,
    before or after."""
    wanted = algorithms.configure(SMOKE, "vpg")
    assert train.read(["smoke", *flag.split()])[1] == wanted
    own = dataclasses.replace(wanted, target=dataclasses.replace(wanted.target, gamma=0.3))
    for arguments in (f"smoke {flag} --target.gamma 0.3", f"smoke --target.gamma 0.3 {flag}"):
        assert train.read(arguments.split())[1] == own
    assert train.read(["smoke"])[1] == SMOKE


def test_resumed_run_keeps_its_algorithm(capsys: pytest.CaptureFixture, tmp_path: Path):
    """Claim: a run goes on with the algorithm it was begun with; to ask for another is exit code
    2."""
    cfg, folder = algorithms.configure(SMOKE, "vpg"), tmp_path / "runs" / "two"
    checkpoint.save(
        folder, 4, {"step": checkpoint.jax.numpy.int32(4)}, cfg, {"seconds": 1.0, "grasps": []}
    )
    for flags in ([], ["--algo", "vpg"]):
        assert train.read(["--resume", str(folder), *flags])[1] == cfg
    code, line = _fails(capsys, "train", "--resume", str(folder), "--algo", "csac")
    assert (code, "other values of algo;" in line) == (2, True)


def test_help_names_the_algorithms(capsys: pytest.CaptureFixture):
    """Claim: every algorithm is named by the help of the program."""
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in algorithms.ALGORITHMS)


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def test_every_setting_is_a_flag(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    """Claim: --help-all shows every setting of a config as a flag of `train` and `sweep`, those of
    the chosen alternative among them."""
    monkeypatch.setenv("COLUMNS", "200")
    for command in ("train", "sweep"):
        with pytest.raises(SystemExit) as ended:
            cli.main([command, "quick", "--help-all", "--replay.sampler", "uniform"])
        assert ended.value.code in (0, None)
        shown = capsys.readouterr().out
        cfg = presets.quick().change(replay={"sampler": "uniform"})
        sections = [one for name in _names(cfg) if isinstance(one := getattr(cfg, name), Section)]
        assert len(sections) == 15
        for section in sections:
            for name in _names(section):
                assert re.search(rf"{_flag(f'{section.SECTION}.{name}')}[ ,]", shown)
        assert {"--seed", "--algo"} <= set(shown.split())
        assert "--preset" not in shown
        assert "--replay.end" not in shown


def _names(section: Section) -> list[str]:
    return [field.name for field in dataclasses.fields(section)]


@pytest.mark.parametrize("command", ["train", "sweep"])
@pytest.mark.parametrize("preset", presets.PRESETS)
def test_help_is_short(capsys: pytest.CaptureFixture, command: str, preset: str):
    """Claim: --help has at most 80 lines of 100 columns: examples, every option, and the settings
    that people change first, each with its whole text and the preset's value."""
    assert cli.main([command, preset, "--help"]) == 0
    shown = capsys.readouterr().out
    lines = shown.splitlines()
    assert len(lines) <= 80
    assert max(map(len, lines)) <= 100
    assert shown.count(f"\n  csac-jax {command} ") >= 3
    options = {"train": train.TrainOptions, "sweep": sweep.SweepOptions}[command]
    for option in dataclasses.fields(options):
        assert f"\n  {_flag(option.name)} " in shown
    cfg = presets.get(preset)
    assert f"\n  --train.actions {cfg.train.actions} " in shown
    assert f"\n  --scene.slots {' '.join(cfg.scene.slots)}" in shown
    text = " ".join(shown.split())
    assert "auto: c on a CPU, warp on one CUDA device where it is known to be faster" in text
    assert "None" not in shown
    assert lines[-1] == f"All settings: csac-jax {command} {preset} --help-all"


@pytest.mark.parametrize("arguments", ["train", "sweep", "train --seed 3", "sweep --seeds 2"])
def test_help_without_a_preset(capsys: pytest.CaptureFixture, arguments: str):
    """Claim: without a preset, help is that of `quick`; it comes before all complaints."""
    assert cli.main([*arguments.split(), "-h"]) == 0
    shown = capsys.readouterr().out
    assert "with the values of quick:" in shown
    assert shown.endswith("PRESET --help-all\n")


def test_examples_of_the_help_are_read(
    capsys: pytest.CaptureFixture, run_dir: Path, config_file: Path
):
    """Claim: the parser takes every example that the help shows."""
    for example in (*train.EXAMPLES, *sweep.EXAMPLES):
        words = example.split("#")[0].replace("runs/a", str(run_dir)).split()
        command = sweep if example in sweep.EXAMPLES else train
        if "--devices" not in words:
            command.read(words)


def test_both_names_are_commands():
    """Claim: `csac-jax` and `csac_jax` are the same command."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["scripts"] == dict.fromkeys(("csac-jax", "csac_jax"), "csac_jax.cli:main")


@pytest.mark.parametrize(
    ("device", "code", "line"),
    [
        ("cpu", 2, "csac-jax: there is no file or folder nowhere; give folders of runs"),
        ("gpu", 2, "csac-jax: --device gpu: JAX finds none here; leave it out for the cpu"),
    ],
)
def test_device_is_selected(device: str, code: int, line: str):
    """Claim: `--device cpu` is taken by any command, whatever JAX_PLATFORMS says; `--device gpu`
    without one is one line and exit code 2."""
    if device == "gpu" and jax.default_backend() == "gpu":
        pytest.skip("there is a GPU")
    command = [sys.executable, "-m", "csac_jax", "report", "nowhere", "--device", device]
    environment = {**os.environ, "JAX_PLATFORMS": "tpu", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr.startswith(line)
    assert done.stderr.count("\n") == 1


def test_old_suite_is_accepted(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    """Claim: `eval --suite own`, as older commands say, measures in_distribution."""

    def build(*_):
        raise ValueError("in_distribution is asked for")

    monkeypatch.setitem(suites.SUITES, "in_distribution", suites.Suite(build))
    code, line = _fails(capsys, "eval", "shipped", "--suite", "own", "--episodes", "1")
    assert (code, line) == (2, "csac-jax: in_distribution is asked for\n")


@pytest.mark.parametrize("command", ["eval shipped --suite random10", "play --policy shipped"])
def test_any_policy_sees_through_another_camera(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, command: str
):
    """Claim: `eval` and `play` change how a policy sees by flags, and nothing else of it."""
    asked = []

    def build(cfg, *_):
        asked.append(cfg)
        raise ValueError("enough")

    for name in ("random10", "in_distribution"):
        monkeypatch.setitem(suites.SUITES, name, suites.Suite(build))
    flags = "--heightmap.view oblique --camera.position -0.4 0 0.6 --sensor.kind d435 "
    code, _ = _fails(capsys, *command.split(), *(flags + "--sensor.colour 0.1").split())
    assert code == 2
    (cfg,) = asked
    trained = policies.load_config("shipped")
    assert cfg.change(sim=trained.sim) == trained.change(
        heightmap={"view": "oblique"},
        camera={"position": (-0.4, 0.0, 0.6)},
        sensor={"kind": "d435", "colour": 0.1},
    )


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ([], {}),
        (["--augment", "on"], {"augment": True}),
        (["--height-bonus", "2"], {"height_bonus": 2.0}),
        (["--retry", "0.1"], {"retry": 0.1}),
    ],
)
def test_eval_changes_how_a_policy_decides(
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    flags: list[str],
    expected: dict[str, Any],
):
    """Claim: `eval --augment on` makes any policy act on the mean over mirror images,
    `--height-bonus` prefer what lies high and `--retry` draw another place after failures; without
    them, the policy does as it was trained to."""
    asked = []

    def build(cfg, *_):
        asked.append(cfg)
        raise ValueError("enough")

    monkeypatch.setitem(suites.SUITES, "random10", suites.Suite(build))
    code, _ = _fails(capsys, "eval", "shipped", "--suite", "random10", *flags)
    assert code == 2
    assert asked[0].policy == policies.load_config("shipped").change(policy=expected).policy


def test_settings_of_a_view_are_those_given():
    """Claim: a setting that is given counts, also where it is the package's default; no other."""
    flags = ["shipped", "--sensor.dropped=0.0", "--camera.look_at", "0", "0", "0"]
    _, changes = settings.parse_view(evaluation.EvalOptions, "eval", flags)
    wanted = {"sensor": {"dropped": 0.0}, "camera": {"look_at": (0.0, 0.0, 0.0)}}
    assert changes == {"heightmap": {}, "sim": {}, **wanted}


def test_ring_larger_than_memory(capsys: pytest.CaptureFixture, tmp_path: Path):
    """Claim: a ring that memory cannot hold is refused before anything is compiled or written: one
    line with the setting and the largest capacity that would do, exit code 2; that capacity
    passes."""
    from csac_jax.training import memory

    code, line = _fails(capsys, "train", "quick", "--replay.capacity", str(2**30))
    assert code == 2
    match = re.fullmatch(
        r"csac-jax: replay.capacity: .* GiB, .*; lower --replay.capacity from \d+ to (\d+) .*\n",
        line,
    )
    assert match
    assert list(tmp_path.iterdir()) == []
    quick = presets.quick()
    for extra in (0, 1):
        capacity = int(match[1]) + extra
        cfg = dataclasses.replace(
            quick, replay=dataclasses.replace(quick.replay, capacity=capacity)
        )
        with (
            pytest.raises(ValueError, match=r"replay\.capacity")
            if extra
            else contextlib.nullcontext()
        ):
            memory.check(cfg)


def test_limit_of_the_device_goes_first(monkeypatch: pytest.MonkeyPatch):
    """Claim: a device that states its memory is believed, this machine's own counts for one that
    does not."""
    from csac_jax.training import memory

    class Device:
        def __init__(self, stats):
            self.memory_stats = lambda: stats

    for stats in (None, {}, {"bytes_limit": 10**9}):
        monkeypatch.setattr(memory.jax, "devices", lambda stats=stats: [Device(stats)])
        own = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        assert memory.limit() == (10**9 if stats else own)


def test_benchmark_is_run_with_its_arguments(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Claim: `bench NAME ...` calls `main` of that file of the checkout; without a checkout it is
    one line."""
    monkeypatch.setattr(bench, "BENCHMARKS", tmp_path / "bench")
    code, line = _fails(capsys, "bench", "one")
    assert (code, "come with a checkout" in line) == (2, True)
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench/one.py").write_text(
        "import json\ndef main(arguments):\n    print(json.dumps(arguments))\n"
    )
    (tmp_path / "bench/_helper.py").write_text("")
    assert cli.main(["bench", "one", "a", "--b"]) == 0
    assert json.loads(capsys.readouterr().out) == ["a", "--b"]
    assert cli.main(["bench", "--help"]) == 0
    assert capsys.readouterr().out == "usage: csac-jax bench NAME ..., with NAME one of: one\n"


def test_points_of_a_curve():
    """Claim: a curve's points are its first value and doublings of it; only what it is named after
    changes, and contact caps with the blocks."""
    from experiments.bench import step as bench

    assert bench._values(3, 13) == [3, 6, 12]
    quick = presets.quick()
    assert bench._at(quick, "scenes", 32).train.scenes == 32
    assert bench._at(quick, "scenes", 2**13).replay.capacity == 2**13
    assert bench._at(quick, "map", 128).heightmap.size == 128
    assert bench._at(quick, "capacity", 64).replay.capacity == 64
    twice = bench._at(quick, "blocks", 10)
    assert (len(twice.scene.slots), twice.scene.min_blocks) == (10, 10)
    assert (twice.sim.geom_pairs, twice.sim.contacts) == (
        2 * quick.sim.geom_pairs,
        2 * quick.sim.contacts,
    )
    for curve in bench.CURVES:
        other = bench._at(quick, curve, 8 if curve == "blocks" else 64)
        touched = {
            "scenes": {"train", "replay"},
            "blocks": {"scene", "sim"},
            "map": set(),
            "capacity": {"replay"},
        }
        names = [field.name for field in dataclasses.fields(Config)]
        assert {name for name in names if getattr(other, name) != getattr(quick, name)} <= touched[
            curve
        ]


def test_settings_of_a_step():
    """Claim: `bench step` takes settings as `train` does, physics among them, which --physics wins
    over; else physics are those of `auto`."""
    from experiments.bench import step as bench

    assert bench._config("smoke", ["--learn.updates", "3"], None).learn.updates == 3
    asked = [
        ([], None),
        ([], "mjx"),
        (["--sim.physics", "mjx"], None),
        (["--sim.physics", "mjx"], "c"),
    ]
    found = [bench._config("smoke", flags, physics).sim.physics for flags, physics in asked]
    assert found == ["c", "mjx", "mjx", "c"]


def test_cores_are_shared_out(monkeypatch: pytest.MonkeyPatch):
    """Claim: `bench start --cores` gives every seed as many cores, none to two, and refuses more
    than there are."""
    from experiments.bench import start

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {4, 1, 0, 7, 9}, raising=False)
    assert start._shares(None) == [set()]
    assert start._shares(2) == [{0, 1}, {4, 7}]
    assert start._shares(5) == [{0, 1, 4, 7, 9}]
    for cores in (0, 6):
        with pytest.raises(failures.BadArgumentsError, match="--cores: must be from 1 to 5"):
            start._shares(cores)


def test_median_start():
    """Claim: a part that half of the runs never reach has no median, and so no ratio."""
    from experiments.bench import start

    times = [{"success": 3.0}, {"success": None}, {"success": 1.0}]
    assert start._median(times) == {"success": 3.0}
    assert start._median([*times, {"success": None}]) == {"success": None}
    assert start._ratio(6.0, 3.0) == 2.0
    assert start._ratio(None, 3.0) is start._ratio(3.0, None) is None


@pytest.mark.slow
def test_start_benchmark(capfd: pytest.CaptureFixture):
    """Claim: `bench start` prints when runs of this checkout and of another one get where."""
    flags = ["--runs", "1", "--other", str(ROOT), "--cores", "1"]
    assert cli.main(["bench", "start", "smoke", *flags]) == 0
    result = json.loads(capfd.readouterr().out)
    assert (result["cores"], result["side_by_side"]) == (1, 1)
    for name in ("this", "other"):
        (times,) = result["runs"][name]
        assert result["median"][name] == times
        assert 0.0 < times["first_action_cached"] < times["first_action"] < times["end"]
    ratio = result["median"]["other"]["end"] / result["median"]["this"]["end"]
    assert result["times_sooner"]["end"] == ratio


@pytest.mark.slow
def test_replay_benchmark(capsys: pytest.CaptureFixture):
    """Claim: `bench replay` prints JSON with the times of every sampler and where they come
    from."""
    pytest.importorskip("flashbax")
    jax = pytest.importorskip("jax")
    with (
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
    ):  # flashbax is not strict
        assert cli.main(["bench", "replay", "6", "7"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [row["capacity"] for row in result["capacities"]] == [64, 128]
    for row in result["capacities"]:
        names = {"uniform", "prioritised", "beta", "beta_sorted", "flashbax"}
        assert row["median_seconds"].keys() == names
        assert min(row["median_seconds"].values()) > 0.0
    assert {"device", "versions", "commit", "item", "batch", "repeats"} <= result.keys()


def test_automatic_physics_is_resolved(monkeypatch: pytest.MonkeyPatch):
    """Claim: `--sim.physics auto` reaches a run as what it stands for here, and may be asked for
    again when the run is resumed; the first line of a run says what it runs on."""
    in_c = dataclasses.replace(SMOKE.sim, physics="c")
    wanted, folder = dataclasses.replace(SMOKE, seed=3, sim=in_c), Path("runs/three")
    checkpoint.save(
        folder, 4, {"step": checkpoint.jax.numpy.int32(4)}, wanted, {"seconds": 1.0, "grasps": []}
    )
    begun = []
    monkeypatch.setattr(api, "Terminal", Terminal)
    monkeypatch.setattr(api.cache, "enable", lambda: None)
    monkeypatch.setattr(api.step, "make", lambda cfg, **_: None)
    monkeypatch.setattr(api.loop, "run", lambda cfg, *_, **__: begun.append(cfg) or SUMMARY)
    for flags in (["smoke", "--seed", "3"], ["--resume", str(folder)]):
        assert cli.main(["train", *flags, "--sim.physics", "auto"]) == 0
    assert begun == [wanted, wanted]
    assert sweep.read(["smoke", "--sim.physics", "auto"])[1].points[0].cfg.sim == in_c
    line = api._first_line(folder, wanted)
    said = "preset smoke, algorithm csac_beta, seed 3, 2 scenes, physics c, on 1 x cpu (cpu)"
    assert line == f"run {folder}: {said}"


def test_default_run_dirs_do_not_collide():
    """Claim: two runs begun in the same second get folders of their own."""
    first = api.new_folder("smoke-0")
    assert first.name.startswith("smoke-0-20")
    first.mkdir(parents=True)
    assert api.new_folder("smoke-0") != first


def test_help_comes_without_jax():
    """Claim: help and complaints do not wait for JAX."""
    source = """
import contextlib, io, sys
from csac_jax import cli
for line in ("", "--help", "train --help", "sweep --help", "train quick --help-all", "eval --help",
             "train quick --learn.bath 3", "eval x -y"):
    nothing = io.StringIO()
    with contextlib.redirect_stdout(nothing), contextlib.redirect_stderr(nothing):
        with contextlib.suppress(SystemExit):
            cli.main(line.split())
print("jax" in sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", source], capture_output=True, text=True, timeout=60, cwd=ROOT
    )
    assert done.stdout == "False\n", done.stderr


def test_reader_that_stops_reading_is_no_error():
    """Claim: `csac-jax --help | head -1` prints no traceback and no complaint."""
    command = f"{sys.executable} -m csac_jax train --help | head -1"
    done = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, timeout=60, cwd=ROOT
    )
    assert done.stdout.startswith("usage: csac-jax train")
    assert done.stderr == ""


@pytest.mark.parametrize("code", [0, 130, 143])
def test_exit_code_and_json_of_a_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, code: int):
    """Claim: a stopped run exits with 128 + the signal; --json has the result, the config and where
    it comes from."""

    def trained(cfg, folder, stop, **_):
        stop.signal = code - 128 if code else None
        return api.Run(folder, cfg, SUMMARY._replace(stopped_by=stop.signal), {})

    monkeypatch.setattr(api, "train", trained)
    assert cli.main(["train", "smoke", "--seed", "3", "--json", "out/result.json"]) == code
    result = json.loads((tmp_path / "out/result.json").read_text())
    assert (result["actions"], result["config"]["seed"], result["config"]["preset"]) == (
        8,
        3,
        "smoke",
    )
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


def test_doctor_shows_memory(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Claim: `doctor --preset X`, with any settings, says what the state of such a run takes, part
    by part."""
    from csac_jax.runtime import selftest

    monkeypatch.setattr(selftest, "CHECKS", ())
    flags = "--preset smoke --scene.slots box box --scene.min-blocks 1"
    flags += " --json doctor.json --replay.capacity 128"
    assert cli.main(["doctor", *flags.split()]) == 0
    assert re.search(
        r"memory +0\.00 GiB of [\d.]+ for the state of smoke: replay 0\.00, scenes",
        capsys.readouterr().out,
    )
    result = json.loads((tmp_path / "doctor.json").read_text())
    assert result["config"]["scene"]["slots"] == ["box", "box"]
    cells, obs = 32 * 32, 2
    transition = (
        cells * obs * (3 + 2 + 1) + 4 + 12 + 4 + 1 + 4
    )  # packed maps, action, reward, end, priority
    assert result["memory"]["bytes"]["replay"] == 128 * transition + 8  # head and size


def test_doctor_builds_kernels(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    """Claim: `doctor --build` makes what Warp needs for as many scenes as the preset has."""
    from csac_jax.runtime import selftest
    from csac_jax.sim import physics, warp_physics

    made: list[int] = []
    fake = types.SimpleNamespace(prepared=made.append)
    make = lambda world, cfg: warp_physics.WarpPhysics(world, fake)  # noqa: E731
    monkeypatch.setitem(physics.PHYSICS, "warp", make)
    monkeypatch.setattr(failures, "check_physics", lambda cfg: None)
    monkeypatch.setattr(selftest, "CHECKS", ())
    flags = "--build --sim.physics warp --train.scenes 64"
    assert cli.main(["doctor", *flags.split()]) == 0
    assert made == [64]
    assert "for 64 scenes of fast on Warp" in capsys.readouterr().out


@pytest.mark.parametrize(("found", "said"), [(True, "second library"), (False, "default library")])
def test_doctor_names_the_library(
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    found: bool,
    said: str,
):
    """Claim: `doctor` says by which of XLA's libraries training computes convolutions."""
    from csac_jax.runtime import compiler, selftest

    monkeypatch.setattr(selftest, "CHECKS", ())
    monkeypatch.setattr(compiler, "has_library", lambda: found)
    assert cli.main(["doctor", "--json", "doctor.json"]) == 0
    assert f"training   convolutions by XLA's {said}" in capsys.readouterr().out
    assert json.loads((tmp_path / "doctor.json").read_text())["second_library"] is found


@pytest.mark.parametrize("error", [1.0, float("nan")])
def test_doctor_fails(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, error: float):
    """Claim: a check that fails, or gives NaN, is exit code 1 and one line that names it."""
    from csac_jax.runtime import selftest

    monkeypatch.setattr(
        selftest, "CHECKS", (("sums", lambda: error, 0.5), ("products", lambda: 0.0, 0.5))
    )
    assert cli.main(["doctor"]) == 1
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "self-test failed: sums;" in captured.err


def test_summary_is_printed(capsys: pytest.CaptureFixture):
    """Claim: `eval` prints every metric: shares in per cent, efficiencies in blocks per action, a
    dash where there are no cases."""
    from csac_jax.evaluation import metrics

    summary = {
        "grasp_success": metrics.wilson(9, 10),
        "completion": metrics.wilson(0, 0),
        "action_efficiency": {"value": 1.25, "low": 1.0, "high": 1.5, "n": 10},
        "outcomes": {"lifted": 9},
        "counts": {"grasps": 10},
    }
    evaluation.print_summary("random in 1 episode", summary)
    shown = capsys.readouterr().out
    assert "90.0 %" in shown
    assert "lifted 9" in shown
    assert "1.250" in shown
    assert "125" not in shown  # blocks per action are no share
    assert "-" in next(line for line in shown.splitlines() if "completion" in line)


def test_progress_is_for_terminals(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    """Claim: `eval` says how many episodes are over on a terminal, and nothing elsewhere."""
    monkeypatch.setenv("TERM", "xterm")
    for terminal in ("", "1"):
        monkeypatch.setenv("FORCE_COLOR", terminal)  # Rich takes this for a terminal
        with evaluation.progress_bar() as show:
            show("row", 3, 50)
        shown = capsys.readouterr()
        assert shown.out == ""
        assert ("row" in shown.err and "3/50" in shown.err) == bool(terminal)
        assert bool(shown.err) == bool(terminal)


@pytest.mark.parametrize(("scene", "any_yaw"), [("row", False), ("random", True)])
def test_play_shows_a_case_as_it_is(monkeypatch: pytest.MonkeyPatch, scene: str, any_yaw: bool):
    """Claim: `play` turns a case by quarters at most, so that it can be known again, and a random
    scene by any yaw."""
    turned = []

    def episode(env, *_):
        turned.append(env.any_yaw)
        yield from ()

    monkeypatch.setattr(rollout, "episode", episode)
    play._play(play.PlayOptions(scene=scene), policies.OraclePolicy(SMOKE), {})
    assert turned == [any_yaw]
