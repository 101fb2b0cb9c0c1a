"""A line of several devices, which divide either the seeds or the scenes of each seed.

Seeds are independent: each device runs a program of its own on its share. Scenes share networks and
replay, of which every device has a copy. Physics runs apart; transitions are gathered into every
copy. A batch is divided among the devices and its gradients are added up.
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
class DataSharding:
    """How the scenes and batches of one seed are divided; without a mesh they are not."""

    mesh: Mesh | None = None

    def map_scenes(self, function: Callable) -> Callable:
        """`function` of leaves [E, ...] to leaves [E, ...], each device on its own scenes."""
        if self.mesh is None:
            return function
        along = PartitionSpec(AXIS)
        return jax.shard_map(
            function, mesh=self.mesh, in_specs=along, out_specs=along, check_vma=False
        )

    def shard_batch(self, tree: Any) -> Any:
        """Leaves [B, ...], of which each device holds its share."""
        if self.mesh is None:
            return tree
        along = NamedSharding(self.mesh, PartitionSpec(AXIS))
        return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, along), tree)


UNSHARDED = DataSharding()


def make(devices: int | None) -> Mesh | None:
    """A line of the first `devices` devices of all processes; no mesh for a single one.

    None stands for one device, or for all of several processes. Raises ValueError if there are
    fewer, or if a process were left without one.
    """
    present, alone = jax.devices(), jax.process_count() == 1
    wanted = devices
    if wanted is None:
        wanted = 1 if alone else len(present)
    if not alone and wanted != len(present):
        raise ValueError(
            f"--devices: {wanted} asked for; leave it out: several processes use all {len(present)}"
        )
    if not 1 <= wanted <= len(present):
        raise ValueError(
            f"--devices: {wanted} asked for, there are {len(present)} ({present[0].platform}); "
            f"give 1 .. {len(present)}"
        )
    return None if wanted == 1 else Mesh(np.array(present[:wanted]), (AXIS,))


def check(mesh: Mesh | None, shard: Shard, runs: int, scenes: int, batch: int) -> None:
    """Raises ValueError where the devices cannot divide the runs, or scenes and batch, evenly."""
    size = 1 if mesh is None else mesh.size
    by_scenes = {"train.scenes": scenes, "learn.batch": batch}
    for name, number in ({"--seeds": runs} if shard == "seeds" else by_scenes).items():
        if number % size:
            raise ValueError(
                f"{name}: {number} does not divide among {size} devices; "
                f"give a multiple of {size}, or other --devices"
            )
