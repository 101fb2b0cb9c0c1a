"""One primitive of one scene, on any physics engine."""

import functools
from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp

from csac_jax.config import Config, SimConfig
from csac_jax.errors import SettingsError
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Action, JointTrajectory, Plan
from csac_jax.sim import c_physics, warp_physics
from csac_jax.sim.outcome import Trace
from csac_jax.world import blocks, scene_state
from csac_jax.world.model import World
from csac_jax.world.scene_state import SceneState


class Physics(Protocol):
    """A world in which a robot can be moved."""

    def run(self, scene: SceneState, joints: JointTrajectory) -> tuple[SceneState, Trace]:
        """Moves the robot, one set-point per substep; blocks out of play stay. Callers vmap."""


def _make_mjx(world: World, cfg: SimConfig) -> Physics:
    from csac_jax.sim import mjx_physics  # MJX imports slower than the rest of the package

    return mjx_physics.MjxPhysics(world, cfg)


PHYSICS: dict[str, Callable[[World, SimConfig], Physics]] = {
    "mjx": _make_mjx,
    "warp": warp_physics.make,
    "c": c_physics.CPhysics,
}
"""Engines by their name in the config. Each raises an error for a world that it cannot run."""


def make(world: World, cfg: SimConfig) -> Physics:
    """Makes the engine that the config names. Raises SettingsError for `auto`."""
    if cfg.physics not in PHYSICS:
        engines = ", ".join(PHYSICS)
        raise SettingsError(f"sim.physics: {cfg.physics!r} is no engine; choose one of: {engines}")
    return PHYSICS[cfg.physics](world, cfg)


def prepare(physics: Physics, scenes: int) -> None:
    """Prepares the first action of so many scenes, for which Warp builds kernels for minutes."""
    if isinstance(physics, warp_physics.WarpPhysics):
        physics.simulator.prepared(scenes)


def execute(
    physics: Physics, cfg: Config, scene: SceneState, height: jax.Array, action: Action
) -> tuple[SceneState, Trace, Plan]:
    """Runs a primitive over the map `height` [H, W] m; nothing moves if the robot cannot follow."""
    plan = primitives.plan(cfg.sim, cfg.heightmap, height, action, scene.fingers)
    joints = primitives.joint_trajectory(cfg.sim, plan)
    after, trace = physics.run(scene, joints)
    unmoved = scene_state.park(scene, scene.in_play), jax.tree.map(jnp.zeros_like, trace)
    choose = functools.partial(jnp.where, joints.reachable)
    after, trace = jax.tree.map(choose, (after, trace), unmoved)
    return after, trace, plan.replace(surface=choose(plan.surface, 0.0))


def reachable(cfg: Config, height: jax.Array, action: Action) -> jax.Array:
    """Returns [] bool, the robot can follow the whole of a primitive, as `execute` decides."""
    plan = primitives.plan(cfg.sim, cfg.heightmap, height, action)
    return primitives.joint_trajectory(cfg.sim, plan).reachable


def healthy(scene: SceneState) -> jax.Array:
    """Returns [] bool, every entry of a scene lies within its bounds, which NaN does not."""
    reach = jnp.where(scene.in_play[:, None], 1.0, 100.0)  # m from the workspace centre
    speed = jnp.array([20.0, 20.0, 20.0, 200.0, 200.0, 200.0])  # m/s and rad/s
    length = jnp.sum(scene.quaternion**2, axis=1)
    bounded = (
        jnp.all(jnp.abs(scene.position) < reach),
        jnp.all(jnp.abs(scene.velocity) < speed),
        jnp.all(jnp.abs(length - 1.0) < 0.01),
        jnp.all((scene.half_size > 0.0) & (scene.half_size < 0.5)),  # m
        jnp.all((scene.density > 0.0) & (scene.density < 1e4)),  # kg/m^3
        jnp.all((scene.friction > 0.0) & (scene.friction < 10.0)),
        jnp.all((scene.colour >= 0) & (scene.colour < len(blocks.COLOURS))),
        (scene.target >= scene_state.ANY) & (scene.target < len(scene.colour)),  # ANY is -1
    )
    return jnp.all(jnp.stack(bounded))
