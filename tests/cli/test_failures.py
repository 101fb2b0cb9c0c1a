"""Errors of a command that no argument shows: one line and an exit code."""

import importlib.util
import io
import os
import sys
import threading
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import pytest

import csac_jax
from csac_jax import algorithms, cli, presets
from csac_jax.cli import doctor
from csac_jax.config import Config
from csac_jax.errors import FailedError, SceneError, SettingsError
from csac_jax.io import policy_file
from csac_jax.render import gl
from csac_jax.runtime import cache, signals
from csac_jax.training import loop, programs
from csac_jax.training.callbacks import RunInfo, Summary

SMOKE = presets.smoke()


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Works in an empty folder; takes over no signals; compiles nothing."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(signals, "install", signals.Stop)
    monkeypatch.setattr(cache, "enable", lambda: None)


def _raises(error: BaseException):
    def fail(*_, **__):
        raise error

    return fail


def _run(capsys: pytest.CaptureFixture, arguments: str) -> tuple[int, str, str]:
    return cli.main(arguments.split()), *capsys.readouterr()


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (SettingsError("no"), 2, "no"),
        (FailedError("two\n  lines"), 1, "two lines"),
        (SceneError("never at rest"), 1, "never at rest"),
        (PermissionError(13, "Denied", "a.json"), 1, "[Errno 13] Denied: 'a.json'"),
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
    assert _run(capsys, "doctor") == (code, "", f"csac-jax: {line}\n")


def test_out_of_memory(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    """Claim: an allocation that XLA refuses is one line with what to lower; other errors of XLA are
    not taken for it."""
    monkeypatch.setitem(cli.COMMANDS, "doctor", lambda _: jnp.zeros(2**48).block_until_ready())
    code, shown, line = _run(capsys, "doctor")
    assert (code, shown, line.count("\n")) == (1, "", 1)
    assert line.startswith("csac-jax: the device is out of memory; lower --replay.capacity")
    monkeypatch.setitem(cli.COMMANDS, "doctor", _raises(RuntimeError("INTERNAL: no")))
    with pytest.raises(RuntimeError, match="INTERNAL: no"):
        cli.main(["doctor"])


def test_usage_and_version(capsys: pytest.CaptureFixture):
    """Claim: the usage, with every command in it, is shown when it is asked for, and with exit code
    2 if nothing is; `--version` prints the version and nothing else."""
    for arguments, wanted in (("", 2), ("-h", 0), ("--help", 0)):
        code, shown, line = _run(capsys, arguments)
        assert (code, line) == (wanted, "")
        rows = [row.split()[0] for row in shown.splitlines() if row[:2] == "  " and row[2] != " "]
        assert sorted(set(rows)) == sorted(cli.COMMANDS)
        assert not shown or all(name in shown for name in algorithms.ALGORITHMS)
    assert _run(capsys, "--version") == (0, f"{csac_jax.__version__}\n", "")


@pytest.mark.parametrize(
    ("arguments", "option", "extra"),
    [
        ("train smoke --log tensorboard wandb", "--log tensorboard", "tensorboard"),
        ("report . --out page", "--out", "report"),
        ("serve shipped --mcp", "--mcp", "mcp"),
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
    wanted = f"csac-jax: {option} needs an extra; run: pip install 'csac-jax[{extra}]'\n"
    assert _run(capsys, arguments) == (2, "", wanted)


@pytest.mark.parametrize("option", ["eval shipped --json", "report . --markdown", "play --png"])
def test_a_file_that_cannot_be_written_is_named_first(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, option: str
):
    """Claim: a folder in the place of a file to write, and a file in the place of its folder, are
    refused before any work."""
    Path("folder.png").mkdir()
    Path("file").touch()
    for place, fault in (("folder.png", "is a folder"), ("file/new.png", "that you may write")):
        code, shown, line = _run(capsys, f"{option} {place}")
        assert (code, shown, line.count("\n")) == (2, "", 1)
        assert fault in line


def test_names_that_stdout_cannot_encode_have_escapes(monkeypatch: pytest.MonkeyPatch):
    """Claim: a latin-1 stdout shows other letters, and bytes that are no UTF-8, with escapes."""
    stdout = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    monkeypatch.setattr(sys, "stdout", stdout)
    monkeypatch.setitem(cli.COMMANDS, "doctor", lambda _: print("a\u5b66\udcff") or 0)
    assert cli.main(["doctor"]) == 0
    assert stdout.buffer.getvalue() == b"a\\u5b66\\udcff\n"


def test_export_overwrites_nothing(capsys: pytest.CaptureFixture):
    """Claim: `export` refuses a file that exists, and leaves it as it is."""
    Path("p.safetensors").write_text("mine")
    wanted = (2, "", "csac-jax: p.safetensors exists; give another name\n")
    assert _run(capsys, f"export {policy_file.find('shipped')} p.safetensors") == wanted
    assert Path("p.safetensors").read_text() == "mine"


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


def test_result_in_a_missing_folder_is_written(monkeypatch: pytest.MonkeyPatch):
    """Claim: the folder of `--json` is made; where it cannot be, train.json is there all the same,
    and there is one line."""
    monkeypatch.setattr(programs, "make", lambda cfg, **_: None)
    summary = Summary(*[0] * len(Summary._fields))

    def run(cfg: Config, folder: Path, *others: Any) -> Summary:
        (record,) = others[-1]
        record.begin(RunInfo(cfg, folder, 0))
        record.end(summary)
        return summary

    monkeypatch.setattr(loop, "run", run)
    assert cli.main(["train", "smoke", "--run-dir", "a", "--json", "new/folder/out.json"]) == 0
    assert Path("new/folder/out.json").is_file()
    assert Path("a/train.json").is_file()
    monkeypatch.setattr(loop, "run", lambda *of, **_: Path("file").touch() or run(*of))
    assert cli.main(["train", "smoke", "--run-dir", "b", "--json", "file/out.json"]) == 1
    assert Path("b/train.json").is_file()
