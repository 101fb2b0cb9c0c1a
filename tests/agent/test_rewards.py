"""Rewards of one action."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.agent import rewards
from csac_jax.config import RewardConfig
from csac_jax.sim.outcome import Outcome

CFG = RewardConfig()


def reward(cfg, primitive, outcome=0, distance=0.0, before=0.0, after=0.0):
    values = (jnp.float32(v) for v in (distance, before, after))
    return float(rewards.reward(cfg, jnp.int32(primitive), jnp.int32(outcome), *values))


@pytest.mark.parametrize(("outcome", "expected"), list(zip(Outcome, (-1.0, -0.5, -0.25, 0.0, 2.0), strict=True)))
def test_grasp_rewards(outcome, expected):
    """Claim: eqs. 12 and 15 by hand: -1, -0.5, -0.25, 0, and 1 for the lift plus 1 for the block in the hand."""
    assert reward(CFG, rewards.GRASP, outcome) == expected


@pytest.mark.parametrize("outcome", Outcome)
def test_each_outcome_has_its_own_level(outcome):
    """Claim: each outcome of a grasp is rewarded by the setting of its name."""
    cfg = RewardConfig(nothing=-5.0, empty=-4.0, touched=-3.0, dropped=-2.0, lifted=-1.0)
    assert rewards.grasp_effect(cfg, jnp.int32(outcome)) == getattr(cfg, outcome.name.lower())
    assert rewards.LIFTED == Outcome.LIFTED


@pytest.mark.parametrize(("after", "expected"), [(0.61, 0.5), (0.59, -0.5), (0.5, -0.5), (0.0, -0.5), (np.nan, -0.5)])
def test_push_rewards(after, expected):
    """Claim: eq. 16 by hand: half a point for a gain above the dead band of 0.1, else half a point lost."""
    assert reward(CFG, rewards.PUSH, before=0.5, after=after) == expected


@pytest.mark.parametrize("outcome", Outcome)
def test_push_ignores_the_outcome_of_a_grasp(outcome):
    """Claim: a push earns no reach reward and no grasp level, whatever is in `outcome`."""
    assert reward(CFG, rewards.PUSH, outcome, after=1.0) == 0.5


def test_distance_is_a_loss():
    """Claim: r = r2 - w r1: 0.2 m at w = 2 cost 0.4, of a push and of a grasp, and beyond 1 m no more than at 1 m."""
    cfg = RewardConfig(distance=2.0)
    np.testing.assert_allclose(reward(cfg, rewards.GRASP, Outcome.LIFTED, 0.2), 1.6, rtol=1e-6)
    np.testing.assert_allclose(reward(cfg, rewards.PUSH, distance=0.2, after=1.0), 0.1, rtol=1e-5)
    assert rewards.base(cfg, jnp.array(False), jnp.float32(7.0)) == -2.0


def test_scale():
    """Claim: eq. 13 by hand: eta0 + eta1 2^(s - s_max)."""
    assert rewards.scale(CFG, 0, 1) == 0.5
    assert rewards.scale(CFG, 1, 1) == 1.0
    assert rewards.scale(RewardConfig(eta0=0.25, eta1=3.0), 0, 2) == 1.0


@pytest.mark.parametrize(
    "cfg",
    [
        CFG,
        RewardConfig(eta0=0.5, distance=1.5),
        RewardConfig(push_better=9.0, push_worse=2.0, nothing=1.0, empty=1.0, touched=1.0, dropped=1.0, reach=0.0),
        RewardConfig(lifted=0.0, reach=-3.0, push_better=-0.5),
        RewardConfig(eta1=-2.0),
    ],
)
@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.9])
def test_bounds_hold_and_are_reached(cfg, gamma):
    """Claim: every discounted return of one action done 1 to 200 times lies within, and some reach both ends."""
    single = [
        reward(cfg, primitive, outcome, distance, 0.0, after)
        for primitive, outcome, distance, after in itertools.product((0, 1), Outcome, (0.0, 1.0, 3.0), (0.0, 1.0))
    ]
    lengths = np.cumsum(gamma ** np.arange(200))  # 1, 1 + gamma, ...
    returns = np.outer(single, lengths)
    low, high = rewards.bounds(cfg, gamma)
    assert low - 1e-5 <= returns.min()
    assert returns.max() <= high + 1e-5
    np.testing.assert_allclose([returns.min(), returns.max()], [low, high], atol=1e-4)


def test_default_bounds():
    """Claim: with the default rewards and gamma 0.5, returns lie between -2 and 4."""
    assert rewards.bounds(CFG, 0.5) == (-2.0, 4.0)
