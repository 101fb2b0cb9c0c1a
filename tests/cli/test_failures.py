"""The command line where something goes wrong that no argument shows: one line and an exit code."""

import importlib.util
import io
import os
import sys
import threading
import time
from pathlib import Path

import jax.numpy as jnp
import pytest
from rich.console import Console

import csac_jax
from csac_jax import cli, presets
from csac_jax.cli import doctor, failures
from csac_jax.errors import FailedError, SceneError
from csac_jax.io import checkpoint, policy_file
from csac_jax.render import gl
from csac_jax.runtime import cache, signals
from csac_jax.training import loop, programs
from csac_jax.training.callbacks import Summary
from csac_jax.training.progress import Terminal

SMOKE = presets.smoke()


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """An empty folder; no signals are taken over."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(signals, "install", signals.Stop)


def _raises(error: BaseException):
    def fail(*_, **__):
        raise error

    return fail


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (failures.BadArgumentsError("no"), 2, "no"),
        (FailedError("two\n  lines"), 1, "two lines"),
        (SceneError("never at rest"), 1, "never at rest"),
        (
            PermissionError(13, "Permission denied", "a.json"),
            1,
            "[Errno 13] Permission denied: 'a.json'",
        ),
        (KeyboardInterrupt(), 130, "stopped"),
    ],
)
def test_exit_codes(
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    code: int,
    line: str,
):
    """Claim: what a command raises is an exit code and one line, however many its message has."""
    monkeypatch.setitem(cli.COMMANDS, "doctor", _raises(error))
    assert cli.main(["doctor"]) == code
    assert capsys.readouterr() == ("", f"csac-jax: {line}\n")


def test_out_of_memory(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    """Claim: an allocation that XLA refuses is one line with what to lower; other errors of XLA are
    not taken for it."""
    monkeypatch.setitem(cli.COMMANDS, "doctor", lambda _: jnp.zeros(2**48).block_until_ready())
    assert cli.main(["doctor"]) == 1
    shown, complaint = capsys.readouterr()
    assert shown == ""
    assert complaint.startswith("csac-jax: the device is out of memory; lower --replay.capacity")
    assert complaint.count("\n") == 1
    monkeypatch.setitem(cli.COMMANDS, "doctor", _raises(RuntimeError("INTERNAL: no")))
    with pytest.raises(RuntimeError, match="INTERNAL: no"):
        cli.main(["doctor"])


@pytest.mark.parametrize(("arguments", "code"), [([], 2), (["-h"], 0), (["--help"], 0)])
def test_usage(capsys: pytest.CaptureFixture, arguments: list[str], code: int):
    """Claim: the usage, with every command in it, is shown when it is asked for; and with exit code
    2 if nothing is."""
    assert cli.main(arguments) == code
    shown, complaint = capsys.readouterr()
    assert complaint == ""
    commands = [
        line.split()[0] for line in shown.splitlines() if line.startswith("  ") and line[2] != " "
    ]
    assert sorted(set(commands)) == sorted(cli.COMMANDS)


def test_version(capsys: pytest.CaptureFixture):
    """Claim: `--version` prints the version and nothing else."""
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr() == (f"{csac_jax.__version__}\n", "")


@pytest.mark.parametrize(
    ("arguments", "option", "extra"),
    [
        ("train smoke --log tensorboard", "--log tensorboard", "tensorboard"),
        ("train smoke --log tensorboard wandb", "--log tensorboard", "tensorboard"),
        ("report . --out page", "--out", "report"),
        ("play --viewer", "--viewer: there is no display here, and its page", "viewer"),
    ],
)
def test_missing_extra(
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    arguments: str,
    option: str,
    extra: str,
):
    """Claim: an option that needs an extra says how to get it."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(gl, "has_display", lambda: False)
    assert cli.main(arguments.split()) == 2
    wanted = f"csac-jax: {option} needs an extra; run: pip install 'csac-jax[{extra}]'\n"
    assert capsys.readouterr() == ("", wanted)


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (
            FileExistsError(),
            2,
            "there exists; give another --run-dir, or go on with it by --resume",
        ),
        (loop.TrainingError("the loss is not finite"), 1, "the loss is not finite"),
        (checkpoint.CheckpointError("4 is damaged"), 1, "4 is damaged"),
    ],
)
def test_training_that_fails(
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
    code: int,
    line: str,
):
    """Claim: a run that fails is one line and an exit code; a folder that someone else has made
    meanwhile as well."""
    monkeypatch.setattr(cache, "enable", lambda: None)
    monkeypatch.setattr(programs, "make", lambda cfg, **_: None)
    monkeypatch.setattr(loop, "run", _raises(error))
    assert cli.main(["train", "smoke", "--run-dir", "there"]) == code
    assert capsys.readouterr().err == f"csac-jax: {line}\n"


