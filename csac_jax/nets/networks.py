"""Which network a config asks for, and its variables: what gradients change, and running statistics
of batch norm.

Both kinds have a critic, maps [B, C, C, I] -> Q [B, h, w, OUTPUTS] and features, and an actor's
head, features -> maps of the same shape. Called with `train`, batch norm takes the statistics of
the batch, else the running ones.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from csac_jax.config import NetConfig
from csac_jax.nets import dense, densenet

STATISTICS = "batch_stats"
_FULL = 640  # px, ours: side of passes of which one state is seen at a time

Critic = dense.Critic | densenet.Critic
Head = dense.Head | densenet.Head


def critic(cfg: NetConfig) -> Critic:
    """The critic of a config."""
    return dense.Critic(cfg) if cfg.kind == "small" else densenet.Critic(cfg)


def head(cfg: NetConfig) -> Head:
    """The actor's head of a config."""
    return dense.Head(cfg) if cfg.kind == "small" else densenet.Head(cfg)


def stride(cfg: NetConfig) -> int:
    """Cells of the net's input per cell of its maps, along each axis."""
    return cfg.stride // cfg.subcells if cfg.kind == "small" else cfg.output_stride


def inputs(
    cfg: NetConfig, colour: jax.Array, height: jax.Array, target: jax.Array | None
) -> jax.Array:
    """Maps that the net is fed [..., H, W, I] from colour [..., H, W, 3], height [..., H, W] m,
    target [..., H, W]."""
    shown = colour if cfg.colour else None
    if cfg.kind == "small":
        return dense.inputs(shown, height, target, cfg.border)
    return densenet.inputs(shown, height, target)


def learned(variables: Any) -> Any:
    """The variables that gradients change; the rest are running statistics."""
    return {"params": variables["params"]}


def states_at_once(cfg: NetConfig, canvas: int) -> int | None:
    """How many states, of passes of canvas x canvas cells, a critic sees at a time; None for any
    number.

    DenseNet-121 sees groups of the pixels of one state at 640 px (ours): so all looks are made of
    the same products, which XLA tries out one by one, and need the memory of one group.
    """
    if cfg.kind == "small":
        return None
    return max(1, round((_FULL / (cfg.zoom * canvas)) ** 2))


@functools.partial(jax.jit, static_argnums=0)
def _seen(net: Critic, variables: Any, fed: jax.Array) -> Any:
    """What a net makes of [N, C, C, I], traced once for all looks: to trace DenseNet-121 takes
    seconds."""
    return net.apply(variables, fed)


def look(net: Critic, variables: Any, fed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Q [B, N, ...] and features [B, N, ...] of states of N passes each [B, N, C, C, I]."""
    group = states_at_once(net.cfg, fed.shape[2])
    if group is not None:
        return jax.lax.map(
            lambda one: _seen(net, variables, one), fed, batch_size=group if group > 1 else None
        )
    flat: Any = net.apply(variables, fed.reshape(-1, *fed.shape[2:]))
    return jax.tree.map(lambda leaf: leaf.reshape(*fed.shape[:2], *leaf.shape[1:]), flat)


def train(net: Critic | Head, variables: Any, fed: jax.Array) -> tuple[Any, Any]:
    """Outputs of a net by the statistics of this batch, and the running ones after it, {} without
    batch norm."""
    return net.apply(variables, fed, train=True, mutable=[STATISTICS])


def with_trunk(variables: Any, trunk: Any) -> Any:
    """A critic's variables, leaves [M, T, ...], with `trunk`'s, leaves [...], in each of its
    trunks."""

    def fill(old: jax.Array, new: Any) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(new, old.dtype), old.shape)

    return {
        name: {**modules, "trunk": jax.tree.map(fill, modules["trunk"], trunk[name])}
        for name, modules in variables.items()
    }
