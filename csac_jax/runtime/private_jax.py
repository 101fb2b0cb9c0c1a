"""Parts of JAX that have no public name. `runtime.host_call` also relies on XLA's binary interface.

Tests of what is built on them show whether a new version of JAX still has them.
"""

from jax._src import compilation_cache


def compress_with_checksum() -> None:
    """Makes JAX compress cached programs by zlib, which notices flipped bits, not by zstandard."""
    for name in ("zstd", "zstandard"):
        if hasattr(compilation_cache, name):
            setattr(compilation_cache, name, None)
