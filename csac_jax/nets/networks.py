"""The networks of a run, and their variables: parameters and running statistics of batch norm.

A critic turns maps [N, C, C, I] into Q [N, h, w, OUTPUTS] and features; the actor's head turns the
features into maps of Q's shape. A custom critic is any Flax module of that signature with an
attribute `stride`, C / h; its features have the cells of Q.
"""

import dataclasses
import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import NetConfig, SmallNet
from csac_jax.nets import dense, densenet

BARE = 0.002  # m: lower cells are bare table, whose colour no net sees
FINGERS_MEAN = np.array([0.1, 0.014, 0.02], np.float32)  # m, `grippers.Fingers`; ours
FINGERS_STD = np.array([0.025, 0.004, 0.004], np.float32)
_FULL = 640  # px (ours): side of passes at which the critic gets one state at a time


@dataclasses.dataclass(frozen=True, eq=False)
class Networks:
    """Critic, the actor's head, and how their inputs are scaled."""

    critic: nn.Module
    head: nn.Module
    stride: int  # cells of the critic's input per cell of its maps, along each axis
    colour: bool  # the critic sees colours
    height_scale: float = 0.05  # m, becomes 1; a block's height
    colour_scale: Any = (0.5, 1.0)  # mean and standard deviation, of all colours or of each [3]
    upsample: int = 0  # pixels of the input per cell of the map; 0: all states at a time
    one_vector: bool = False  # the optimiser sees one vector: a GPU is slow with many small arrays

    def inputs(
        self,
        colour: jax.Array,
        height: jax.Array,
        target: jax.Array | None,
        fingers: jax.Array | None = None,
    ) -> jax.Array:
        """Builds the critic's input maps [..., H, W, I].

        In order: 3 of `colour` [..., H, W, 3] in 0..1 if it is seen, 1 of `height` [..., H, W] m, 3
        of `fingers` [..., 3] m, 1 of `target` [..., H, W] bool. Bare table is 0, like cells outside
        of a rotated map.
        """
        maps = [jnp.maximum(height, 0.0)[..., None] / self.height_scale]
        if self.colour:
            mean, std = (jnp.broadcast_to(leaf, colour.shape) for leaf in self.colour_scale)
            maps.insert(0, jnp.where(height[..., None] > BARE, (colour - mean) / std, 0.0))
        if fingers is not None:
            scaled = (fingers - FINGERS_MEAN) / FINGERS_STD
            maps.append(jnp.broadcast_to(scaled[..., None, None, :], (*height.shape, 3)))
        if target is not None:
            maps.append(target[..., None].astype(height.dtype))
        return jnp.concatenate(maps, axis=-1)

    def side_by_side(self) -> "Networks":
        """Returns networks for runs under `vmap`: the small critic convolves by taps on a GPU."""
        if not isinstance(self.critic, dense.Critic) or jax.default_backend() == "cpu":
            return self
        return dataclasses.replace(self, critic=self.critic.clone(by_taps=True))

    def states_at_once(self, canvas: int) -> int | None:
        """Returns the states, of canvas x canvas cells, in a call of the critic; None for any.

        DenseNet-121 gets the pixels of one state at 640 px: all its calls have the same products,
        which XLA tunes once.
        """
        return max(1, round((_FULL / (self.upsample * canvas)) ** 2)) if self.upsample else None


def make(cfg: NetConfig, critic: Any = None) -> Networks:
    """Builds the networks of a config, or of the Flax module `critic` with a head of `cfg.head`."""
    if critic is not None:
        return Networks(critic, dense.Head(SmallNet(head=cfg.head)), critic.stride, cfg.colour)
    if isinstance(cfg, SmallNet):
        stride = cfg.stride // cfg.subpixel
        return Networks(dense.Critic(cfg), dense.Head(cfg), stride, cfg.colour)
    modules = densenet.DenseNetCritic(cfg), densenet.DenseNetHead(cfg)
    scales = densenet.HEIGHT_SCALE, densenet.COLOUR_SCALE
    return Networks(*modules, cfg.output_stride, cfg.colour, *scales, cfg.upsample, one_vector=True)


def learned(variables: Any) -> Any:
    """Returns the variables that gradients change; the rest are running statistics."""
    return {"params": variables["params"]}


@functools.partial(jax.jit, static_argnums=0)
def _traced_once(net: nn.Module, variables: Any, maps: jax.Array) -> Any:
    """Applies a net to [N, C, C, I], traced once: to trace DenseNet-121 takes seconds."""
    return net.apply(variables, maps)


def apply(networks: Networks, variables: Any, maps: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes Q [B, N, ...] and features [B, N, ...] of N passes per state [B, N, C, C, I]."""
    critic, group = networks.critic, networks.states_at_once(maps.shape[2])
    if group is not None:
        per_state = functools.partial(_traced_once, critic, variables)
        return jax.lax.map(per_state, maps, batch_size=group if group > 1 else None)
    flat: Any = critic.apply(variables, maps.reshape(-1, *maps.shape[2:]))
    return jax.tree.map(lambda leaf: leaf.reshape(*maps.shape[:2], *leaf.shape[1:]), flat)


def apply_mirrored(
    networks: Networks, variables: Any, maps: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Computes `apply` with Q averaged over four mirror images of each pass, in its frame."""
    mirrors = ((), (2,), (3,), (2, 3))  # axes; one along the frame, 3, swaps pushes ahead and back
    mirrored = jnp.concatenate([jnp.flip(maps, axes) for axes in mirrors], axis=1)
    q, features = apply(networks, variables, mirrored)
    turned_back = [
        jnp.flip(part, axes)[..., np.array([1, 0, 2]) if 3 in axes else slice(None)]
        for part, axes in zip(jnp.split(q, len(mirrors), axis=1), mirrors, strict=True)
    ]
    return jnp.mean(jnp.stack(turned_back), axis=0), features[:, : maps.shape[1]]


def train(net: nn.Module, variables: Any, maps: jax.Array) -> tuple[Any, Any]:
    """Returns a net's outputs by batch statistics, and the running ones after it ({} if none)."""
    return net.apply(variables, maps, train=True, mutable=["batch_stats"])
