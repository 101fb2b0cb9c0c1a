"""Compiled programs on disk, so that the second run of a program need not compile it.

The folder is the user's cache directory, a part of its own per kind of machine: on the CPU an entry
is machine code for the processor that compiled it, and JAX's own key does not name the processor.
Nothing here can stop a run: an entry that is missing or damaged is compiled anew, a folder that
cannot be written is not used.
"""

import contextlib
import functools
import hashlib
import os
import platform
from pathlib import Path

import jax

from csac_jax import _guard

LARGEST = 4 * 2**30  # bytes kept per kind of machine; the oldest entries go first
SHORTEST = 0.5  # s: what compiles faster is not kept
_ASKED = "/jax/compilation_cache/compile_requests_use_cache"
_HIT = "/jax/compilation_cache/cache_hits"


class _Counter:
    """Programs that this process found in the cache."""

    hits = 0


def enable() -> Path | None:
    """Switches the cache on and returns its folder; None if the user has switched it off or it
    cannot be written.

    A folder that the user has chosen (JAX_COMPILATION_CACHE_DIR) stays.
    JAX_ENABLE_COMPILATION_CACHE=0 switches it off.
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
    except OSError:
        return None
    if not os.access(folder, os.W_OK | os.X_OK):
        return None
    _prune(folder, LARGEST)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
    return folder


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
    """On the CPU XLA cries out at every entry: it counts its own tuning, `prefer-no-gather`, among
    what processors can do. Its C++ log is silenced there, unless the user has chosen a level;
    failures still raise."""
    if jax.default_backend() == "cpu" and "JAX_LOGGING_LEVEL" not in os.environ:
        jax.config.update("jax_logging_level", "CRITICAL")


def _folder() -> Path:
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "csac_jax" / "xla" / _machine()


def _machine() -> str:
    """Name of the kind of machine: its processor with all that it can do, and the threads that
    programs are cut for."""
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


def _prune(folder: Path, largest: int) -> None:
    """Deletes the oldest entries until those left take at most `largest` bytes."""
    entries = []
    for path in folder.iterdir():
        with contextlib.suppress(OSError):  # another run may prune as well
            entries.append((path.stat().st_mtime, path.stat().st_size, path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= largest:
            return
        with contextlib.suppress(OSError):
            path.unlink()
            total -= size
