"""One primitive of one scene, whatever computes its physics."""

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
from csac_jax.sim.robot import Drive

MAX_SPEED = 20.0  # m/s and rad/s / 10; a faster block has left physics behind
MAX_HEIGHT = 1.0  # m from the workspace centre, likewise; of blocks in play
MAX_PARKED = 100.0  # m, of the others
UNIT = 0.01  # how far the square of a quaternion's length may be from 1
MAX_HALF_SIZE = 0.5  # m; of a block's box
MAX_DENSITY = 1e4  # kg/m^3
MAX_FRICTION = 10.0


class Physics(Protocol):
    """A world in which a robot can be moved."""

    def run(self, scene: Scene, drive: Drive) -> tuple[Scene, Trace]:
        """Moves the robot, one set-point per substep; blocks that are not in play stay where they
        are.

        Blocks that end up in the hand are still in play, hanging where the hand is. One scene;
        callers vmap.
        """


def make(world: World, cfg: SimConfig) -> Physics:
    """The physics that the config names: `mjx`, compiled with the rest; `warp`, the same on
    NVIDIA's Warp; or `c`, the reference, on the host's cores.

    Raises SceneError where `warp` is not installed.
    """
    if cfg.physics == "mjx":
        return mjx_physics.make(world, cfg)
    if cfg.physics == "warp":
        return warp_physics.make(world, cfg)
    if cfg.physics == "c":
        return c_physics.CPhysics(world, cfg)
    raise ValueError(f"sim.physics: {cfg.physics!r} names no engine; choose mjx, warp or c")


def execute(
    physics: Physics,
    cfg: SimConfig,
    heightmap: HeightmapConfig,
    scene: Scene,
    height: jax.Array,
    action: Action,
) -> tuple[Scene, Trace, Plan]:
    """Runs one primitive; one that the robot cannot follow is not begun: nothing moves, nothing is
    touched.

    Args: height [H, W] m, the map the action was chosen from.
    """
    plan = primitives.plan(cfg, heightmap, height, action)
    drive = robot.drive(cfg.robot, plan)
    after, trace = physics.run(scene, drive)
    still = (layout.park(scene, scene.in_play), outcome.blank(len(scene.colour)))
    after, trace = jax.tree.map(
        lambda new, old: jnp.where(drive.reachable, new, old), (after, trace), still
    )
    return after, trace, plan.replace(surface=jnp.where(drive.reachable, plan.surface, 0.0))


def healthy(scene: Scene) -> jax.Array:
    """True where every entry of a scene is one that a scene can have, [] bool: pose, speed, size,
    material, index.

    Bounds, not `isfinite`, since a lane may explode and stay finite; NaN fails every comparison.
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
