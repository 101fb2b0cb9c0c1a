"""C MuJoCo one substep after another: an independent loop, slow and plain, for comparison."""

from collections.abc import Iterator

import mujoco
import numpy as np

from csac_jax.robot.primitives import JointTrajectory
from csac_jax.sim.c_physics import Trajectory
from csac_jax.world import model, scene_state
from csac_jax.world.model import BlockFields, World
from csac_jax.world.scene_state import SceneState


def substeps(
    world: World, fields: BlockFields, scene: SceneState, joints: JointTrajectory
) -> Iterator[mujoco.MjData]:
    """The state after every substep, one and the same object; NumPy throughout."""
    exact = model.with_blocks(world, fields)
    exact.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data = mujoco.MjData(exact)
    data.qpos[world.robot_qpos] = joints.start
    data.qpos[world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
    data.qvel[world.block_dofs] = scene.velocity
    fastest = np.full(exact.nv, np.inf)
    fastest[world.block_dofs] = scene_state.SPEED_LIMIT
    parked = world.block_qpos[~scene.in_play]
    waiting = data.qpos[parked]
    for control in joints.control:
        data.ctrl[:] = control
        mujoco.mj_step(exact, data)
        data.qvel[:] = np.clip(data.qvel, -fastest, fastest)
        data.qpos[parked], data.qvel[world.block_dofs[~scene.in_play]] = waiting, 0.0
        yield data


def trajectory(
    world: World, fields: BlockFields, scene: SceneState, joints: JointTrajectory
) -> Trajectory:
    """The reference of `c_physics.trajectory` for a plan that the robot can follow."""
    states = [
        (data.qpos.copy(), data.qvel.copy(), data.sensordata.copy())
        for data in substeps(world, fields, scene, joints)
    ]
    return Trajectory(*map(np.stack, zip(*states, strict=True)))
