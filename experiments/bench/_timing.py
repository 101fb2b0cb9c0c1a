"""How long calls take, on a machine that does other things as well."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax


def medians(calls: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Median seconds of every call until its result is there, after one that does not count.

    One after the other in each of `repeats` rounds, so that what else the machine does hits all
    alike.
    """
    for call in calls.values():
        jax.block_until_ready(call())
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            begun = time.perf_counter()
            jax.block_until_ready(call())
            seconds[name].append(time.perf_counter() - begun)
    return {name: statistics.median(values) for name, values in seconds.items()}
