"""A cache of compiled programs on disk.

Each kind of machine has its folder: on the CPU an entry is machine code for one processor, which
JAX's own key does not name. Nothing here can stop a run: a damaged entry is compiled again, a
folder that others can write is not used.
"""

import collections
import functools
import hashlib
import os
import platform
import threading
from pathlib import Path

import jax

from csac_jax import _guard, cache_folder
from csac_jax.runtime import private_jax

LARGEST = 4 * 2**30  # bytes per kind of machine; entries unused for longest are deleted first
SHORTEST = 0.5  # s; programs that compile faster are not cached
_ASKED = "/jax/compilation_cache/compile_requests_use_cache"
_HIT = "/jax/compilation_cache/cache_hits"
_PROCESSOR = ("vendor_id", "cpu family", "model", "stepping", "flags", "Features", "CPU part")
_events: collections.Counter[str] = collections.Counter()  # of JAX's, in this process
_hits: collections.Counter[int] = collections.Counter()  # programs found, by thread


def enable() -> Path | None:
    """Switches the cache on and returns its folder; None if it is off or not private.
    JAX_COMPILATION_CACHE_DIR chooses the folder, JAX_ENABLE_COMPILATION_CACHE=0 switches it off."""
    if not jax.config.jax_enable_compilation_cache:
        return None
    _listen()
    private_jax.compress_with_checksum()
    if chosen := jax.config.jax_compilation_cache_dir:
        return Path(chosen)
    if (folder := _folder()) is None:
        return None
    _date_entries(folder)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", LARGEST)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
    return folder


def _date_entries(folder: Path) -> None:
    """Sets the time of last use of entries that a killed process left; JAX fails without."""
    for entry in folder.glob("*-cache"):
        last_use = entry.with_name(f"{entry.name.removesuffix('-cache')}-atime")
        if not last_use.exists():
            last_use.write_bytes(bytes(8))


def hits() -> int:
    """Returns how many programs this thread has found in the cache since `enable`."""
    return _hits[threading.get_ident()]


@functools.cache
def _listen() -> None:
    jax.monitoring.register_event_listener(_on_event)


def _on_event(event: str, **_: object) -> None:
    """Counts JAX's events, and silences XLA's C++ log on a CPU unless the user has chosen a level:
    it has a spurious warning for each program. Failures still raise."""
    _events[event] += 1
    _hits[threading.get_ident()] += event == _HIT
    first = event == _ASKED and _events[event] == 1
    if first and jax.default_backend() == "cpu" and "JAX_LOGGING_LEVEL" not in os.environ:
        jax.config.update("jax_logging_level", "CRITICAL")


def _folder() -> Path | None:
    cpu = platform.machine(), platform.processor(), _processor(), _guard.pool_setting()[1]
    machine = hashlib.sha256(repr((*cpu, "zlib")).encode()).hexdigest()[:16]
    return cache_folder.private("xla", machine)


def _processor() -> tuple[str, ...]:
    """Returns model and abilities of the first processor, as Linux states them."""
    stated = Path("/proc/cpuinfo")
    first = stated.read_text().split("\n\n")[0] if stated.exists() else ""
    return tuple(line for line in first.splitlines() if line.split("\t")[0] in _PROCESSOR)
