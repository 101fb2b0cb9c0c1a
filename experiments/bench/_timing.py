"""Times of calls on a busy machine."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax


def medians(calls: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Times calls in turn, `repeats` rounds after a first one; returns median seconds of each."""
    for call in calls.values():
        jax.block_until_ready(call())
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            begun = time.perf_counter()
            jax.block_until_ready(call())
            seconds[name].append(time.perf_counter() - begun)
    return {name: statistics.median(values) for name, values in seconds.items()}
