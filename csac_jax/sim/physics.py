"""One primitive of one scene, whatever computes its physics."""

from typing import Protocol

import jax
import jax.numpy as jnp

from csac_jax.config import HeightmapConfig, SimConfig
from csac_jax.scene.layout import Scene
from csac_jax.scene.model import World
from csac_jax.sim import c_physics, mjx_physics, primitives
from csac_jax.sim.outcome import Trace
from csac_jax.sim.primitives import Action, Plan

MAX_SPEED = 20.0  # m/s and rad/s / 10; a faster block has left physics behind
MAX_HEIGHT = 1.0  # m, likewise


class Physics(Protocol):
    """A world in which a hand can be moved."""

    def run(self, scene: Scene, plan: Plan) -> tuple[Scene, Trace]:
        """Moves the hand through a plan, one set-point per substep; blocks that are not in play stay where they are.

        Blocks that end up in the hand are still in play, hanging where the hand is. One scene; callers vmap.
        """


def make(world: World, cfg: SimConfig) -> Physics:
    """The physics that the config names: `mjx`, compiled with the rest, or `c`, the reference, on the host's cores."""
    if cfg.physics == "mjx":
        return mjx_physics.make(world, cfg)
    if cfg.physics == "c":
        return c_physics.CPhysics(world, cfg)
    raise ValueError(f"sim.physics: {cfg.physics!r} is neither 'mjx' nor 'c'")


def execute(
    physics: Physics, cfg: SimConfig, heightmap: HeightmapConfig, scene: Scene, height: jax.Array, action: Action
) -> tuple[Scene, Trace, Plan]:
    """Runs one primitive.

    Args: height [H, W] m, the map the action was chosen from.
    """
    plan = primitives.plan(cfg, heightmap, height, action)
    after, trace = physics.run(scene, plan)
    return after, trace, plan


def healthy(scene: Scene) -> jax.Array:
    """True where every block is finite, slow enough and near the table, [] bool. Bounds, since a lane may explode and
    stay finite."""
    speed = jnp.abs(scene.velocity) * jnp.array([1, 1, 1, 0.1, 0.1, 0.1])
    finite = jnp.all(jnp.isfinite(scene.position)) & jnp.all(jnp.isfinite(scene.quaternion))
    bounded = jnp.all(speed < MAX_SPEED) & jnp.all(
        jnp.where(scene.in_play[:, None], jnp.abs(scene.position), 0) < MAX_HEIGHT
    )
    return finite & bounded
