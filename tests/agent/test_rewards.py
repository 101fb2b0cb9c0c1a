"""Rewards of one action."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax import algorithms
from csac_jax.agent import rewards
from csac_jax.config import RewardConfig
from csac_jax.constants import Outcome, Primitive
from tests.sections import with_constants

CFG = RewardConfig()


def reward(
    cfg, primitive, outcome=0, distance=0.0, before=0.0, after=0.0, changed=False, blocks_lost=0
):
    result = rewards.ActionResult(
        primitive=jnp.int32(primitive),
        outcome=jnp.int32(outcome),
        distance=jnp.float32(distance),
        phi_before=jnp.float32(before),
        phi_after=jnp.float32(after),
        changed=jnp.asarray(changed),
        blocks_lost=jnp.int32(blocks_lost),
    )
    return float(rewards.reward(cfg, result))


@pytest.mark.parametrize(
    ("outcome", "expected"), list(zip(Outcome, (-1.0, -0.5, -0.25, 0.0, 2.0), strict=True))
)
def test_grasp_rewards(outcome, expected):
    """Claim: eqs. 12 and 15 by hand: -1, -0.5, -0.25, 0, and 1 plus 1 for the lift."""
    assert reward(CFG, Primitive.GRASP, outcome) == expected


@pytest.mark.parametrize(
    ("after", "expected"), [(0.61, 0.5), (0.59, -0.5), (0.5, -0.5), (0.0, -0.5), (np.nan, -0.5)]
)
def test_push_rewards(after, expected):
    """Claim: eq. 16 by hand: half a point for a gain above the dead band of 0.1, else half a point
    lost; that the map changed earns nothing."""
    for changed in (False, True):
        assert reward(CFG, Primitive.PUSH, before=0.5, after=after, changed=changed) == expected


def test_a_rise_by_the_dead_band_is_no_gain():
    """Claim: eq. 16's inequality is strict: phi has to rise by more than the dead band."""
    after = jnp.array([CFG.dead_band, np.nextafter(np.float32(CFG.dead_band), np.float32(1.0))])
    assert_array_equal(rewards.gains_value(CFG, jnp.zeros(2), after), [False, True])


def test_distance_is_a_loss():
    """Claim: r = r2 - w r1: 0.2 m at w = 2 cost 0.4, of a push and of a grasp, and beyond 1 m no
    more than at 1 m."""
    cfg = with_constants(RewardConfig(), distance_weight=2.0)
    assert_allclose(reward(cfg, Primitive.GRASP, Outcome.LIFTED, 0.2), 1.6, rtol=1e-6)
    assert_allclose(reward(cfg, Primitive.PUSH, distance=0.2, after=1.0), 0.1, rtol=1e-5)
    for cap, loss in ((1.0, -2.0), (0.1, -0.2)):
        near = with_constants(cfg, distance_cap=cap)
        dropped = reward(near, Primitive.GRASP, Outcome.DROPPED, 7.0)  # of level 0
        assert_allclose(dropped, loss, rtol=1e-6)


@pytest.mark.parametrize("was", [False, True])
@pytest.mark.parametrize("good", [False, True])
def test_new_label_earns_its_reward(was, good):
    """Claim: the reward of a push that is relabelled is the one that the new label would earn."""
    cfg = with_constants(RewardConfig(push_levels=(-2.0, 3.0)), eta=(0.25, 3.0), push_level=-1.0)
    old, new = (reward(cfg, Primitive.PUSH, after=float(label)) for label in (was, good))
    got = rewards.relabel(cfg, jnp.array([old]), jnp.array([was]), jnp.array([good]))
    assert_allclose(got, [new], rtol=1e-6)


def test_rewards_of_a_step_are_those_of_its_actions():
    """Claim: each action of a step is rewarded by itself; only pushes that gain are good ones."""
    results = rewards.ActionResult(
        primitive=jnp.array([Primitive.PUSH, Primitive.PUSH, Primitive.GRASP, Primitive.GRASP]),
        outcome=jnp.array([0, 0, Outcome.LIFTED, Outcome.NOTHING]),
        distance=jnp.zeros(4),
        phi_before=jnp.zeros(4),
        phi_after=jnp.array([1.0, 0.0, 1.0, 0.0]),
        changed=jnp.zeros(4, bool),
        blocks_lost=jnp.zeros(4, jnp.int32),
    )
    each, good = rewards.rewards_of(CFG, results)
    assert_array_equal(each, [0.5, -0.5, 2.0, -1.0])
    assert_array_equal(good, [True, False, False, False])


@pytest.mark.parametrize("primitive", [Primitive.PUSH, Primitive.GRASP])
def test_blocks_that_left_cost_once(primitive):
    """Claim: an action that loses one block, or three, pays the penalty once."""
    strict = RewardConfig(lost_block_penalty=0.75)
    for cfg, lost, penalty in ((strict, 0, 0.0), (strict, 1, 0.75), (strict, 3, 0.75), (CFG, 2, 0)):
        got = reward(cfg, primitive, Outcome.LIFTED, after=1.0, blocks_lost=lost)
        assert got == reward(CFG, primitive, Outcome.LIFTED, after=1.0) - penalty


@pytest.mark.parametrize(
    "cfg",
    [
        CFG,
        with_constants(CFG, distance_weight=1.5, eta=(0.5, 1.0)),
        RewardConfig(push_levels=(2.0, 9.0), grasp_levels=(1.0,) * 5, success_bonus=0.0),
        RewardConfig(
            grasp_levels=(-1.0, -0.5, -0.25, 0.0, 0.0), success_bonus=-3.0, push_levels=(-1.0, -0.5)
        ),
        with_constants(CFG, eta=(0.0, -2.0)),
        RewardConfig(lost_block_penalty=1.5),
        with_constants(CFG, distance_weight=3.0, eta=(0.1, 1.0), distance_cap=0.5, push_level=-2.0),
        algorithms.VPG_REWARD,
        dataclasses.replace(algorithms.VPG_REWARD, push_levels=(-3.0, 5.0)),
    ],
)
@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.9])
def test_bounds_hold_and_are_reached(cfg, gamma):
    """Claim: returns of an action done 1 to 200 times lie within, and reach both ends."""
    flags = (False, True)
    cases = itertools.product((0, 1), Outcome, (0.0, 1.0, 3.0), (0.0,), (0.0, 1.0), flags, (0, 1))
    results = rewards.ActionResult(*map(jnp.asarray, zip(*cases, strict=True)))
    single = jax.vmap(rewards.reward, (None, 0))(cfg, results)
    returns = np.outer(single, np.cumsum(gamma ** np.arange(200)))  # 1, 1 + gamma, ...
    low, high = rewards.bounds(cfg, gamma)
    assert low - 1e-5 <= returns.min()
    assert returns.max() <= high + 1e-5
    assert_allclose([returns.min(), returns.max()], [low, high], atol=1e-4)


@pytest.mark.parametrize("changed", [True, False])
def test_vpg_rewards(changed):
    """Claim: VPG by hand: 1 for a grasp that lifts, 0 for any other; 0.5 for a push that changed
    the map, else 0, whatever grasps are worth."""
    cfg = algorithms.VPG_REWARD
    for outcome in Outcome:
        lifted = float(outcome == Outcome.LIFTED)
        assert reward(cfg, Primitive.GRASP, outcome, changed=changed) == lifted
    for after in (0.0, 9.0):
        assert reward(cfg, Primitive.PUSH, after=after, changed=changed) == 0.5 * changed
