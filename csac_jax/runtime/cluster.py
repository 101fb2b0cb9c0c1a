"""Several hosts: the processes of one sweep, each with the devices of its own host, in one mesh.

Every process runs the same command. All compute and save; the first alone logs and writes what is
written once. The sweep's folder must be one that all of them see.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils


class Place(NamedTuple):
    """Where to meet; fields that are None are left to what JAX detects."""

    coordinator: str | None  # address:port of the first process
    processes: int | None
    process_id: int | None


def join(place: Place) -> None:
    """Joins the other processes. Call it before anything else of JAX. Raises ValueError if they
    cannot be found."""
    if (
        place.processes is not None
        and place.process_id is not None
        and not 0 <= place.process_id < place.processes
    ):
        raise ValueError(
            f"--process-id: must lie in 0 .. {place.processes - 1}, not {place.process_id}"
        )
    try:
        jax.distributed.initialize(place.coordinator, place.processes, place.process_id)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"--coordinator, --processes, --process-id: {error}") from None


def is_first() -> bool:
    """Whether this process is the one that logs."""
    return jax.process_index() == 0


def agree(signal: int | None) -> int | None:
    """The number of a signal that any process has seen, the largest; None if none has. All must
    call it."""
    if jax.process_count() == 1:
        return signal
    seen = multihost_utils.process_allgather(np.int32(signal or 0))
    return int(np.max(seen)) or None


def wait(name: str) -> None:
    """Returns once all processes have come to this point."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(name)
