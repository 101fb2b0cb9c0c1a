"""What a primitive did: by ground truth, and as the robot's finger gap alone suggests."""

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax.config import SimConfig
from csac_jax.constants import Outcome

LIFT_SHARE = 0.5  # a block counts as lifted when it rose by this share of the hand's rise
GRIP_RISE = 0.01  # m, a held block that rose this far was grasped
BARE = 0.01  # m, a surface lower than this is bare table
CLOSED_GAP = 0.005  # m, a smaller finger gap is a closed hand


@struct.dataclass
class Substep:
    """What is seen after one physics step. N = block slots."""

    touching: jax.Array  # [3, N] bool, palm, low pad and high pad against each block
    rise: jax.Array  # [N] m, height gained since the primitive began
    gap: jax.Array  # [] m, between the fingers
    contact_overflow: jax.Array  # [] bool, contacts may be missing


@struct.dataclass
class Trace:
    """What was seen while a primitive ran. N = block slots."""

    touched: jax.Array  # [] bool, the hand met a block
    held_rise: jax.Array  # [N] m, largest rise of a block between both pads
    held: jax.Array  # [N] bool, between both pads in the end
    rise: jax.Array  # [N] m, in the end
    gap_closed: jax.Array  # [] m, finger gap when the hand had closed
    gap_end: jax.Array  # [] m, finger gap in the end
    contact_overflow: jax.Array  # [] int32, substeps in which contacts may be missing


def blank(num: int) -> Trace:
    """The trace of a primitive over `num` block slots before its first substep."""
    no, zero, zeros = jnp.zeros((), bool), jnp.zeros(()), jnp.zeros(num)
    return Trace(no, zeros, jnp.zeros(num, bool), zeros, zero, zero, jnp.zeros((), jnp.int32))


def extend(cfg: SimConfig, trace: Trace, index: jax.Array, observed: Substep) -> Trace:
    """The trace with substep number `index` [] int32 added."""
    held = observed.touching[1] & observed.touching[2]
    closes_at = sum(cfg.grasp_phases[:2]) - 1
    return Trace(
        touched=trace.touched | jnp.any(observed.touching),
        held_rise=jnp.maximum(trace.held_rise, jnp.where(held, observed.rise, 0.0)),
        held=held,
        rise=observed.rise,
        gap_closed=jnp.where(index == closes_at, observed.gap, trace.gap_closed),
        gap_end=observed.gap,
        contact_overflow=trace.contact_overflow + observed.contact_overflow.astype(jnp.int32),
    )


def trace_of(cfg: SimConfig, observed: Substep) -> Trace:
    """The trace of all substeps of a primitive, leaves [T, ...]."""
    substeps, num = observed.rise.shape

    def add(trace: Trace, indexed: tuple[jax.Array, Substep]) -> tuple[Trace, None]:
        return extend(cfg, trace, *indexed), None

    return jax.lax.scan(add, blank(num), (jnp.arange(substeps), observed))[0]


def lifted_blocks(trace: Trace, hand_rise: jax.Array) -> jax.Array:
    """True for blocks [N] that hang in the hand after it rose by `hand_rise` [] m."""
    return trace.held & (trace.rise >= LIFT_SHARE * hand_rise)


def grasp_outcome(trace: Trace, surface: jax.Array, hand_rise: jax.Array) -> jax.Array:
    """Outcome [] int32 by ground truth, CSAC eq. 15.

    `nothing`: the hand met no block on bare table. `empty`: it met none at a `surface` [] m above
    BARE. `touched`: it met a block that never rose between the pads. `dropped`: a block rose and
    was lost.
    """
    missed = _missed(surface)
    met = jnp.where(
        jnp.any(trace.held_rise >= GRIP_RISE),
        jnp.int32(Outcome.DROPPED),
        jnp.int32(Outcome.TOUCHED),
    )
    failed = jnp.where(trace.touched, met, missed)
    return jnp.where(jnp.any(lifted_blocks(trace, hand_rise)), jnp.int32(Outcome.LIFTED), failed)


def grasp_outcome_by_gap(trace: Trace, surface: jax.Array, changed: jax.Array) -> jax.Array:
    """Outcome [] int32 that finger gaps and the height map suggest.

    Args: changed [] bool, the height map moved.
    """
    missed = _missed(surface)
    open_hand = jnp.where(changed, jnp.int32(Outcome.TOUCHED), missed)
    failed = jnp.where(trace.gap_closed > CLOSED_GAP, jnp.int32(Outcome.DROPPED), open_hand)
    return jnp.where(trace.gap_end > CLOSED_GAP, jnp.int32(Outcome.LIFTED), failed)


def _missed(surface: jax.Array) -> jax.Array:
    return jnp.where(surface < BARE, jnp.int32(Outcome.NOTHING), jnp.int32(Outcome.EMPTY))
