"""Which objects the slots of a scene hold. It needs no MuJoCo."""

import numpy as np

from csac_jax.config import SceneConfig
from csac_jax.objects import tables
from csac_jax.objects.library import Library
from csac_jax.objects.tables import Tables
from csac_jax.scene import blocks
from csac_jax.scene.layout import Scene


def library(cfg: SceneConfig) -> Library:
    """The objects that scenes of this config draw from. Raises LibraryError."""
    return tables.find(cfg.objects, cfg.split)


def table(cfg: SceneConfig) -> Tables:
    """The same as arrays."""
    return tables.of(library(cfg))


def drawn(rng: np.random.Generator, cfg: SceneConfig, scene: Scene) -> Scene:
    """The scene with random objects in their slots, each at most once where there are enough."""
    slots, known = np.flatnonzero(blocks.is_object(cfg.slots)), table(cfg)
    rounds = -(-len(slots) // len(known.half))
    order = np.concatenate([rng.permutation(len(known.half)) for _ in range(rounds)])
    return hold(scene, slots, order[: len(slots)], known)


def hold(scene: Scene, slots: np.ndarray, numbers: np.ndarray, known: Tables) -> Scene:
    """The scene with the objects `numbers` [M] of a library in `slots` [M]."""
    object_id, half_size = scene.object_id.copy(), scene.half_size.copy()
    object_id[slots], half_size[slots] = numbers, known.half[numbers]
    return scene.replace(object_id=object_id, half_size=half_size)
