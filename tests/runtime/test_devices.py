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


SELECT = """
import csac_jax
from csac_jax.errors import DeviceError
from csac_jax.runtime import devices
try:
    devices.select("{}")
except DeviceError as error:
    print(error)
else:
    import jax
    print(jax.default_backend())
"""


@pytest.mark.parametrize(
    ("name", "said"), [("cpu", "cpu\n"), ("gpu", "device gpu: JAX finds none")]
)
def test_selected_device_goes_before_the_variable(name: str, said: str):
    """Claim: the device that is selected is used, whatever JAX_PLATFORMS says; one that is not
    there is an error."""
    if name == "gpu" and devices.jax.default_backend() == "gpu":
        pytest.skip("there is a GPU")
    done = _python("-c", SELECT.format(name))
    assert done.stdout.startswith(said), done.stderr


def test_device_of_another_kind():
    """Claim: what JAX computes on is known; another kind is refused by its name."""
    devices.require()
    used = devices.jax.default_backend()
    devices.require(used)
    with pytest.raises(DeviceError, match=f"device none: .* leave it out for the {used}"):
        devices.require("none")
