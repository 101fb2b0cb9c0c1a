"""Outcomes of hand-made traces."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.config import SimConfig
from csac_jax.constants import Outcome
from csac_jax.sim import outcome
from csac_jax.sim.outcome import Substep, Trace

RISE = 0.10  # m, of the hand
HELD = {"touched": True, "held": True}


def _trace(
    touched=False, held_rise=0.0, held=False, rise=0.0, gap_closed=0.0, gap_end=0.0
) -> Trace:
    """A trace in which block 1 of 2 has these values and block 0 lies untouched."""
    blocks = [[0.0, held_rise], [False, held], [0.0, rise]]
    leaves = (touched, *blocks, [0.0, 0.0], gap_closed, gap_end)
    return Trace(*(jnp.array(leaf) for leaf in leaves), contact_overflow=jnp.int32(0))


CLOSES_AT_1 = dataclasses.replace(SimConfig(), grasp_phases=(1, 1, 2))


def test_trace_is_that_of_substeps_seen_one_by_one():
    """Claim: a trace is what one who sees the substeps in turn remembers."""
    rng = np.random.default_rng(0)
    rise, gap = rng.normal(size=(6, 3)).astype(np.float32), rng.random(6).astype(np.float32)
    lag = rng.random(6).astype(np.float32)
    seen = Substep(rng.random((6, 3, 3)) < 0.4, rise, gap, lag, rng.random(6) < 0.5)
    highest, touched, overflows = np.zeros(3, np.float32), False, 0
    for touching, height, overflow in zip(seen.touching, rise, seen.contact_overflow, strict=True):
        held = (touching[1] | touching[2]) & touching[1].any() & touching[2].any()
        highest = np.where(held, np.maximum(highest, height), highest)
        touched, overflows = touched or touching.any(), overflows + int(overflow)
    lags = lag[[CLOSES_AT_1.push_phases[0] - 1, 0]]
    wanted = Trace(touched, highest, held, height, lags, gap[1], gap[-1], np.int32(overflows))
    trace = outcome.trace_of(CLOSES_AT_1, jax.tree.map(jnp.asarray, seen))
    jax.tree.map(np.testing.assert_array_equal, trace, wanted)


@pytest.mark.parametrize(
    ("expected", "surface", "values"),
    [
        (Outcome.NOTHING, 0.0, {}),
        (Outcome.NOTHING, 0.009, {}),
        (Outcome.EMPTY, 0.011, {}),
        (Outcome.TOUCHED, 0.0, {"touched": True}),
        (Outcome.TOUCHED, 0.05, {"touched": True, "rise": 0.06}),  # by itself, or on a finger
        (Outcome.TOUCHED, 0.05, {"touched": True, "held_rise": 0.009}),
        (Outcome.DROPPED, 0.05, {"touched": True, "held_rise": 0.011}),
        (Outcome.DROPPED, 0.05, {"touched": True, "held_rise": 0.09, "rise": 0.09}),  # in free fall
        (Outcome.DROPPED, 0.05, HELD | {"held_rise": 0.04, "rise": 0.04}),  # far too low
        (Outcome.LIFTED, 0.05, HELD | {"held_rise": 0.06, "rise": 0.06}),
        (Outcome.LIFTED, 0.0, HELD | {"held_rise": 0.06, "rise": 0.06}),
    ],
)
def test_outcome_by_ground_truth(expected: Outcome, surface: float, values: dict):
    """Claim: all five outcomes follow from contacts and rises as grasp_outcome says."""
    trace = _trace(**values)
    assert outcome.grasp_outcome(trace, jnp.array(surface), jnp.array(RISE)) == expected


@pytest.mark.parametrize(
    ("gap_closed", "gap_end", "surface", "changed", "expected"),
    [
        (0.0, 0.0, 0.0, False, Outcome.NOTHING),
        (0.0, 0.0, 0.05, False, Outcome.EMPTY),
        (0.0, 0.0, 0.0, True, Outcome.TOUCHED),
        (0.004, 0.004, 0.05, True, Outcome.TOUCHED),  # closed, give or take the control error
        (0.05, 0.0, 0.05, False, Outcome.DROPPED),
        (0.05, 0.05, 0.0, False, Outcome.LIFTED),
    ],
)
def test_outcome_by_gap(
    gap_closed: float, gap_end: float, surface: float, changed: bool, expected: Outcome
):
    """Claim: the robot's own judgement takes finger gap and map, and no ground truth."""
    for truth in (False, True):
        trace = _trace(truth, 0.09 * truth, truth, 0.09 * truth, gap_closed, gap_end)
        found = outcome.grasp_outcome_by_gap(trace, jnp.array(surface), jnp.array(changed))
        assert found == expected


@pytest.mark.parametrize(
    ("held", "rise", "lifted"),
    [(True, 0.051, True), (True, 0.049, False), (False, 0.09, False), (False, 0.0, False)],
)
def test_lifted_blocks(held: bool, rise: float, lifted: bool):
    """Claim: a lifted block is held in the end and rose by half of the hand's rise."""
    blocks = outcome.lifted_blocks(_trace(held=held, rise=rise), jnp.array(RISE))
    assert blocks.tolist() == [False, lifted]
