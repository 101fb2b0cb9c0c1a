"""Networks that no training gives, and nothing compiles."""

from typing import Any

import jax
import numpy as np

from csac_jax.agent import actor_critic
from csac_jax.agent.actor_critic import LearnerState, Params
from csac_jax.config import Config


def random_params(cfg: Config, seed: int = 0, scale: float = 0.3) -> Params:
    """Draws every variable of the networks of a config."""
    return _drawn(actor_critic.abstract_params(cfg), seed, scale)


def learner_state(cfg: Config, seed: int = 0) -> LearnerState:
    """Draws all that a learner keeps; its counters are 0."""
    parts = actor_critic.make(cfg)
    return _drawn(jax.eval_shape(lambda: actor_critic.init(jax.random.key(0), parts)), seed, 0.3)


def _drawn(blank: Any, seed: int, scale: float) -> Any:
    rng = np.random.default_rng(seed)

    def draw(leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        is_float = np.issubdtype(leaf.dtype, np.floating)
        return (is_float * rng.normal(scale=scale, size=leaf.shape)).astype(leaf.dtype)

    return jax.tree.map(draw, blank)