def test_networks_that_cannot_be_restored(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    """Claim: a run whose config can be read and whose networks cannot is one line and exit code 1;
    nothing is made."""
    checkpoint.save(
        Path("run"),
        4,
        {"step": checkpoint.jax.numpy.int32(4)},
        SMOKE,
        {"seconds": 1.0, "grasps": []},
    )
    monkeypatch.setattr(checkpoint, "restore", _raises(checkpoint.CheckpointError("4 is damaged")))
    assert cli.main(["export", "run", "p.safetensors"]) == 1
    assert capsys.readouterr() == ("", "csac-jax: 4 is damaged\n")
    assert not Path("p.safetensors").exists()


@pytest.mark.parametrize("command", ["eval {}", "play --policy {}", "export {} p.safetensors"])
def test_file_that_holds_no_policy(capsys: pytest.CaptureFixture, command: str):
    """Claim: a file that is no policy is one line and exit code 1."""
    Path("x.safetensors").write_bytes(b"\x80\x04not this")
    assert cli.main(command.format("x.safetensors").split()) == 1
    shown, complaint = capsys.readouterr()
    assert complaint.startswith("csac-jax: x.safetensors cannot be read as .safetensors")
    assert (shown, complaint.count("\n")) == ("", 1)


def test_export_overwrites_nothing(capsys: pytest.CaptureFixture):
    """Claim: `export` refuses a file that exists, and leaves it as it is."""
    Path("p.safetensors").write_text("mine")
    assert cli.main(["export", str(policy_file.find("shipped")), "p.safetensors"]) == 2
    assert capsys.readouterr() == ("", "csac-jax: p.safetensors exists; give another name\n")
    assert Path("p.safetensors").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            "train quick --learn.bath 3",
            "Unrecognized options: --learn.bath, 3; perhaps you meant --learn.batch",
        ),
        ("train quick --learn.tau 2", "learn.tau: must be above 0, at most 1, not 2.0"),
        (f"train quick {'x' * 60}", f"Unrecognized options: {'x' * 60}"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
@pytest.mark.parametrize("columns", [None, "40"])
def test_complaint_is_the_same_on_any_terminal(
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    arguments: str,
    line: str,
    encoding: str,
    columns: str | None,
):
    """Claim: the parser's complaint is the whole message in one line, however wide the terminal is
    and whether or not it draws boxes; the terminal's width stays what it was."""
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding=encoding))
    if columns is None:
        monkeypatch.delenv("COLUMNS", raising=False)
    else:
        monkeypatch.setenv("COLUMNS", columns)
    assert cli.main(arguments.split()) == 2
    assert capsys.readouterr().err == f"csac-jax: {line}; see csac-jax train quick --help-all\n"
    assert os.environ.get("COLUMNS") == columns


def test_watchdog_barks(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    """Claim: a self-test that hangs ends the process with one line and exit code 1; after one that
    ends in time nothing waits any more."""
    codes: list[int] = []
    barked = threading.Event()
    monkeypatch.setattr(os, "_exit", lambda code: (codes.append(code), barked.set()))
    before = set(threading.enumerate())
    with doctor._watchdog(60.0, "in time"):
        (timer,) = set(threading.enumerate()) - before
    timer.join(30.0)
    assert not timer.is_alive()
    with doctor._watchdog(0.05, "it hangs"):
        assert barked.wait(30.0)
    assert codes == [1]
    assert capsys.readouterr().err == "csac-jax: it hangs\n"


@pytest.mark.parametrize("columns", ["0", "00", "-5", "x", ""])
def test_lines_are_printed_on_any_terminal(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, columns: str
):
    """Claim: a terminal that says it has no columns, or none that are a number, shows the help and
    the progress."""

    def say(arguments: list[str]) -> int:
        with Terminal(Console()) as terminal:
            terminal.log("compiled")
        return 0

    monkeypatch.setitem(cli.COMMANDS, "doctor", say)
    monkeypatch.setenv("COLUMNS", columns)
    assert cli.main(["doctor"]) == 0
    assert "compiled" in capsys.readouterr().out
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(SystemExit) as ended:
        cli.main(["train", "smoke", "--help-all"])
    assert ended.value.code in (0, None)
    assert "--learn.tau" in capsys.readouterr().out


def test_learning_rate_must_be_finite(capsys: pytest.CaptureFixture):
    """Claim: an infinite step size is one line that names the setting."""
    for name in ("learn.actor-learning-rate", "learn.learning-rate"):
        assert cli.main(["train", "smoke", f"--{name}", "inf"]) == 2
        line = capsys.readouterr().err
        assert line.count("\n") == 1
        assert f"{name.replace('-', '_')}: must be finite, not inf" in line


def test_hundred_thousand_dilations_are_refused(capsys: pytest.CaptureFixture):
    """Claim: a list of 100,000 items is one short line, at once."""
    begun = time.monotonic()
    assert cli.main(["train", "smoke", "--net.dilations", *["1"] * 100_000]) == 2
    line = capsys.readouterr().err
    assert "net.dilations: at most 64 items, not 100000" in line
    assert (line.count("\n"), len(line) < 200) == (1, True)
    assert time.monotonic() - begun < 20.0


def test_result_in_a_missing_folder_is_written(monkeypatch: pytest.MonkeyPatch):
    """Claim: the folder of `--json` is made; where it cannot be, train.json is there all the same,
    and there is one line."""
    monkeypatch.setattr(cache, "enable", lambda: None)
    monkeypatch.setattr(programs, "make", lambda cfg, **_: None)
    summary = Summary(*[0] * len(Summary._fields))
    monkeypatch.setattr(loop, "run", lambda *_, **__: summary)
    assert cli.main(["train", "smoke", "--run-dir", "a", "--json", "new/folder/out.json"]) == 0
    assert Path("new/folder/out.json").is_file()
    assert Path("a/train.json").is_file()
    Path("file").touch()
    assert cli.main(["train", "smoke", "--run-dir", "b", "--json", "file/out.json"]) == 1
    assert Path("b/train.json").is_file()
