"""Several processes on one machine, with a small step in place of the learner's."""

import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import csac_jax
from csac_jax.sweeps.runner import SUMMARY
from tests.training import test_loop

ROOT = Path(csac_jax.__file__).parents[1]


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def _sweep(folder: Path, processes: int, shard: str = "seeds", after: int = 0) -> list[int]:
    """Returns the exit codes of the processes of a sweep."""
    command = [sys.executable, "-m", "tests.sweeps.one_process", str(folder), str(after), shard]
    place = [f"127.0.0.1:{_free_port()}", str(processes)]
    variables = {**os.environ, "JAX_PLATFORMS": "cpu"}
    variables.pop("XLA_FLAGS", None)
    pipes: Any = {"cwd": ROOT, "env": variables, "stderr": subprocess.PIPE, "text": True}
    numbers = [[*place, str(k)] for k in range(processes)] if processes > 1 else [[]]
    runs = [subprocess.Popen([*command, *number], **pipes) for number in numbers]
    try:
        said = [run.communicate(timeout=300)[1] for run in runs]
    finally:
        for run in runs:
            run.kill()
    assert all(run.returncode in (0, 15) for run in runs), said
    return [run.returncode for run in runs]


def _logs(folder: Path) -> dict[str, list[dict]]:
    """Returns every run's lines, without what depends on the clock."""
    return {path.parent.name: test_loop._log(path.parent) for path in folder.rglob("metrics.jsonl")}


def _assert_close(ours: dict[str, list[dict]], theirs: dict[str, list[dict]]) -> None:
    assert ours.keys() == theirs.keys() == {"seed-0", "seed-1"}
    for name, log in ours.items():
        assert len(log) == len(theirs[name]) == 3
        for line, other in zip(log, theirs[name], strict=True):
            assert line.pop("outcomes") == other.pop("outcomes")
            assert line == pytest.approx(other, rel=1e-5, abs=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("shard", ["seeds", "scenes"])
def test_two_processes_are_one(shard: str, tmp_path: Path):
    """Claim: a sweep over two processes has the metrics of one over a single process, to the
    rounding of sums in another order; stopped by a signal to one of them, both save and end, and it
    resumes as if nothing had happened."""
    assert _sweep(tmp_path / "one", 1) == [0]
    assert _sweep(tmp_path / "two", 2, shard) == [0, 0]
    _assert_close(_logs(tmp_path / "two"), _logs(tmp_path / "one"))
    assert _sweep(tmp_path / "again", 2, shard, after=1) == [15, 15]
    assert all(len(log) == 1 for log in _logs(tmp_path / "again").values())
    assert _sweep(tmp_path / "again", 2, shard) == [0, 0]
    assert _logs(tmp_path / "again") == _logs(tmp_path / "two")
    names = {path.name for path in (tmp_path / "two").iterdir()}
    assert names == {".lock", "a", "groups", SUMMARY, "sweep.json"}
