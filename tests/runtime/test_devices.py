"""The choice of JAX's devices."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import csac_jax
from csac_jax.errors import DeviceError
from csac_jax.runtime import devices

ROOT = Path(csac_jax.__file__).parents[1]


def _python(*arguments: str, **options: Any) -> subprocess.CompletedProcess:
    """Runs Python where JAX_PLATFORMS names a device that is not there."""
    env = {**os.environ, "JAX_PLATFORMS": "tpu", "PYTHONPATH": str(ROOT)}
    pipes: Any = {"capture_output": True, "text": True, "timeout": 120}
    return subprocess.run([sys.executable, *arguments], env=env, **pipes, **options)


@pytest.mark.parametrize("arguments", [["train", "smoke"], ["doctor"]])
def test_device_that_is_not_there_is_one_line(arguments: list[str], tmp_path: Path):
    """Claim: a command whose JAX_PLATFORMS names no device of this machine ends with one line and
    exit code 2, and writes nothing."""
    done = _python("-m", "csac_jax", *arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1, done.stderr
    assert "JAX finds no device of JAX_PLATFORMS=tpu; unset it" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_device_of_another_kind():
    """Claim: what JAX computes on is known; another kind is refused by its name."""
    devices.require()
    used = devices.jax.default_backend()
    devices.require(used)
    with pytest.raises(DeviceError, match=f"device none: .* leave it out for the {used}"):
        devices.require("none")
