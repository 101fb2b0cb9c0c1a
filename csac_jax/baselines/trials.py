"""Actions tried in simulation: what each would do to a scene, all in one batch of the engine."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.robot.primitives import Action
from csac_jax.sim import outcome, physics as simulation
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
    grip: Array  # [K, N] rise of a lifted block over the hand's, at most 1; else 0
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
    after, trace, plan = simulation.execute(physics, cfg, scene, height, action)
    guarded = cfg.sim.approach == "guarded"
    sound = simulation.healthy(after) & ~(guarded & outcome.is_stopped(trace, action.primitive))
    after = jax.tree.map(functools.partial(jnp.where, sound), after, scene)
    hand_rise = plan.start[2] - jnp.min(plan.control[:, 2])
    is_grasp = action.primitive == Primitive.GRASP
    lifted = outcome.lifted_blocks(trace, hand_rise) & is_grasp & sound
    inside = scene_state.inside(after.position, cfg.scene.tray or cfg.heightmap.extent)
    lost = after.in_play & ~inside & ~lifted
    left = scene_state.park(after, ~lifted & ~lost)
    way = jnp.linalg.norm(left.position - scene.position, axis=1)
    share = jnp.clip(trace.rise / jnp.maximum(hand_rise, 1e-3), 0.0, 1.0)
    grip = jnp.where(lifted, share, 0.0)
    return Trials(left, lifted, lost, grip, jnp.sum(jnp.where(left.in_play, way, 0.0)))
