"""Work for several processes of this program, each on its core: one hardly gains by a second."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from csac_jax.errors import FailedError

_QUOTA = Path("/sys/fs/cgroup/cpu.max")  # microseconds of all cores in each period, or "max"
_PAUSE = 0.2  # s between looks at the queue


def cores() -> int:
    """Returns the cores that this process may use, within the quota of a container."""
    allowed = len(os.sched_getaffinity(0))
    with contextlib.suppress(OSError, ValueError):  # no container, or "max"
        quota, period = map(int, _QUOTA.read_text().split())
        return max(1, min(allowed, quota // period))
    return allowed


def each(
    work: Callable[..., Any],
    tasks: Sequence[tuple],
    jobs: int,
    on_progress: Callable[..., None],
    on_done: Callable[[int, Any], None],
) -> None:
    """Calls `work(report, *task)`, a function of a module, for every task, `jobs` at a time.

    One at a time runs in this process. More run in processes of their own, whose JAX computes on
    the CPU. All end with the first error, and with this process. Args: on_progress, gets what work
    reports; on_done, gets the number of a task and its result. Raises FailedError if a process was
    ended from outside, as for lack of memory.
    """
    if min(jobs, len(tasks)) <= 1:
        for number, task in enumerate(tasks):
            on_done(number, work(on_progress, *task))
        return
    with _pool(min(jobs, len(tasks))) as (executor, reports):
        numbers = {executor.submit(_run, work, task): n for n, task in enumerate(tasks)}
        left = set(numbers)
        while left:
            done, left = wait(left, _PAUSE, FIRST_COMPLETED)
            while not reports.empty():
                on_progress(*reports.get())
            for future in done:
                on_done(numbers[future], future.result())


@contextlib.contextmanager
def _pool(jobs: int) -> Iterator[tuple[ProcessPoolExecutor, Any]]:
    context = multiprocessing.get_context("spawn")
    free, reports = context.SimpleQueue(), context.SimpleQueue()
    allowed = sorted(os.sched_getaffinity(0))
    for number in range(jobs):
        free.put(allowed[number % len(allowed)])
    executor = ProcessPoolExecutor(jobs, context, initializer=_begin, initargs=(free, reports))
    try:
        yield executor, reports
    except BrokenProcessPool:
        raise FailedError("a process was ended, perhaps for lack of memory") from None
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


_reports: Any = None  # the queue, in a process of a pool


def _begin(free: Any, reports: Any) -> None:
    global _reports
    _reports = reports
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; one ends the others
    end_with_parent()
    os.sched_setaffinity(0, {free.get()})  # before JAX starts its threads
    from csac_jax.runtime import devices

    devices.select("cpu")


def end_with_parent() -> None:
    """Ends this process once the one that started it has ended, however that was."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _run(work: Callable[..., Any], task: tuple) -> Any:
    return work(lambda *report: _reports.put(report), *task)
