"""Whether a run's replay fits into memory, known before anything is compiled."""

import os

import jax

from csac_jax.config import Config
from csac_jax.replay import ring
from csac_jax.train import step

GIB = 2**30


def limit() -> int:
    """Bytes that the first device can have: its own limit, or all of this machine's memory if it states none (CPUs).

    All, not what is free: the system gives up its caches for a run, so that a smaller number would refuse too much.
    """
    stats = jax.devices()[0].memory_stats() or {}
    return stats.get("bytes_limit") or os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def check_replay(cfg: Config) -> None:
    """Raises ValueError, with the largest capacity that would do, if the ring alone is larger than the memory."""
    slot, available = ring.bytes_needed(1, step.example(cfg)), limit()
    if cfg.replay.capacity * slot > available:
        raise ValueError(
            f"replay.capacity: {cfg.replay.capacity} transitions take {cfg.replay.capacity * slot / GIB:.1f} GiB, "
            f"there are {available / GIB:.1f}; lower --replay.capacity to {available // slot} at the very most"
        )
