"""Runs side by side whose networks have a device in turn, a few at a time.

All at once, networks that fill a device by themselves take the memory of all for little; one by
one, their many small products leave it waiting (`experiments/bench`).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from csac_jax.config import Config

_AT_ONCE = 5  # networks of DenseNet-121, ours: five seeds are one group, 16 are four, with 21 GB of temporaries


def at_once(cfg: Config, members: int) -> int | None:
    """Of how many of `members` runs the networks are at work at a time, in groups of one size; None
    if of all."""
    if cfg.net.kind == "small":
        return None
    return max(size for size in range(1, min(members, _AT_ONCE) + 1) if members % size == 0)


def grouped(part: Callable[..., Any], size: int) -> Callable[..., Any]:
    """`part`, which vmapped runs in groups of `size`, one after the other; a group of one is not
    vmapped.

    So a branch stays one in groups of one, where vmapped both sides would be run. The size must
    divide what it is vmapped over. `part` may close over no tracer of that vmap.
    """
    apart = jax.custom_batching.custom_vmap(part)

    @apart.def_vmap
    def rule(axis_size: int, in_batched: Any, *given: Any) -> tuple[Any, Any]:
        def every(leaf: jax.Array, batched: bool) -> jax.Array:
            return leaf if batched else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))

        rows = jax.tree.map(every, given, tuple(in_batched))
        out = jax.lax.map(lambda one: part(*one), rows, batch_size=size if size > 1 else None)
        return out, jax.tree.map(lambda _: True, out)

    return apart
