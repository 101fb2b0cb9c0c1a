"""One primitive of one scene, whatever computes its physics."""

from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp

from csac_jax.config import HeightmapConfig, SimConfig
from csac_jax.scene import blocks, layout
from csac_jax.scene.layout import Scene
from csac_jax.scene.model import World
from csac_jax.sim import c_physics, mjx_physics, outcome, primitives, robot, warp_physics
from csac_jax.sim.outcome import Trace
from csac_jax.sim.primitives import Action, Plan
from csac_jax.sim.robot import JointTrajectory

# Bounds of a healthy scene.
MAX_SPEED = 20.0  # m/s and rad/s / 10
MAX_HEIGHT = 1.0  # m from the workspace centre, of blocks in play
MAX_PARKED = 100.0  # m from the workspace centre, of the others
UNIT = 0.01  # how far the square of a quaternion's length may be from 1
MAX_HALF_SIZE = 0.5  # m, of a block's box
MAX_DENSITY = 1e4  # kg/m^3
MAX_FRICTION = 10.0


class Physics(Protocol):
    """A world in which a robot can be moved."""

    def run(self, scene: Scene, joints: JointTrajectory) -> tuple[Scene, Trace]:
        """Moves the robot, one set-point per substep. One scene; callers vmap.

        Blocks that are not in play stay where they are. Blocks that end up in the hand are still
        in play, hanging where the hand is.
        """


PHYSICS: dict[str, Callable[[World, SimConfig], Physics]] = {
    "mjx": mjx_physics.make,
    "warp": warp_physics.make,
    "c": c_physics.CPhysics,
}
"""Every physics by its name in the config. Each refuses, with SceneError, what it cannot do."""


def make(world: World, cfg: SimConfig) -> Physics:
    """The physics that the config names. Raises ValueError for `auto`: see `sim.backend`."""
    if cfg.physics not in PHYSICS:
        raise ValueError(
            f"sim.physics: {cfg.physics!r} names no engine; choose one of: {', '.join(PHYSICS)}"
        )
    return PHYSICS[cfg.physics](world, cfg)


def execute(
    physics: Physics,
    cfg: SimConfig,
    heightmap: HeightmapConfig,
    scene: Scene,
    height: jax.Array,
    action: Action,
) -> tuple[Scene, Trace, Plan]:
    """Runs one primitive. Nothing moves if the robot cannot follow the whole of it.

    Args: height [H, W] m, the map the action was chosen from.
    """
    plan = primitives.plan(cfg, heightmap, height, action)
    joints = robot.joint_trajectory(cfg.robot, plan)
    after, trace = physics.run(scene, joints)
    unmoved = (layout.park(scene, scene.in_play), outcome.blank(len(scene.colour)))
    after, trace = jax.tree.map(
        lambda new, old: jnp.where(joints.reachable, new, old), (after, trace), unmoved
    )
    return after, trace, plan.replace(surface=jnp.where(joints.reachable, plan.surface, 0.0))


def healthy(scene: Scene) -> jax.Array:
    """True where every entry of a scene lies within its bounds, [] bool.

    Bounds, not `isfinite`: physics may explode and stay finite. NaN fails every comparison.
    """
    speed = jnp.abs(scene.velocity) * jnp.array([1, 1, 1, 0.1, 0.1, 0.1])
    reach = jnp.where(scene.in_play[:, None], MAX_HEIGHT, MAX_PARKED)
    length = jnp.sum(scene.quaternion**2, axis=1)
    target, last = scene.target, len(scene.colour) - 1
    bounded = (
        jnp.all(jnp.abs(scene.position) < reach),
        jnp.all(speed < MAX_SPEED),
        jnp.all(jnp.abs(length - 1.0) < UNIT),
        jnp.all((scene.half_size > 0.0) & (scene.half_size < MAX_HALF_SIZE)),
        jnp.all((scene.density > 0.0) & (scene.density < MAX_DENSITY)),
        jnp.all((scene.friction > 0.0) & (scene.friction < MAX_FRICTION)),
        jnp.all((scene.colour >= 0) & (scene.colour < len(blocks.COLOURS))),
        (target == layout.ANY) | ((target >= 0) & (target <= last)),
    )
    return jnp.all(jnp.stack(bounded))
