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

from csac_jax.train import checkpoint, step

pytestmark = [pytest.mark.mjx, pytest.mark.optax, pytest.mark.slow]

MOMENTS = 5


def _command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "csac_jax", "train", *map(str, arguments)]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Compiled programs are shared by the processes, so that a moment is one of the run, not of compiling."""
    cache = tmp_path_factory.mktemp("compiled")
    return {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}


def _state(run_dir: Path) -> list[np.ndarray]:
    program = step.make(checkpoint.load_config(run_dir))
    state, _ = checkpoint.restore(run_dir, jax.eval_shape(lambda: step.init(program)))
    return [np.asarray(leaf) for leaf in jax.tree.leaves(state.replace(key=jax.random.key_data(state.key)))]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory, environment: dict[str, str]) -> tuple[list[np.ndarray], float]:
    """Leaves of the uninterrupted run's last state, and how long a run takes once its folder is there, s."""
    folder = tmp_path_factory.mktemp("reference")
    subprocess.run(_command("smoke", "--run-dir", folder / "cold"), env=environment, check=True, capture_output=True)
    with subprocess.Popen(
        _command("smoke", "--run-dir", folder / "warm"), env=environment, stdout=subprocess.PIPE
    ) as run:
        assert run.stdout is not None
        run.stdout.readline()
        begun = time.monotonic()
        run.communicate()
    assert run.returncode == 0
    return _state(folder / "warm"), time.monotonic() - begun


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("moment", range(MOMENTS))
def test_stopped_run_ends_like_the_uninterrupted(
    number: signal.Signals, moment: int, tmp_path: Path, environment: dict[str, str], reference: tuple
):
    """Claim: a signal saves, says so, exits 130 or 143, and the resumed run ends bit for bit like the uninterrupted."""
    leaves, duration = reference
    run_dir = tmp_path / "run"
    delay = random.Random(f"{number} {moment}").uniform(0.0, 0.95) * duration
    with subprocess.Popen(
        _command("smoke", "--run-dir", run_dir),
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as run:
        assert run.stdout is not None
        run.stdout.readline()  # the run has begun
        time.sleep(delay)
        run.send_signal(number)
        said, complained = run.communicate(timeout=300)
    assert run.returncode == 128 + number, complained
    assert "stopped and saved at step" in said
    print(f"{number.name} after {delay:.1f} of {duration:.1f} s: {said.splitlines()[-1] or said.splitlines()[-2]}")
    resumed = subprocess.run(
        _command("--resume", run_dir), env=environment, capture_output=True, text=True, timeout=300
    )
    assert resumed.returncode == 0, resumed.stderr
    for ours, theirs in zip(_state(run_dir), leaves, strict=True):
        np.testing.assert_array_equal(ours, theirs)
