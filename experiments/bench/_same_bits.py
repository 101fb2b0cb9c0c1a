"""MuJoCo Warp with the same bits in every run, as far as Warp's deterministic mode goes.

Threads take turns where they number contacts. Warp's mode would order them, but the kernel for
convex shapes does not compile in it. Here contacts are sorted after collision instead.
"""

import contextlib
import functools
from collections.abc import Sequence
from typing import Any

import warp as wp
from mujoco.mjx.third_party.mujoco_warp._src import (
    collision_driver,
    constraint,
    smooth,
    solver,
    types,
)

from csac_jax.sim import warp_graph

STAGES = ("contacts", "rows", "smooth", "solver")
"""Order of contacts, of the rows of constraints; sums over bodies, and over rows."""
_EACH = 8  # at least as many contacts as a pair of shapes has
_RECORDS = {"rows": 0, "smooth": 64, "solver": 128}  # sums of a thread; fewer overflow


@wp.kernel
def _rank(
    geoms: int,
    contacts: wp.array[int],  # [1]
    pair: wp.array[wp.vec2i],
    scene: wp.array[int],
    number: wp.array[int],  # within the pair
    keys: wp.array[wp.int64],  # [2 C], of which a sort needs a half
    order: wp.array[int],  # [2 C]
):
    contact = wp.tid()
    order[contact] = contact
    if contact >= contacts[0]:
        keys[contact] = wp.int64(0x7FFFFFFFFFFFFFFF)
        return
    one = wp.int64(scene[contact]) * wp.int64(geoms) + wp.int64(pair[contact][0])
    two = one * wp.int64(geoms) + wp.int64(pair[contact][1])
    keys[contact] = two * wp.int64(_EACH) + wp.int64(number[contact])


def _sort_contacts(model: Any, data: Any) -> None:
    """By their scene, their shapes and their number between those."""
    room, contact = data.naconmax, data.contact
    keys, order = wp.zeros(2 * room, dtype=wp.int64), wp.zeros(2 * room, dtype=int)
    given = [model.ngeom, data.nacon, contact.geom, contact.worldid, contact.geomcollisionid]
    wp.launch(_rank, room, [*given, keys, order])
    wp.utils.radix_sort_pairs(keys, order, room)
    first = order[:room]
    for name in types.Contact.__dataclass_fields__:
        values = getattr(contact, name)
        if values.ndim == 1 and len(values) == room and name not in ("flex", "elem", "vert"):
            ordered = wp.empty_like(values)
            wp.copy(ordered, values[first])
            wp.copy(values, ordered)


def _options(stage: str) -> dict[str, Any]:
    return {
        "deterministic": wp.DeterministicMode.RUN_TO_RUN,
        "deterministic_max_records": _RECORDS[stage],
    }


def ask(stages: Sequence[str]) -> None:
    """Of these STAGES. Kernels that they make take the mode from Warp's configuration."""
    if "contacts" in stages:
        collide = collision_driver.collision

        def collision(model: Any, data: Any, *args: Any, **kwargs: Any) -> None:
            collide(model, data, *args, **kwargs)
            _sort_contacts(model, data)

        collision_driver.collision = collision
    modules = {"rows": constraint, "smooth": smooth, "solver": solver}
    for stage in set(stages) & modules.keys():
        wp.set_module_options(_options(stage), modules[stage])
    for stage, owner, name in (
        ("rows", constraint, "make_constraint"),
        ("solver", solver, "solve"),
    ):
        if stage in stages:
            setattr(owner, name, _configured(getattr(owner, name), stage))
    # The mode allocates in its first launch only, and arrays would be handed out in another order.
    warp_graph._allocated_once = lambda kept: contextlib.nullcontext()


def _configured(function: Any, stage: str) -> Any:
    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> None:
        before = {name: getattr(wp.config, name) for name in _options(stage)}
        for name, value in _options(stage).items():
            setattr(wp.config, name, value)
        try:
            function(*args, **kwargs)
        finally:
            for name, value in before.items():
                setattr(wp.config, name, value)

    return call
