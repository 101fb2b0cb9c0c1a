"""Several devices: a line of them, along which either seeds or the scenes of each seed are spread.

Seeds need nothing of one another: each device runs a program of its own on its share of them.
Scenes share networks and replay, which every device has a copy of: physics runs apart, transitions
are gathered into every copy of the ring, and a batch is divided among the devices, whose gradients
are added up.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

Shard = Literal["seeds", "scenes"]
AXIS = "devices"


@dataclasses.dataclass(frozen=True)
class Spread:
    """How one seed's scenes and batches are spread: not at all without a mesh."""

    mesh: Mesh | None = None

    def scenes(self, function: Callable) -> Callable:
        """A function of leaves [E, ...] to leaves [E, ...], scene by scene, as one that runs each
        device's scenes."""
        if self.mesh is None:
            return function
        along = PartitionSpec(AXIS)
        return jax.shard_map(
            function, mesh=self.mesh, in_specs=along, out_specs=along, check_vma=False
        )

    def batch(self, tree: Any) -> Any:
        """Leaves [B, ...], of which each device is to hold its share."""
        if self.mesh is None:
            return tree
        along = NamedSharding(self.mesh, PartitionSpec(AXIS))
        return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, along), tree)


ALONE = Spread()


def make(devices: int | None) -> Mesh | None:
    """A line of the first `devices` devices of all processes; no mesh for one alone.

    If None, one, or with several processes all that there are. Raises ValueError if there are
    fewer, or if a process were left without one.
    """
    found, alone = jax.devices(), jax.process_count() == 1
    wanted = devices
    if wanted is None:
        wanted = 1 if alone else len(found)
    if not alone and wanted != len(found):
        raise ValueError(
            f"--devices: {wanted} asked for; leave it out: several processes use all {len(found)}"
        )
    if not 1 <= wanted <= len(found):
        raise ValueError(
            f"--devices: {wanted} asked for, there are {len(found)} ({found[0].platform}); give 1 .. {len(found)}"
        )
    return None if wanted == 1 else Mesh(np.array(found[:wanted]), (AXIS,))


def check(mesh: Mesh | None, shard: Shard, members: int, scenes: int, batch: int) -> None:
    """Raises ValueError where the mesh cannot divide what it is to spread: seeds, or scenes and
    batch."""
    size = 1 if mesh is None else mesh.size
    named = (
        {"--seeds": members} if shard == "seeds" else {"train.scenes": scenes, "learn.batch": batch}
    )
    for name, number in named.items():
        if number % size:
            raise ValueError(
                f"{name}: {number} does not divide among {size} devices; give a multiple of {size}, or other --devices"
            )
