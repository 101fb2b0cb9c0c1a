"""Small configs, networks that are all random, and scenes drawn on a height map."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.agent import actor_critic, maps
from csac_jax.agent.actor_critic import ActorCritic, LearnerState
from csac_jax.agent.maps import Frames
from csac_jax.config import Config, SmallNet
from csac_jax.nets import networks
from csac_jax.vision.heightmap import Observation


@pytest.fixture(scope="session")
def cfg() -> Config:
    """The smallest preset with eight yaws, and a run so long that no schedule moves on."""
    net = SmallNet(rotations=8, growth=4, dilations=(1, 2), stem=4, head=8)
    return presets.smoke().change(net=net, train={"actions": 1_000_000})


@pytest.fixture(scope="session")
def frames(cfg: Config) -> Frames:
    return maps.frames(cfg, networks.make(cfg.net))


@pytest.fixture(scope="session")
def learner(cfg: Config) -> ActorCritic:
    return actor_critic.make(cfg)


@pytest.fixture(scope="session")
def randomised() -> Callable[[LearnerState], LearnerState]:
    """Makes every parameter random, so that maps vary by about 1; target and online differ."""

    def noisy(params, seed: int):
        rng = np.random.default_rng(seed)
        return jax.tree.map(
            lambda leaf: leaf + jnp.asarray(rng.normal(scale=0.2, size=leaf.shape), leaf.dtype),
            params,
        )

    return lambda state: state.replace(online=noisy(state.online, 0), target=noisy(state.target, 1))


@pytest.fixture(scope="session")
def observations(cfg: Config) -> Callable[[int, int], Observation]:
    """Draws `num` scenes of four coloured boxes each, leaves [num, ...]."""
    size = cfg.heightmap.size

    def draw(num: int, seed: int) -> Observation:
        rng = np.random.default_rng(seed)
        height, colour = np.zeros((num, size, size)), np.full((num, size, size, 3), 0.33)
        for scene in range(num):
            for _ in range(4):
                row, col = rng.integers(1, size - 7, 2)
                block = (
                    scene,
                    slice(row, row + rng.integers(2, 7)),
                    slice(col, col + rng.integers(2, 7)),
                )
                height[block] = rng.uniform(0.02, 0.06)
                colour[block] = rng.uniform(size=3)
        return Observation(
            colour=jnp.asarray(colour, jnp.float32),
            height=jnp.asarray(height, jnp.float32),
            target=jnp.ones((num, size, size), bool),
        )

    return draw
