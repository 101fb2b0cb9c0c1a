"""Processes of one sweep on several hosts, with their devices in one mesh; the first alone logs."""

import jax
import numpy as np
from jax.experimental import multihost_utils

from csac_jax.errors import SettingsError


def join(coordinator: str | None, processes: int | None, process_id: int | None) -> None:
    """Joins the other processes, before JAX is used; JAX detects what is None. `coordinator` is
    address:port of the first. Raises SettingsError if there are none."""
    if processes is not None and process_id is not None and not 0 <= process_id < processes:
        raise SettingsError(f"process_id: must lie in 0 .. {processes - 1}, not {process_id}")
    try:
        jax.distributed.initialize(coordinator, processes, process_id)
    except (ValueError, RuntimeError) as error:
        raise SettingsError(f"coordinator, processes, process_id: {error}") from None


def is_first() -> bool:
    """Returns True in the process that logs."""
    return jax.process_index() == 0


def agree(signal: int | None) -> int | None:
    """Returns the largest signal that any process has seen, or None. All must call it."""
    if jax.process_count() == 1:
        return signal
    return int(np.max(multihost_utils.process_allgather(np.int32(signal or 0)))) or None


def wait(name: str) -> None:
    """Waits until all processes have come to this point."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(name)
