"""Parts of JAX that have no public name. `runtime.host_call` also relies on XLA's interface."""

from jax._src import compilation_cache


def compress_with_checksum() -> None:
    """Makes JAX compress cached programs by zlib, which notices flipped bits, not by zstandard."""
    for name in ("zstd", "zstandard"):
        if hasattr(compilation_cache, name):
            setattr(compilation_cache, name, None)
