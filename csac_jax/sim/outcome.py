"""The outcome of a primitive: by ground truth, and as the robot's finger gap suggests."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax.config import SimConfig
from csac_jax.constants import Outcome

LIFT_SHARE = 0.5  # a block counts as lifted when it rose by this share of the hand's rise
STOPPED = 0.008  # m, a guarded descent that ends so far above its set-point met `down_force` (ours)
GRIP_RISE = 0.01  # m, a held block that rose this far was grasped
BARE = 0.01  # m, a surface lower than this is bare table
CLOSED_GAP = 0.005  # m, a smaller finger gap is a closed hand
PARTS = 3  # of a hand: palm, low finger, high finger


@struct.dataclass
class Substep:
    """Sensor readings after one physics step. N = block slots."""

    touching: jax.Array  # [PARTS, N] bool, each part of the hand against each block
    rise: jax.Array  # [N] m, height gained since the primitive began
    gap: jax.Array  # [] m, between the fingers, beyond that of the closed hand
    lag: jax.Array  # [] m, of the hand above its set-point
    contact_overflow: jax.Array  # [] bool, contacts may be missing


@struct.dataclass
class Trace:
    """Sensor readings of a whole primitive. N = block slots."""

    touched: jax.Array  # [] bool, the hand met a block
    held_rise: jax.Array  # [N] m, largest rise of a block in the grip
    held: jax.Array  # [N] bool, in the grip in the end
    rise: jax.Array  # [N] m, in the end
    lag: jax.Array  # [2] m, of the hand above its set-point after the descent, by Primitive
    gap_closed: jax.Array  # [] m, finger gap when the hand had closed
    gap_end: jax.Array  # [] m, finger gap in the end
    contact_overflow: jax.Array  # [] int32, substeps in which contacts may be missing


def nothing_seen(substeps: int, num: int) -> Substep:
    """Returns the substeps of a primitive without motion, NumPy leaves [T, ...], all 0."""
    zeros: Any = np.zeros
    touching, rise = zeros((substeps, PARTS, num), bool), zeros((substeps, num), np.float32)
    length = zeros(substeps, np.float32)
    return Substep(touching, rise, length, length, zeros(substeps, bool))


def in_grip(touching: jax.Array) -> jax.Array:
    """Returns [..., N] bool, a block touches a finger while each of `touching` [..., PARTS, N]
    touches some block. So two blocks side by side between the fingers are held, too."""
    fingers = touching[..., 1:, :]
    return jnp.any(fingers, axis=-2) & jnp.all(jnp.any(fingers, axis=-1), axis=-1)[..., None]


def trace_of(cfg: SimConfig, substeps: Substep) -> Trace:
    """Summarises all substeps of a primitive, leaves [T, ...]."""
    held = in_grip(substeps.touching)
    descents = [cfg.push_phases[0] - 1, cfg.grasp_phases[0] - 1]  # by Primitive
    return Trace(
        touched=jnp.any(substeps.touching),
        held_rise=jnp.max(substeps.rise, axis=0, initial=0.0, where=held),
        held=held[-1],
        rise=substeps.rise[-1],
        lag=substeps.lag[np.array(descents)],
        gap_closed=substeps.gap[sum(cfg.grasp_phases[:2]) - 1],
        gap_end=substeps.gap[-1],
        contact_overflow=jnp.sum(substeps.contact_overflow, dtype=jnp.int32),
    )


def lifted_blocks(trace: Trace, hand_rise: jax.Array) -> jax.Array:
    """Returns [N] bool, a block rose with the hand, by `hand_rise` [] m, which holds something."""
    return jnp.any(trace.held) & (trace.rise >= LIFT_SHARE * hand_rise)


def grasp_outcome(trace: Trace, surface: jax.Array, hand_rise: jax.Array) -> jax.Array:
    """Judges by ground truth, returns Outcome [] int32, CSAC eq. 15.

    `nothing`: the hand met no block on bare table. `empty`: none at a `surface` [] m from BARE up.
    `touched`: no block that it met rose between the fingers. `dropped`: one rose and was lost.
    """
    dropped = trace.touched & jnp.any(trace.held_rise >= GRIP_RISE)
    lifted = jnp.any(lifted_blocks(trace, hand_rise))
    return _highest(surface >= BARE, trace.touched, dropped, lifted)


def grasp_outcome_by_gap(trace: Trace, surface: jax.Array, changed: jax.Array) -> jax.Array:
    """Judges by finger gaps, and by `changed` [] bool, the map moved; returns Outcome [] int32."""
    dropped, lifted = trace.gap_closed > CLOSED_GAP, trace.gap_end > CLOSED_GAP
    return _highest(surface >= BARE, changed, dropped, lifted)


def _highest(*holds: jax.Array) -> jax.Array:
    """Returns the highest level that holds, [] int32; `holds` are those of EMPTY to LIFTED."""
    levels = [jnp.int32(level) for level in Outcome]
    return jnp.select(holds[::-1], levels[:0:-1], levels[0])
