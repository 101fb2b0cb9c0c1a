"""A line of several devices, which divide either the seeds or the scenes of each seed.

Seeds are independent: each device runs a program of its own on its share. Scenes share networks and
replay, of which every device has a copy with all transitions; gradients of a divided batch add up.
"""

from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from csac_jax.errors import SettingsError

Shard = Literal["seeds", "scenes"]
AXIS = "devices"


def map_scenes(mesh: Mesh | None, function: Callable) -> Callable:
    """Runs `function`, leaves [E, ...] to leaves [E, ...], on each device for its own scenes."""
    if mesh is None:
        return function
    along = PartitionSpec(AXIS)
    return jax.shard_map(function, mesh=mesh, in_specs=along, out_specs=along, check_vma=False)


def shard_batch(mesh: Mesh | None, tree: Any) -> Any:
    """Splits leaves [B, ...] among the devices of a mesh."""
    if mesh is None:
        return tree
    along = NamedSharding(mesh, PartitionSpec(AXIS))
    return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, along), tree)


def make(devices: int | None) -> Mesh | None:
    """Makes a mesh of the first `devices` devices; None for a single one. By default one device, or
    all of several processes. Raises SettingsError if there are not so many."""
    present, alone = jax.devices(), jax.process_count() == 1
    wanted = (1 if alone else len(present)) if devices is None else devices
    if not alone and wanted != len(present):
        raise SettingsError(f"devices: leave it out, several processes use all {len(present)}")
    if not 1 <= wanted <= len(present):
        there = f"there are {len(present)} ({present[0].platform}); give 1 .. {len(present)}"
        raise SettingsError(f"devices: {wanted} asked for, {there}")
    return None if wanted == 1 else Mesh(np.array(present[:wanted]), (AXIS,))


def check(mesh: Mesh | None, shard: Shard, runs: int, scenes: int, batch: int) -> None:
    """Raises SettingsError if the devices cannot divide the runs, or scenes and batch, evenly."""
    size, divided = 1 if mesh is None else mesh.size, {"seeds": runs}
    if shard == "scenes":
        divided = {"train.scenes": scenes, "learn.batch": batch}
    for name, number in divided.items():
        if number % size:
            remedy = f"give a multiple of {size}, or another number of devices"
            raise SettingsError(f"{name}: {number} does not divide among {size} devices; {remedy}")
