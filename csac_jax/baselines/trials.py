"""Actions tried in simulation: what each would do to a scene, all in one batch of the engine."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from csac_jax.config import Config
from csac_jax.robot.primitives import Action
from csac_jax.sim import physics as simulation
from csac_jax.sim.physics import Physics
from csac_jax.vision import observe
from csac_jax.world import scene_state
from csac_jax.world.scene_state import SceneState


class Trials(NamedTuple):
    """Effects of actions. K = actions, N = block slots; a trial has none where physics diverged, or
    where a guarded descent was stopped."""

    scene: SceneState  # [K, N, ...] afterwards, without the blocks that were lifted or lost
    lifted: Array  # [K, N] bool, blocks in the hand, as the environment judges
    lost: Array  # [K, N] bool, blocks that left the workspace
    share: Array  # [K, N] rise of a lifted block over the hand's, at most 1; else 0
    motion: Array  # [K] m, the way of all blocks that are left

    @property
    def wanted(self) -> Array:
        """Returns [K, N] bool, lifted blocks that the task asks for."""
        return self.lifted & jax.vmap(scene_state.is_target)(self.scene)


def simulate(
    cfg: Config, physics: Physics, scene: SceneState, height: Array, actions: Action
) -> Trials:
    """Simulates actions, leaves [K, ...], each from the same scene, over its map [H, W] m.

    Callers vmap over scenes: all actions of all scenes are one batch of the engine.
    """
    return jax.vmap(functools.partial(trial, cfg, physics, scene, height))(actions)


def height_map(cfg: Config, scene: SceneState) -> Array:
    """Returns the exact map [H, W] m of a scene, by the view of the config."""
    return observe.observe(cfg, scene).height


def trial(
    cfg: Config, physics: Physics, scene: SceneState, height: Array, action: Action
) -> Trials:
    """Simulates one action; returns leaves without the axis [K]."""
    motion = simulation.act(physics, cfg, scene, height, action)
    left, lifted = motion.after, motion.lifted
    way = jnp.linalg.norm(left.position - scene.position, axis=1)
    share = jnp.clip(motion.trace.rise / jnp.maximum(motion.hand_rise, 1e-3), 0.0, 1.0)
    way = jnp.sum(jnp.where(left.in_play, way, 0.0))
    return Trials(left, lifted, motion.lost, jnp.where(lifted, share, 0.0), way)
