"""Work for several processes of this program, each on a core of its own.

Few scenes give JAX and physics little to share out: such work hardly gains by a second core.
"""

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
_PAUSE = 0.2  # s, after which what the processes say is heard


def cores() -> int:
    """Cores that this process may use: in a container no more than it has time for."""
    allowed = len(os.sched_getaffinity(0))
    try:
        quota, period = _QUOTA.read_text().split()
        return max(1, min(allowed, int(quota) // int(period)))
    except (OSError, ValueError):  # no container, or "max"
        return allowed


def each(
    work: Callable[..., Any],
    tasks: Sequence[tuple],
    jobs: int,
    hear: Callable[..., None],
    finish: Callable[[int, Any], None],
) -> None:
    """Calls `work(say, *task)` for every task, so many at a time.

    One at a time runs in this process. More run in processes of their own, whose JAX computes on
    the CPU. They end at once with an error of any, and with this process. Args: work, a function
    of a module; hear, gets what work gives to `say`; finish, gets the number of a task and its
    result, as they come. Raises FailedError where a process was ended from outside, for want of
    memory for example.
    """
    if min(jobs, len(tasks)) <= 1:
        for number, task in enumerate(tasks):
            finish(number, work(hear, *task))
        return
    with _pool(min(jobs, len(tasks))) as (executor, said):
        numbers = {executor.submit(_run, work, task): n for n, task in enumerate(tasks)}
        left = set(numbers)
        while left:
            done, left = wait(left, _PAUSE, FIRST_COMPLETED)
            while not said.empty():
                hear(*said.get())
            for future in done:
                finish(numbers[future], future.result())


@contextlib.contextmanager
def _pool(jobs: int) -> Iterator[tuple[ProcessPoolExecutor, Any]]:
    """Processes, and the queue of what they say."""
    context = multiprocessing.get_context("spawn")
    free, said = context.SimpleQueue(), context.SimpleQueue()
    mine = sorted(os.sched_getaffinity(0))
    for number in range(jobs):
        free.put(mine[number % len(mine)])
    executor = ProcessPoolExecutor(jobs, context, initializer=_begin, initargs=(free, said))
    try:
        yield executor, said
    except BrokenProcessPool:
        raise FailedError("a process was ended, perhaps for want of memory") from None
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


_said: Any = None  # the queue, in a process of a pool


def _begin(free: Any, said: Any) -> None:
    """Begins a process of a pool."""
    global _said
    _said = said
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; one ends the others
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.sched_setaffinity(0, {free.get()})  # before JAX starts its threads
    from csac_jax.runtime import devices

    devices.select("cpu")


def _end_with_parent() -> None:
    """Ends this process when the one that has the pool is no more, however it ended."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _run(work: Callable[..., Any], task: tuple) -> Any:
    """One task, in a process of a pool."""
    return work(lambda *what: _said.put(what), *task)
