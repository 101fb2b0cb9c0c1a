"""Processes that each have a core."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from csac_jax.errors import FailedError
from csac_jax.runtime import processes
from tests.runtime import workers

_NAMES = "abcd"


def _each(work: Any, jobs: int, folder: Path) -> tuple[dict[int, Any], list[tuple]]:
    """Returns results of tasks by number, and their reports."""
    results: dict[int, Any] = {}
    reports: list[tuple] = []
    tasks = [(name, folder, jobs) for name in _NAMES]
    processes.each(work, tasks, jobs, lambda *r: reports.append(r), results.__setitem__)
    return results, reports


def test_each_process_has_a_core(tmp_path: Path):
    """Claim: results come with their tasks' numbers, from processes with a core each, that compute
    on the CPU; their reports come in order."""
    found, heard = _each(workers.where, 2, tmp_path)
    assert "".join(found[number][0] for number in range(4)) == _NAMES
    by_process = {process: cores for _, cores, process, _ in found.values()}
    assert len(by_process.keys() - {os.getpid()}) == 2
    assert all(len(cores) == 1 for cores in by_process.values())
    every = set.union(*by_process.values()) & os.sched_getaffinity(0)
    assert len(every) == min(2, processes.cores())
    assert {backend for *_, backend in found.values()} == {"cpu"}
    for name in _NAMES:
        assert [number for said, number in heard if said == name] == [1, 2]


def test_one_at_a_time_runs_here(tmp_path: Path):
    """Claim: one job needs no process, and keeps all cores."""
    found, heard = _each(workers.where, 1, tmp_path)
    assert {process for _, _, process, _ in found.values()} == {os.getpid()}
    assert found[0][1] == os.sched_getaffinity(0)
    assert heard[:2] == [("a", 1), ("a", 2)]


def test_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: as many as the scheduler allows, fewer where a container has less time."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    quota = tmp_path / "cpu.max"
    monkeypatch.setattr(processes, "_QUOTA", quota)
    assert processes.cores() == 8
    for text, cores in {"max 100000": 8, "250000 100000": 2, "50000 100000": 1, "-": 8}.items():
        quota.write_text(text)
        assert processes.cores() == cores


@pytest.mark.parametrize(("work", "kind"), [("fails", ValueError), ("is_killed", FailedError)])
def test_errors(work: str, kind: type[Exception], tmp_path: Path):
    """Claim: an error of the work is raised here, the end of a process is one line."""
    with pytest.raises(kind) as raised:
        _each(getattr(workers, work), 2, tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_signals_end_all(number: signal.Signals, tmp_path: Path):
    """Claim: a signal to the program alone ends all its processes at once."""
    program = (
        "import pathlib, sys\nfrom csac_jax.runtime import processes\n"
        "from tests.runtime import workers\n"
        "if __name__ == '__main__':\n"
        "    tasks = [(pathlib.Path(sys.argv[1]),)] * 2\n"
        "    processes.each(workers.waits, tasks, 2, print, print)\n"
    )
    script, folder = tmp_path / "program.py", tmp_path / "begun"
    script.write_text(program)
    folder.mkdir()
    root = str(Path(__file__).parents[2])
    process = subprocess.Popen(
        [sys.executable, str(script), str(folder)],
        env={**os.environ, "PYTHONPATH": root},
        stderr=subprocess.DEVNULL,
    )
    _wait_until(lambda: len(list(folder.iterdir())) == 2)
    process.send_signal(number)
    assert process.wait(20) == -number
    _wait_until(lambda: not any(_runs(int(one.name)) for one in folder.iterdir()), 5)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def _wait_until(holds: Any, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)
