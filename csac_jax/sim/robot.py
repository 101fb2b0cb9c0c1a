"""From set-points of the hand to those of a robot's joints."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax.config import RobotKind
from csac_jax.sim import kinematics
from csac_jax.sim.primitives import Plan


@struct.dataclass
class JointTrajectory:
    """A plan as the robot's joints follow it. Q = joints, U = actuators, T = substeps."""

    start: jax.Array  # [Q] joint positions at rest, order of `World.robot_qpos`
    control: jax.Array  # [T, U]
    reachable: jax.Array  # [] bool, False where the robot cannot follow the whole plan


def _hand(plan: Plan) -> JointTrajectory:
    """The floating hand follows the plan as it is."""
    return JointTrajectory(jnp.append(plan.start, plan.start[4]), plan.control, jnp.ones((), bool))


def _ur5(plan: Plan) -> JointTrajectory:
    """The arm follows by its inverse kinematics."""
    control = jnp.concatenate([plan.start[None], plan.control])
    target, reachable = kinematics.joint_targets(jnp.asarray(kinematics.HOME), control)
    return JointTrajectory(jnp.append(target[0], target[0, 6]), target[1:], reachable)


ROBOTS: dict[RobotKind, Callable[[Plan], JointTrajectory]] = {"hand": _hand, "ur5": _ur5}


def joint_trajectory(kind: RobotKind, plan: Plan) -> JointTrajectory:
    """How the joints of a robot follow a plan."""
    return ROBOTS[kind](plan)
