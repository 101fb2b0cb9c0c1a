"""Compiled programs on disk, so that the second run of a program need not compile it.

The folder is the user's cache directory, with a part for each kind of machine: on the CPU an entry
is machine code for one processor, which JAX's own key does not name. Nothing here can stop a run: a
damaged entry is compiled again, a folder that cannot be written is not used.
"""

import contextlib
import functools
import hashlib
import os
import platform
from pathlib import Path

import jax

from csac_jax import _guard

LARGEST = 4 * 2**30  # bytes kept per kind of machine; what is unused for longest goes first
SHORTEST = 0.5  # s: what compiles faster is not kept
_ASKED = "/jax/compilation_cache/compile_requests_use_cache"
_HIT = "/jax/compilation_cache/cache_hits"


class _Counter:
    """Programs that this process found in the cache."""

    hits = 0


def enable() -> Path | None:
    """Switches the cache on and returns its folder; None if it is off or cannot be written.

    JAX_COMPILATION_CACHE_DIR chooses the folder, JAX_ENABLE_COMPILATION_CACHE=0 switches it off.
    """
    if not jax.config.jax_enable_compilation_cache:
        return None
    _listen()
    if chosen := jax.config.jax_compilation_cache_dir:
        return Path(chosen)
    folder = _folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.parent.chmod(0o700)
        _date_entries(folder)
    except OSError:
        return None
    if not os.access(folder, os.W_OK | os.X_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", LARGEST)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
    return folder


def _date_entries(folder: Path) -> None:
    """Gives entries without a time of last use the oldest one; JAX fails on them.

    There are some where a process was killed, or where the cache had no limit.
    """
    for entry in folder.glob("*-cache"):
        last_use = entry.with_name(f"{entry.name.removesuffix('-cache')}-atime")
        if not last_use.exists():
            last_use.write_bytes(bytes(8))


def hits() -> int:
    """Programs found in the cache since `enable`, by this process."""
    return _Counter.hits


@functools.cache
def _listen() -> None:
    def count(event: str, **_: object) -> None:
        _Counter.hits += event == _HIT
        if event == _ASKED:
            _quieten()

    jax.monitoring.register_event_listener(count)


@functools.cache
def _quieten() -> None:
    """Silences XLA's C++ log on the CPU, unless the user has chosen a level: it logs a spurious
    warning for each cached program. Failures still raise."""
    if jax.default_backend() == "cpu" and "JAX_LOGGING_LEVEL" not in os.environ:
        jax.config.update("jax_logging_level", "CRITICAL")


def _folder() -> Path:
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "csac_jax" / "xla" / _machine()


def _machine() -> str:
    """Name of the kind of machine: its processor and the threads that programs are cut for."""
    relevant = (platform.machine(), platform.processor(), _processor(), _guard.pool_setting()[1])
    return hashlib.sha256(repr(relevant).encode()).hexdigest()[:16]


def _processor() -> tuple[str, ...]:
    """Model and abilities of the first processor, as Linux states them; none elsewhere."""
    with contextlib.suppress(OSError):
        first = Path("/proc/cpuinfo").read_text().split("\n\n")[0]
        wanted = ("vendor_id", "cpu family", "model", "stepping", "flags", "Features", "CPU part")
        return tuple(
            line
            for line in first.splitlines()
            if line.split("\t")[0].split(":")[0].strip() in wanted
        )
    return ()
