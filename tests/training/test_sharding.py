"""Several devices: eight virtual ones of the CPU, in a process of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import csac_jax
from csac_jax import _guard
from csac_jax.errors import SettingsError
from csac_jax.training import sharding

FLAGS = "--xla_backend_optimization_level=0"
ROOT = Path(csac_jax.__file__).parents[1]


def _eight(*arguments: str, flags: str = "", timeout: float = 300.0) -> dict[str, Any]:
    """Returns what `eight_devices` prints."""
    inherited = os.environ.get("XLA_FLAGS", "")
    flags = f"{inherited} --xla_force_host_platform_device_count=8 {flags}"
    variables = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    variables.pop(_guard.POOL_VARIABLE, None)  # that of this process is for one device
    command = [sys.executable, "-m", "tests.sweeps.eight_devices", *arguments]
    pipes: Any = {"cwd": ROOT, "capture_output": True, "text": True, "timeout": timeout}
    done = subprocess.run(command, env=variables, **pipes)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["devices"] == 8
    return found


def test_eight_devices_are_one(tmp_path: Path):
    """Claim: seeds or scenes over eight devices give the metrics and the state of one, to the
    rounding of sums in another order; each device holds its share; a checkpoint of eight
    resumes bit for bit, and can be read on one. A small step stands in for the learner's."""
    found = _eight("toy", str(tmp_path))
    for shard in ("seeds", "scenes"):
        assert max(found[shard][name] for name in ("metrics", "state", "moved")) < 1e-5, shard
        assert found[shard]["resumed"] == 0.0, shard
    assert found["seeds"]["parts"] == [[1, 8], [1, 3]]
    assert found["scenes"]["parts"] == [[2, 1], [2, 3]]


@pytest.mark.slow
def test_seeds_on_eight_devices_compile_without_shardy():
    """Claim: the learner's step compiles with a seed on each device by the partitioner before
    Shardy. It ended the process on a sort whose keys nobody read."""
    assert _eight("seeds", flags=FLAGS)["used"] == 8


@pytest.mark.slow
def test_eight_devices_learn_as_one():
    """Claim: training steps of `smoke`, a scene on each of eight devices, give what one device
    gives where physics do not round by the batch: scenes and transitions bit for bit, metrics and
    critic to the rounding of sums in another order. 1e-6 is eight times the last bit of 1; eight
    steps take it to one."""
    found = _eight("real", flags=FLAGS, timeout=1200.0)
    assert (found["learned"], found["grasps"] > 0) == (8, True)
    assert found["counts"] == found["scenes"] == found["stored"] == 0
    assert max(found["metrics"], found["critic"]) < 1e-6


def test_what_cannot_be_divided():
    """Claim: a mesh larger than the devices there are is refused, and seeds, scenes or a batch that
    the devices cannot share evenly, by name."""

    class Three:
        size = 3

    for devices in (0, -1, 10_000):
        with pytest.raises(SettingsError, match=f"{devices} asked for, there are"):
            sharding.make(devices)
    sharding.check(Three(), "seeds", 6, 8, 8)
    sharding.check(Three(), "scenes", 1, 6, 9)
    sharding.check(None, "scenes", 1, 7, 5)
    numbers = {"seeds": (8, 6, 9), "train.scenes": (6, 8, 9), "learn.batch": (6, 6, 8)}
    for name, counts in numbers.items():
        with pytest.raises(SettingsError, match=f"{name}: 8"):
            sharding.check(Three(), "seeds" if name == "seeds" else "scenes", *counts)
