"""What a primitive did, by ground truth and as a robot with nothing but its finger gap would
judge."""

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax.constants import Outcome

LIFT_SHARE = 0.5  # a block counts as lifted when it rose by this share of the hand's rise
GRIP_RISE = 0.01  # m, a held block that rose this far was grasped
BARE = 0.01  # m, a surface lower than this is bare table
CLOSED_GAP = 0.005  # m, a smaller finger gap is a closed hand


@struct.dataclass
class Trace:
    """What was seen while a primitive ran. N = block slots."""

    touched: jax.Array  # [] bool, the hand met a block
    held_rise: jax.Array  # [N] m, distance_cap a block rose between both pads
    held: jax.Array  # [N] bool, between both pads in the end
    rise: jax.Array  # [N] m, in the end
    gap_closed: jax.Array  # [] m, finger gap when the hand had closed
    gap_end: jax.Array  # [] m, finger gap in the end
    contact_overflow: jax.Array  # [] int32, substeps in which every contact slot was in use


def blank(num: int) -> Trace:
    """The trace of a primitive over `num` block slots before its first substep."""
    no, zero, zeros = jnp.zeros((), bool), jnp.zeros(()), jnp.zeros(num)
    return Trace(no, zeros, jnp.zeros(num, bool), zeros, zero, zero, jnp.zeros((), jnp.int32))


def lifted_blocks(trace: Trace, hand_rise: jax.Array) -> jax.Array:
    """True for blocks [N] that hang in the hand after it rose by `hand_rise` [] m."""
    return trace.held & (trace.rise >= LIFT_SHARE * hand_rise)


def grasp_outcome(trace: Trace, surface: jax.Array, hand_rise: jax.Array) -> jax.Array:
    """Outcome [] int32 by ground truth, eq. 15.

    `nothing`: no block was met and the place was bare table, `surface` [] m; `empty`: no block was
    met where there was something; `touched`: met but never lifted between the pads; `dropped`: it
    rose and was lost.
    """
    missed = jnp.where(surface < BARE, jnp.int32(Outcome.NOTHING), jnp.int32(Outcome.EMPTY))
    met = jnp.where(
        jnp.any(trace.held_rise >= GRIP_RISE),
        jnp.int32(Outcome.DROPPED),
        jnp.int32(Outcome.TOUCHED),
    )
    failed = jnp.where(trace.touched, met, missed)
    return jnp.where(jnp.any(lifted_blocks(trace, hand_rise)), jnp.int32(Outcome.LIFTED), failed)


def grasp_outcome_by_gap(trace: Trace, surface: jax.Array, changed: jax.Array) -> jax.Array:
    """Outcome [] int32 that finger gaps and the height map alone suggest; `changed` [] bool: the
    map moved."""
    missed = jnp.where(surface < BARE, jnp.int32(Outcome.NOTHING), jnp.int32(Outcome.EMPTY))
    open_hand = jnp.where(changed, jnp.int32(Outcome.TOUCHED), missed)
    failed = jnp.where(trace.gap_closed > CLOSED_GAP, jnp.int32(Outcome.DROPPED), open_hand)
    return jnp.where(trace.gap_end > CLOSED_GAP, jnp.int32(Outcome.LIFTED), failed)
