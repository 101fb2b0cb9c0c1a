"""Real runs of the `smoke` preset, stopped by real signals at random moments and resumed."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import pytest

from csac_jax.io import checkpoint
from csac_jax.training import programs
from tests.training.test_step import assert_same

pytestmark = [pytest.mark.mjx, pytest.mark.optax, pytest.mark.slow]

MOMENTS = 5
LINES = ("run ", "compiled in")  # printed with the run's folder, and before its first chunk


def _command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "csac_jax", "train", *map(str, arguments)]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Variables by which processes share compiled programs, so that compiling takes no time."""
    caching = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("compiled")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return {**os.environ, **caching, "PYTHONUNBUFFERED": "1", "TF_CPP_MIN_LOG_LEVEL": "3"}


def _state(run_dir: Path) -> Any:
    program = programs.make(checkpoint.load_config(run_dir))
    return checkpoint.restore(run_dir, jax.eval_shape(lambda: programs.init(program)))[0]


def _run(run_dir: Path, environment: dict[str, str]) -> subprocess.Popen:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(_command("smoke", "--run-dir", run_dir), env=environment, **pipes)


def _read_until(run: subprocess.Popen, start: str) -> None:
    """Reads the run's lines up to the first that begins with `start`."""
    assert run.stdout is not None
    assert any(line.startswith(start) for line in run.stdout), start


@pytest.fixture(scope="module")
def reference(
    tmp_path_factory: pytest.TempPathFactory, environment: dict[str, str]
) -> tuple[Any, dict[str, float]]:
    """Last state of the uninterrupted run, and the time from each kind of line to its end, s."""
    folder = tmp_path_factory.mktemp("reference")
    cold = _command("smoke", "--run-dir", folder / "cold")
    subprocess.run(cold, env=environment, check=True, capture_output=True)
    begun = {}
    with _run(folder / "warm", environment) as run:
        for start in LINES:
            _read_until(run, start)
            begun[start] = time.monotonic()
        run.communicate()
        ended = time.monotonic()
    assert run.returncode == 0
    return _state(folder / "warm"), {start: ended - at for start, at in begun.items()}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("moment", range(MOMENTS))
def test_stopped_run_ends_like_the_uninterrupted(
    number: signal.Signals,
    moment: int,
    tmp_path: Path,
    environment: dict[str, str],
    reference: tuple,
):
    """Claim: a signal saves, says so, exits 130 or 143, and the resumed run ends bit for bit like
    the uninterrupted.

    Every third moment is one of the whole run, the others are of its chunks. Late moments are left
    out: a run that is faster than the reference would be over.
    """
    state, durations = reference
    start = LINES[0 if moment % 3 == 0 else 1]
    delay = random.Random(f"{number} {moment}").uniform(0.0, 0.4) * durations[start]
    with _run(tmp_path / "run", environment) as run:
        _read_until(run, start)
        time.sleep(delay)
        run.send_signal(number)
        output, errors = run.communicate(timeout=300)
    assert run.returncode == 128 + number, errors
    assert "stopped and saved at step" in output, f"{number.name} {delay:.1f} s after '{start}'"
    again = _command("--resume", tmp_path / "run")
    subprocess.run(again, env=environment, check=True, capture_output=True, timeout=300)
    assert_same(_state(tmp_path / "run"), state)
