"""Real runs of the `smoke` preset, stopped by real signals at random moments and resumed."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from csac_jax.io import checkpoint
from csac_jax.training import programs

pytestmark = [pytest.mark.mjx, pytest.mark.optax, pytest.mark.slow]

MOMENTS = 5
LINES = ("run ", "compiled in")  # printed with the run's folder, and before its first chunk


def _command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "csac_jax", "train", *map(str, arguments)]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Compiled programs are shared by the processes, so that a moment is one of the run, not of
    compiling."""
    cache = tmp_path_factory.mktemp("compiled")
    caching = {
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return {**os.environ, **caching, "PYTHONUNBUFFERED": "1", "TF_CPP_MIN_LOG_LEVEL": "3"}


def _state(run_dir: Path) -> list[np.ndarray]:
    program = programs.make(checkpoint.load_config(run_dir))
    state, _ = checkpoint.restore(run_dir, jax.eval_shape(lambda: programs.init(program)))
    return [*map(np.asarray, jax.tree.leaves(state.replace(key=jax.random.key_data(state.key))))]


def _run(run_dir: Path, environment: dict[str, str]) -> subprocess.Popen:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(_command("smoke", "--run-dir", run_dir), env=environment, **pipes)


def _read_until(run: subprocess.Popen, start: str) -> None:
    """Reads the run's lines up to the first that begins with `start`."""
    assert run.stdout is not None
    for line in run.stdout:
        if line.startswith(start):
            return
    raise AssertionError(f"no line begins with {start!r}")


@pytest.fixture(scope="module")
def reference(
    tmp_path_factory: pytest.TempPathFactory, environment: dict[str, str]
) -> tuple[list[np.ndarray], dict]:
    """Leaves of the uninterrupted run's last state, and the time from each kind of line to the
    run's end, s."""
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

    Most of a short run is compilation: only every third moment is one of the whole run, the others
    are of its chunks. Late moments are left out: a run that is faster than the reference would be
    over, and have nothing left to save.
    """
    leaves, durations = reference
    run_dir = tmp_path / "run"
    start = LINES[0 if moment % 3 == 0 else 1]
    delay = random.Random(f"{number} {moment}").uniform(0.0, 0.4) * durations[start]
    with _run(run_dir, environment) as run:
        _read_until(run, start)
        time.sleep(delay)
        run.send_signal(number)
        said, complained = run.communicate(timeout=300)
    assert run.returncode == 128 + number, complained
    assert "stopped and saved at step" in said
    ending = said.strip().splitlines()[-1].split(";")[0]
    print(f"{number.name} {delay:.1f} s after '{start}': {ending}")
    again = subprocess.run(
        _command("--resume", run_dir), env=environment, capture_output=True, text=True, timeout=300
    )
    assert again.returncode == 0, again.stderr
    for ours, theirs in zip(_state(run_dir), leaves, strict=True):
        np.testing.assert_array_equal(ours, theirs)
