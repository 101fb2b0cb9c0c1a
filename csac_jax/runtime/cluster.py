"""The processes of one sweep on several hosts, each with the devices of its own host, in one mesh.

Every process runs the same command and sees the sweep's folder; the first alone logs.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils


class Place(NamedTuple):
    """Where processes meet; JAX detects what is None."""

    coordinator: str | None  # address:port of the first process
    processes: int | None
    process_id: int | None


def join(place: Place) -> None:
    """Joins the other processes, before JAX is used. Raises ValueError if there are none."""
    processes, own = place.processes, place.process_id
    if processes is not None and own is not None and not 0 <= own < processes:
        raise ValueError(f"--process-id: must lie in 0 .. {processes - 1}, not {own}")
    try:
        jax.distributed.initialize(place.coordinator, processes, own)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"--coordinator, --processes, --process-id: {error}") from None


def is_first() -> bool:
    """Whether this process is the one that logs."""
    return jax.process_index() == 0


def agree(signal: int | None) -> int | None:
    """The largest signal that any process has seen, None if there is none. All must call it."""
    if jax.process_count() == 1:
        return signal
    return int(np.max(multihost_utils.process_allgather(np.int32(signal or 0)))) or None


def wait(name: str) -> None:
    """Returns once all processes have come to this point."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(name)
