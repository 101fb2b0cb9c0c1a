"""The processes of one sweep on several hosts, each with the devices of its own host, in one mesh.

Every process runs the same command and sees the sweep's folder; the first alone logs.
"""

import jax
import numpy as np
from jax.experimental import multihost_utils


def join(coordinator: str | None, processes: int | None, process_id: int | None) -> None:
    """Joins the other processes, before JAX is used; it detects what is None.

    Args: coordinator, address:port of the first process. Raises ValueError if there are none.
    """
    if processes is not None and process_id is not None and not 0 <= process_id < processes:
        raise ValueError(f"--process-id: must lie in 0 .. {processes - 1}, not {process_id}")
    try:
        jax.distributed.initialize(coordinator, processes, process_id)
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
