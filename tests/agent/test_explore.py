"""Exploration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from csac_jax.agent import explore
from csac_jax.config import ExploreConfig

GREEDY_POSES = jnp.array([[0.5, 0.0, 0.0], [-0.5, 0.2, 0.999]])
RANDOM_PLACES = jnp.array([[0.9, 0.9, 0.1], [-0.9, -0.9, 0.2]])
NUM = 4000


def choices(cfg: ExploreConfig, taken: int, primitive: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Primitives [NUM] and poses [NUM, 3] under as many keys."""
    greedy = explore.Greedy(jnp.int32(primitive), GREEDY_POSES, jnp.zeros(2))
    keys = jax.random.split(jax.random.key(0), NUM)
    choose = lambda key: explore.choose(key, cfg, jnp.int32(taken), greedy, RANDOM_PLACES)  # noqa: E731
    primitives, poses = jax.jit(jax.vmap(choose))(keys)
    return np.asarray(primitives), np.asarray(poses)


def assert_share(event: np.ndarray, expected: float) -> None:
    """`event` happened with probability `expected`, up to four standard errors."""
    error = np.sqrt(max(expected * (1.0 - expected), 1e-9) / event.size)
    assert abs(event.mean() - expected) <= 4 * error, (event.mean(), expected)


@pytest.mark.parametrize("taken", [0, 300, 10**6])
def test_shares_of_primitives_and_places(taken):
    """Claim: pushes have probability eps push_fraction, random places their own eps."""
    cfg = ExploreConfig(
        epsilon_primitive=(0.5, 0.1),
        epsilon_place=(0.5, 0.02),
        epsilon_decay=0.998,
        push_fraction=0.25,
    )
    primitives, poses = choices(cfg, taken)
    assert_share(primitives == 0, max(0.1, 0.5 * 0.998**taken) * 0.25)
    random_place = np.all(poses == np.asarray(RANDOM_PLACES)[primitives], axis=-1)
    assert_share(random_place, max(0.02, 0.5 * 0.998**taken))


def test_pose_belongs_to_the_primitive():
    """Claim: a forced primitive acts at its own greedy pose or its own random place."""
    cfg = ExploreConfig(epsilon_primitive=(1.0, 0.1), push_fraction=0.5)
    primitives, poses = choices(cfg, 0)
    greedy = np.asarray(GREEDY_POSES)[primitives]
    offset = (poses - greedy + 1.0) % 2.0 - 1.0
    at_greedy = np.all(np.abs(offset) <= 3.0 * cfg.noise_std + 1e-6, axis=-1)
    at_random = np.all(poses == np.asarray(RANDOM_PLACES)[primitives], axis=-1)
    assert np.all(at_greedy ^ at_random)
    assert 0.4 < at_greedy.mean() < 0.6
    assert set(primitives) == {0, 1}


def test_action_noise_is_a_clipped_normal():
    """Claim: noise is a normal of spread delta, clipped at 3 delta, in each dimension."""
    cfg = ExploreConfig(noise_std=0.05)
    keys = jax.random.split(jax.random.key(1), NUM)
    noise = np.asarray(jax.vmap(lambda key: explore.action_noise(key, cfg, jnp.zeros(3)))(keys))
    at_bound = np.abs(noise) >= 0.15 - 1e-6
    assert np.abs(noise).max() <= 0.15 + 1e-6
    for dim in range(3):
        assert_share(at_bound[:, dim], 2 * stats.norm.sf(3.0))
        law = stats.truncnorm(-3.0, 3.0, scale=0.05)
        assert stats.kstest(noise[~at_bound[:, dim], dim], law.cdf).pvalue > 1e-4
    assert np.abs(np.corrcoef(noise.T) - np.eye(3)).max() < 0.08


def test_random_cell_is_uniform_over_valid_cells():
    """Claim: valid cells are drawn equally often (chi-square), others never; cell 0 if none is."""
    valid = jnp.array([False, True, True, False, True, False, False, True, True, False])
    keys = jax.random.split(jax.random.key(3), NUM)
    cells = np.asarray(jax.vmap(lambda key: explore.random_cell(key, valid))(keys))
    count = np.bincount(cells, minlength=10)
    assert np.all(count[~np.asarray(valid)] == 0)
    assert stats.chisquare(count[np.asarray(valid)]).pvalue > 1e-4
    for valid, cell in (([False] * 4, 0), ([False, False, False, True], 3), ([True], 0)):
        assert explore.random_cell(jax.random.key(0), jnp.array(valid)) == cell
