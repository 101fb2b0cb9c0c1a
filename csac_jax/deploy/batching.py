"""Requests that wait, answered in batches by threads; nobody waits long, and none in vain."""

import asyncio
import collections
import contextlib
import dataclasses
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

MOST_WAITING = 64  # items
LONGEST = 0.5  # s, expected until the answer to an item that finds others waiting; at times twice
_FORGETTING = 0.2  # share of the newest batch in the pace


class FullError(Exception):
    """Too many requests wait already."""


@dataclasses.dataclass(frozen=True, eq=False)
class Pending:
    """An item that waits, and where its answer goes."""

    item: Any
    answer: asyncio.Future[Any]

    @property
    def has_left(self) -> bool:
        """Returns True if nobody waits for the answer."""
        return self.answer.cancelled()


class Batcher:
    """A queue on the event loop, which threads answer batch by batch."""

    def __init__(
        self,
        answer: Callable[[list[Pending]], Sequence[Any]],
        batch_size: Callable[[Sequence[Any]], int],
        threads: int,
    ) -> None:
        """Makes an empty queue.

        `answer` returns an answer or an exception for each entry, in a thread. `batch_size` returns
        how many of the first items go together.
        """
        self._answer, self._batch_size = answer, batch_size
        self._waiting: collections.deque[Pending] = collections.deque()
        self._pool = ThreadPoolExecutor(threads, "decide")
        self._threads = self._free = threads
        self._pace = 0.0  # s per item, of one thread
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def is_full(self) -> bool:
        """Returns True if items wait, and one more would be answered too late."""
        waiting = len(self._waiting)
        seconds = (waiting / self._threads + 1.0) * self._pace
        return waiting >= MOST_WAITING or (waiting > 0 and seconds > LONGEST)

    async def ask(self, item: Any) -> Any:
        """Returns the answer to an item. Cancel it to give up. Raises FullError."""
        if self.is_full:
            raise FullError("too many requests wait; ask again later")
        entry = Pending(item, asyncio.get_running_loop().create_future())
        self._waiting.append(entry)
        if self._free:
            self._free -= 1
            self._tasks.add(task := asyncio.create_task(self._work()))
            task.add_done_callback(self._tasks.discard)
        try:
            return await entry.answer
        except asyncio.CancelledError:
            with contextlib.suppress(ValueError):  # it was taken
                self._waiting.remove(entry)
            raise

    async def _work(self) -> None:
        """Answers batches until nothing waits."""
        loop = asyncio.get_running_loop()
        while self._waiting:
            size = self._batch_size([entry.item for entry in self._waiting])
            batch = [self._waiting.popleft() for _ in range(size)]
            begun = time.perf_counter()
            try:
                answers = await loop.run_in_executor(self._pool, self._answer, batch)
            except Exception as error:
                answers = [error] * size
            seconds = (time.perf_counter() - begun) / size
            self._pace += _FORGETTING * (seconds - self._pace)
            for entry, answer in zip(batch, answers, strict=True):
                _deliver(entry.answer, answer)
        self._free += 1


def _deliver(future: asyncio.Future[Any], answer: Any) -> None:
    if future.cancelled():
        return
    if isinstance(answer, Exception):
        future.set_exception(answer)
    else:
        future.set_result(answer)
