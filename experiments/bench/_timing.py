"""Times of calls on a busy machine."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax


def seconds(calls: dict[Any, Callable[[], Any]], repeats: int) -> dict[Any, list[float]]:
    """Times calls in turn, `repeats` rounds after a first one; returns the seconds of each."""
    for call in calls.values():
        jax.block_until_ready(call())
    times: dict[Any, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            begun = time.perf_counter()
            jax.block_until_ready(call())
            times[name].append(time.perf_counter() - begun)
    return times


def medians(calls: dict[Any, Callable[[], Any]], repeats: int) -> dict[Any, float]:
    """Returns the median of each call's `seconds`."""
    return {name: statistics.median(times) for name, times in seconds(calls, repeats).items()}
