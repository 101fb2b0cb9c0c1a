"""Losses, targets and target networks."""

import jax.numpy as jnp
import pytest
from numpy.testing import assert_array_equal

from csac_jax.agent import losses
from csac_jax.config import LearnConfig
from tests.sections import with_constants


def test_td_target_by_hand():
    """Claim: y = r + gamma V, without V after a true end, even if V is NaN there."""
    value = jnp.array([4.0, 4.0, jnp.nan])
    target = losses.td_target(
        jnp.array([1.0, 1.0, -0.5]), 0.5, jnp.array([False, True, True]), value
    )
    assert_array_equal(target, [3.0, 1.0, -0.5])


@pytest.mark.parametrize(("loss", "expected"), [("huber", [0.125, 4.0]), ("squared", [0.25, 9.0])])
def test_td_loss_by_hand(loss, expected):
    """Claim: errors 0.5 and -3 cost 0.125 and 4 by Huber of width 2, or their squares."""
    cfg = with_constants(LearnConfig(loss=loss), huber=2.0)
    got = losses.td_loss(cfg, jnp.array([0.5, -3.0]))
    assert_array_equal(got, expected)
