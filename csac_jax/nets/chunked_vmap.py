"""Networks of several runs under `vmap`: in which form they work, and how many at a time."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from csac_jax.config import Config, SmallNet

# DenseNet-121s in a chunk (ours): one by one they leave the device waiting, all need much memory.
_LARGEST = 5


class Batching(NamedTuple):
    """The way in which the networks of vmapped runs work."""

    side_by_side: bool = False  # in the form for several runs, see `Networks.side_by_side`
    networks_at_once: int | None = None  # one chunk of `vmap_in_chunks`; None: all


ALONE = Batching()  # a run that is not vmapped


def chunk_size(cfg: Config, runs: int) -> int | None:
    """Returns how many networks work at a time, in equal chunks; None for those of all `runs`."""
    if isinstance(cfg.net, SmallNet):
        return None
    return max(size for size in range(1, _LARGEST + 1) if runs % size == 0)


def vmap_in_chunks(function: Callable[..., Any], size: int) -> Callable[..., Any]:
    """Wraps `function`: under `vmap` it runs in chunks of `size` rows, one after the other.

    `size` divides the vmapped axis. A chunk of one row is not vmapped, so that a branch stays one.
    `function` may close over no tracer of that vmap.
    """
    chunked = jax.custom_batching.custom_vmap(function)

    @chunked.def_vmap
    def rule(axis_size: int, in_batched: Any, *arguments: Any) -> tuple[Any, Any]:
        def batch(leaf: jax.Array, batched: bool) -> jax.Array:
            return leaf if batched else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))

        rows = jax.tree.map(batch, arguments, tuple(in_batched))
        out = jax.lax.map(lambda row: function(*row), rows, batch_size=size if size > 1 else None)
        return out, jax.tree.map(lambda _: True, out)

    return chunked
