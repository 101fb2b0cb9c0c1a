"""The networks of a run, and their variables: what gradients change, and statistics of batch norm.

A critic turns maps [N, C, C, I] into Q [N, h, w, OUTPUTS] and features; the actor's head turns the
features into maps of Q's shape. Called with `train`, batch norm takes the statistics of the batch,
else the running ones. A critic of your own is any Flax module of that signature with an attribute
`stride`, C / h; its features have the cells of Q.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from csac_jax.config import DenseNet121, NetConfig, SmallNet
from csac_jax.nets import dense, densenet

STATISTICS = "batch_stats"
_FULL = 640  # px, ours: side of passes of which one state is seen at a time


@dataclasses.dataclass(frozen=True, eq=False)
class Networks:
    """A critic, the actor's head and what they are fed."""

    critic: nn.Module
    head: nn.Module
    stride: int  # cells of the critic's input per cell of its maps, along each axis
    colour: bool  # the critic sees colours
    stack: Callable[..., jax.Array]  # colour or None, height, target or None -> maps [..., H, W, I]
    zoom: int = 0  # pixels of the input per cell of the map; 0: any number of states at a time
    one_vector: bool = False  # the optimiser sees one vector: a GPU is slow with many small arrays

    def inputs(self, colour: jax.Array, height: jax.Array, target: jax.Array | None) -> jax.Array:
        """What the critic is fed [..., H, W, I], from colour [..., H, W, 3], height [..., H, W] m
        and target [..., H, W] bool."""
        return self.stack(colour if self.colour else None, height, target)

    def states_at_once(self, canvas: int) -> int | None:
        """States, of passes of canvas x canvas cells, that the critic sees at a time; None for any.

        DenseNet-121 sees groups of the pixels of one state at 640 px (ours). So all its calls are
        made of the same products, which XLA tunes one by one, and need the memory of one group.
        """
        return max(1, round((_FULL / (self.zoom * canvas)) ** 2)) if self.zoom else None


def _small(cfg: SmallNet) -> Networks:
    stride = cfg.stride // cfg.subcells
    return Networks(dense.Critic(cfg), dense.Head(cfg), stride, cfg.colour, dense.inputs)


def _densenet(cfg: DenseNet121) -> Networks:
    return Networks(
        densenet.DenseNetCritic(cfg),
        densenet.DenseNetHead(cfg),
        cfg.output_stride,
        cfg.colour,
        densenet.inputs,
        zoom=cfg.zoom,
        one_vector=True,
    )


BUILDERS: dict[type, Callable[[Any], Networks]] = {SmallNet: _small, DenseNet121: _densenet}


def make(cfg: NetConfig, critic: Any = None) -> Networks:
    """The networks of a config, or those of the Flax module `critic` with a head of `cfg.head`."""
    if critic is None:
        build = next(BUILDERS[kind] for kind in type(cfg).__mro__ if kind in BUILDERS)
        return build(cfg)
    head = dense.Head(SmallNet(head=cfg.head))
    return Networks(critic, head, critic.stride, cfg.colour, dense.inputs)


def learned(variables: Any) -> Any:
    """The variables that gradients change; the rest are running statistics."""
    return {"params": variables["params"]}


@functools.partial(jax.jit, static_argnums=0)
def _traced_once(net: nn.Module, variables: Any, maps: jax.Array) -> Any:
    """What a net makes of [N, C, C, I], traced once for all looks: to trace DenseNet-121 takes
    seconds."""
    return net.apply(variables, maps)


def apply(networks: Networks, variables: Any, maps: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Q [B, N, ...] and features [B, N, ...] of states of N passes each [B, N, C, C, I]."""
    critic, group = networks.critic, networks.states_at_once(maps.shape[2])
    if group is not None:
        at_once = group if group > 1 else None
        return jax.lax.map(
            lambda one: _traced_once(critic, variables, one), maps, batch_size=at_once
        )
    flat: Any = critic.apply(variables, maps.reshape(-1, *maps.shape[2:]))
    return jax.tree.map(lambda leaf: leaf.reshape(*maps.shape[:2], *leaf.shape[1:]), flat)


def train(net: nn.Module, variables: Any, maps: jax.Array) -> tuple[Any, Any]:
    """Outputs of a net by the statistics of this batch, and the running ones after it, {} without
    batch norm."""
    return net.apply(variables, maps, train=True, mutable=[STATISTICS])


def with_trunk(variables: Any, trunk: Any) -> Any:
    """A critic's variables, leaves [M, T, ...], with `trunk`'s, leaves [...], in each of its
    trunks."""

    def fill(old: jax.Array, new: Any) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(new, old.dtype), old.shape)

    return {
        name: {**modules, "trunk": jax.tree.map(fill, modules["trunk"], trunk[name])}
        for name, modules in variables.items()
    }
