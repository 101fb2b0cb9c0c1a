"""Constructions: scenes in which hardly any grasp lifts before something has been pushed."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from csac_jax.config import SceneConfig
from csac_jax.world import scene_state
from csac_jax.world.scene_state import SceneState

SUITES = {"blocked": SceneConfig(slots=("box",) * 9, min_blocks=1)}
"""Slots of the scenes of each suite."""


class Construction(NamedTuple):
    """A way to build scenes of a suite."""

    suite: str  # a name of SUITES
    make: Callable[[jax.Array], SceneState]  # one scene from a key, NumPy leaves [N, ...]


def _grid(key: jax.Array) -> SceneState:
    """Lays three rows of three cubes."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    half = rng.uniform(0.0245, 0.025, (9, 1)).astype(np.float32).repeat(3, axis=1)
    xy = 0.05 * (np.indices((3, 3)).reshape(2, 9).T - 1.0)
    position = np.column_stack([xy, half[:, 2]]).astype(np.float32)
    blank = scene_state.parked(SUITES["blocked"].slots)
    return blank.replace(position=position, half_size=half, in_play=np.ones(9, bool))


TRAIN = {"grid": Construction("blocked", _grid)}
TEST: dict[str, Construction] = {}
