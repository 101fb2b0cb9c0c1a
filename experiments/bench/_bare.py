"""Physics by itself: plain steps from an action's first state with its set-points."""

import concurrent.futures
import functools
from collections.abc import Callable
from typing import Any

import jax
import mujoco
import numpy as np

from csac_jax.config import Config
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Action, JointTrajectory
from csac_jax.sim import mjx_physics
from csac_jax.sim.c_physics import CPhysics
from csac_jax.sim.mjx_physics import MjxPhysics
from csac_jax.sim.physics import Physics
from csac_jax.sim.quiet_mjx import mjx
from csac_jax.sim.warp_physics import WarpPhysics
from csac_jax.world import model
from csac_jax.world.scene_state import SceneState

AT_ONCE = 128  # scenes; XLA wants gigabytes for thousands


def joint_trajectories(cfg: Config, height: jax.Array, actions: Action) -> JointTrajectory:
    """Plans the joints of actions in height maps [E, H, W] m; leaves [E, ...]."""

    def joints(height: jax.Array, action: Action) -> JointTrajectory:
        plan = primitives.plan(cfg.sim, cfg.heightmap, height, action)
        return primitives.joint_trajectory(cfg.sim, plan)

    rows = functools.partial(jax.lax.map, lambda row: joints(*row), batch_size=AT_ONCE)
    return jax.jit(rows)((height, actions))


def loop(physics: Physics, scenes: SceneState, joints: JointTrajectory) -> Callable[[], Any]:
    """Returns a call that runs an action's plain steps of scenes and joints [E, ...]."""
    if isinstance(physics, MjxPhysics):
        return _mjx(physics, scenes, joints)
    if isinstance(physics, WarpPhysics):
        return _warp(physics, scenes, joints)
    assert isinstance(physics, CPhysics)
    return _c(physics, scenes, joints)


def _mjx(physics: MjxPhysics, scenes: SceneState, joints: JointTrajectory) -> Callable[[], Any]:
    def one(scene: SceneState, joints: JointTrajectory) -> jax.Array:
        its, data = (
            mjx_physics.scene_model(physics, scene),
            mjx_physics.initial_data(physics, scene, joints),
        )

        def step(data: mjx.Data, control: jax.Array) -> tuple[mjx.Data, None]:
            return mjx.step(its, data.replace(ctrl=control)), None

        return jax.lax.scan(step, data, joints.control)[0].qpos

    compiled = jax.jit(jax.vmap(one))
    return lambda: compiled(scenes, joints)


def _warp(physics: WarpPhysics, scenes: SceneState, joints: JointTrajectory) -> Callable[[], Any]:
    import warp as wp

    jax.block_until_ready(jax.jit(jax.vmap(physics.run))(scenes, joints))  # copies them in
    batch = physics.simulator.prepared(len(joints.control))
    steps = batch.recorded(batch.step)

    def call() -> None:
        batch.restart()
        steps()
        wp.synchronize()

    return call


def _c(physics: CPhysics, scenes: SceneState, joints: JointTrajectory) -> Callable[[], Any]:
    world = physics.world
    fields = jax.device_get(jax.vmap(lambda scene: model.scene_fields(world, scene))(scenes))
    rows = jax.device_get((scenes, fields, joints))
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], rows) for i in range(len(rows[2].reachable))]
    models = [model.with_blocks(world, field) for _, field, _ in each]

    def one(exact: mujoco.MjModel, row: tuple[Any, Any, Any]) -> None:
        scene, _, joints = row
        data = mujoco.MjData(exact)
        data.qpos[world.robot_qpos] = joints.start
        data.qpos[world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
        for control in joints.control:
            data.ctrl[:] = control
            mujoco.mj_step(exact, data)

    def call() -> int:
        with concurrent.futures.ThreadPoolExecutor() as threads:
            return len(list(threads.map(one, models, each)))

    return call
