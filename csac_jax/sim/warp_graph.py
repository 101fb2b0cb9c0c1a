"""A step of many Warp launches, repeated: kernels built ahead, memory kept, recorded on CUDA."""

import contextlib
import functools
import gc
import itertools
import os
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import warp as wp

LONGEST = 10  # most steps in one recorded graph


def repeated(step: Callable[[], None], times: int) -> Callable[[], None]:
    """Returns a function that runs `step`, always the same launches, so many times."""
    _load_kernels(step)  # a recording must not load any
    arrays: list[wp.array] = []

    def step_in_place() -> None:
        with _allocated_once(arrays):
            step()

    step_in_place()
    if not wp.get_device().is_cuda:
        return functools.partial(_repeat, step_in_place, times)
    recorded = max(n for n in range(1, LONGEST + 1) if times % n == 0)
    own = wp.ScopedStream(wp.Stream())  # JAX's may be forgotten while it is recorded
    with _no_garbage_collection(), own, wp.ScopedCapture() as capture:
        _repeat(step_in_place, recorded)
    return functools.partial(_launch, capture.graph, times // recorded, arrays)


def _launch(graph: wp.Graph, times: int, _: list[wp.array]) -> None:
    """Runs a graph so many times; the arrays are those it works in, which must outlive it."""
    _repeat(functools.partial(wp.capture_launch, graph), times)


def _repeat(call: Callable[[], None], times: int) -> None:
    for _ in range(times):
        call()


def _load_kernels(step: Callable[[], None]) -> None:
    """Builds and loads the kernels that `step` launches, on all cores: one by one takes minutes.

    So does a query for the best block size, which is replaced here.
    """
    modules: dict[int, dict[Any, None]] = {}

    def note(kernel: Any, *_: Any, block_dim: int = 256, **__: Any) -> None:  # Warp's default
        modules.setdefault(block_dim, {})[kernel.module] = None

    def any_size(*_: Any) -> tuple[int, int]:
        return 256, 1

    with mock.patch.multiple(wp, launch=note, launch_tiled=note, get_suggested_block_size=any_size):
        step()
    for block_dim, used in modules.items():
        wp.force_load(wp.get_device(), list(used), block_dim, max_workers=os.cpu_count())


@contextlib.contextmanager
def _allocated_once(arrays: list[wp.array]) -> Iterator[None]:
    """Makes Warp hand out the arrays of the last such block again, for a graph to keep."""
    places, make = itertools.count(), {name: getattr(wp, name) for name in ("empty", "empty_like")}

    def hand_out(name: str, *args: Any, **kwargs: Any) -> wp.array:
        place = next(places)
        if place == len(arrays):
            arrays.append(make[name](*args, **kwargs))
        return arrays[place]

    empty = functools.partial(hand_out, "empty")

    def full(shape: Any, value: Any, dtype: Any, **kwargs: Any) -> wp.array:
        array = empty(shape, dtype, **kwargs)
        array.fill_(value)
        return array

    def zeros(shape: Any, dtype: Any = float, **kwargs: Any) -> wp.array:
        array = empty(shape, dtype, **kwargs)
        array.zero_()
        return array

    like = functools.partial(hand_out, "empty_like")
    with mock.patch.multiple(wp, empty=empty, empty_like=like, full=full, zeros=zeros):
        yield


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Prevents a crash: CUDA ends the process if a program is freed while a graph is recorded."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
