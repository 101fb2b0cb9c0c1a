"""When a push pays: its price is set by the success bonus and the discount."""

import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.agent import losses
from csac_jax.config import Config
from csac_jax.constants import Outcome, Primitive
from tests.agent.test_rewards import reward


def _threshold(cfg: Config) -> float:
    """Share of lifts from which a grasp is worth as much as a push that frees its block for sure.

    A grasp that fails touches a block and changes nothing; a block set free is lifted for sure.
    Values are iterated for a thousand shares at once.
    """
    share = np.linspace(0.0, 1.0, 1001)
    lift = reward(cfg.reward, Primitive.GRASP, Outcome.LIFTED)
    fail = reward(cfg.reward, Primitive.GRASP, Outcome.TOUCHED)
    push = reward(cfg.reward, Primitive.PUSH, after=1.0)
    no = jnp.zeros(share.shape, bool)
    value = np.zeros_like(share)

    def follow(earned: float, value: np.ndarray) -> np.ndarray:
        following = jnp.asarray(value, jnp.float32)
        rewarded = jnp.full(share.shape, earned, jnp.float32)
        return np.asarray(losses.td_target(rewarded, cfg.target.gamma, no, following))

    for _ in range(100):
        of_push = follow(push, np.full_like(share, lift))
        of_grasp = share * lift + (1.0 - share) * follow(fail, value)
        value = np.maximum(of_push, of_grasp)
    return float(share[of_push > of_grasp - 1e-6].max())


@pytest.mark.parametrize(
    ("bonus", "gamma", "threshold"),
    [(1.0, 0.2, 0.469), (1.0, 0.5, 0.667), (0.0, 0.2, 0.730), (0.0, 0.5, 1.0)],
)
def test_push_pays_below_a_share_of_lifts(bonus, gamma, threshold):
    """Claim: a push that always helps is optimal up to the share of lifts
    p = (P - F - gamma P) / (S - F - gamma P), P = 0.5 + gamma S, S = 1 + bonus, F = -0.25: a
    smaller bonus and a larger discount let it pay more often."""
    cfg = presets.paper_small().change(reward={"success_bonus": bonus}, target={"gamma": gamma})
    success, failure = 1.0 + bonus, -0.25
    push = 0.5 + gamma * success
    exact = (push - failure - gamma * push) / (success - failure - gamma * push)
    assert exact == pytest.approx(threshold, abs=1e-3)
    assert _threshold(cfg) == pytest.approx(exact, abs=2e-3)
