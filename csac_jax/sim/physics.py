"""One primitive of one scene, on any physics engine."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from csac_jax.config import Config, SimConfig
from csac_jax.constants import Primitive
from csac_jax.errors import SettingsError
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Action, JointTrajectory, Plan
from csac_jax.sim import c_physics, outcome, warp_physics
from csac_jax.sim.outcome import Trace
from csac_jax.world import blocks, scene_state
from csac_jax.world.model import World
from csac_jax.world.scene_state import SceneState


class Physics(Protocol):
    """A world in which a robot can be moved."""

    def run(self, scene: SceneState, joints: JointTrajectory) -> tuple[SceneState, Trace]:
        """Moves the robot, one set-point per substep; blocks out of play stay. Callers vmap."""


class Motion(NamedTuple):
    """One action as physics ran it. N = block slots."""

    before: SceneState
    after: SceneState  # without blocks that are gone; as before where undone
    trace: Trace
    surface: jax.Array  # [] m, see `primitives.Plan`
    is_grasp: jax.Array  # [] bool
    hand_rise: jax.Array  # [] m, from the lowest set-point
    diverged: jax.Array  # [] bool, physics failed, or the inputs were void
    blocked: jax.Array  # [] bool, undone: a guarded descent was stopped
    lifted: jax.Array  # [N] bool, blocks in the hand
    lost: jax.Array  # [N] bool, blocks that left the workspace


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


class Started(NamedTuple):
    """A primitive that physics runs, between `start` and `finish`."""

    scene: SceneState
    action: Action
    plan: Plan
    reachable: jax.Array  # [] bool, the robot can follow
    valid: jax.Array | bool  # [] bool, see `act`
    running: Any  # of Warp a token of the result, else the result


def start(
    physics: Physics,
    cfg: Config,
    scene: SceneState,
    height: jax.Array,
    action: Action,
    valid: jax.Array | bool = True,
    background: bool = False,
) -> Started:
    """Starts a primitive, see `act`. In the `background` Warp runs on: `finish` it before another
    one of as many scenes starts."""
    plan = primitives.plan(cfg.sim, cfg.heightmap, height, action, scene.fingers)
    joints = primitives.joint_trajectory(cfg.sim, plan)
    waits = not (background and isinstance(physics, warp_physics.WarpPhysics))
    running = physics.run(scene, joints) if waits else physics.start(scene, joints)
    return Started(scene, action, plan, joints.reachable, valid, running)


def finish(physics: Physics, cfg: Config, started: Started, after: jax.Array) -> Motion:
    """Waits for a primitive once `after` [] was computed; until then Warp runs beside that."""
    result = started.running
    if isinstance(physics, warp_physics.WarpPhysics):
        result = physics.finish(started.scene, result, after)
    return _judged(cfg, started, *result)


def execute(
    physics: Physics, cfg: Config, scene: SceneState, height: jax.Array, action: Action
) -> tuple[SceneState, Trace, Plan]:
    """Runs a primitive over the map `height` [H, W] m; nothing moves if the robot cannot follow."""
    started = start(physics, cfg, scene, height, action)
    return _followed(started, *started.running)


def act(
    physics: Physics,
    cfg: Config,
    scene: SceneState,
    height: jax.Array,
    action: Action,
    valid: jax.Array | bool = True,
) -> Motion:
    """Runs a primitive, as `execute`, and takes lifted and lost blocks off the table. Undoes one
    that is not `valid` [] bool, that diverges or that is blocked."""
    started = start(physics, cfg, scene, height, action, valid)
    return _judged(cfg, started, *started.running)


def _followed(started: Started, after: SceneState, trace: Trace) -> tuple[SceneState, Trace, Plan]:
    """Returns the scene as it was where the robot cannot follow."""
    scene, plan = started.scene, started.plan
    unmoved = scene_state.park(scene, scene.in_play), jax.tree.map(jnp.zeros_like, trace)
    choose = functools.partial(jnp.where, started.reachable)
    after, trace = jax.tree.map(choose, (after, trace), unmoved)
    return after, trace, plan.replace(surface=choose(plan.surface, 0.0))


def _judged(cfg: Config, started: Started, after: SceneState, trace: Trace) -> Motion:
    """Takes lifted and lost blocks off the table, and undoes what `act` names."""
    scene, action, valid = started.scene, started.action, started.valid
    after, trace, plan = _followed(started, after, trace)
    finite = jnp.all(jnp.isfinite(action.pose))  # C MuJoCo would continue
    diverged = ~(valid & finite & healthy(after))
    stopped = trace.lag[action.primitive] > outcome.STOPPED
    blocked = (cfg.sim.approach == "guarded") & stopped & ~diverged
    undone = diverged | blocked
    after = jax.tree.map(functools.partial(jnp.where, undone), scene, after)
    is_grasp = action.primitive == Primitive.GRASP
    hand_rise = plan.start[2] - jnp.min(plan.control[:, 2])
    lifted = outcome.lifted_blocks(trace, hand_rise) & is_grasp & ~undone
    side = cfg.scene.tray or cfg.heightmap.extent  # over a wall, too, is lost
    lost = after.in_play & ~scene_state.inside(after.position, side) & ~lifted
    after = scene_state.park(after, ~lifted & ~lost)
    judged = plan.surface, is_grasp, hand_rise, diverged, blocked, lifted, lost
    return Motion(scene, after, trace, *judged)


def reachable(cfg: Config, height: jax.Array, action: Action) -> jax.Array:
    """Returns [] bool, the robot can follow the whole of a primitive, as `execute` decides."""
    plan = primitives.plan(cfg.sim, cfg.heightmap, height, action)
    return primitives.joint_trajectory(cfg.sim, plan).reachable


def healthy(scene: SceneState) -> jax.Array:
    """Returns [] bool, every entry of a scene lies within its bounds, which NaN does not. A block
    that a grip threw metres away does: it is lost."""
    speed = jnp.array([20.0, 20.0, 20.0, 200.0, 200.0, 200.0])  # m/s and rad/s
    length = jnp.sum(scene.quaternion**2, axis=1)
    bounded = (
        jnp.all(jnp.abs(scene.position) < 100.0),  # m from the workspace centre
        jnp.all(jnp.abs(scene.velocity) < speed),
        jnp.all(jnp.abs(length - 1.0) < 0.01),
        jnp.all((scene.half_size > 0.0) & (scene.half_size < 0.5)),  # m
        jnp.all((scene.density > 0.0) & (scene.density < 1e4)),  # kg/m^3
        jnp.all((scene.friction > 0.0) & (scene.friction < 10.0)),
        jnp.all((scene.colour >= 0) & (scene.colour < len(blocks.COLOURS))),
        (scene.target >= scene_state.ANY) & (scene.target < len(scene.colour)),  # ANY is -1
    )
    return jnp.all(jnp.stack(bounded))
