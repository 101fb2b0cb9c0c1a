"""From set-points of the hand to those of a robot's joints."""

import jax
import jax.numpy as jnp
from flax import struct

from csac_jax.config import RobotKind
from csac_jax.sim import kinematics
from csac_jax.sim.primitives import Plan


@struct.dataclass
class Drive:
    """A plan as the robot's joints follow it. Q = joints, U = actuators, T = substeps."""

    start: jax.Array  # [Q] joint positions at rest, order of `World.robot_qpos`
    control: jax.Array  # [T, U]
    reachable: jax.Array  # [] bool, False where the robot cannot follow the whole plan


def drive(kind: RobotKind, plan: Plan) -> Drive:
    """How a robot follows a plan: the floating hand as it is, the arm by its inverse kinematics."""
    if kind == "hand":
        return Drive(jnp.append(plan.start, plan.start[4]), plan.control, jnp.ones((), bool))
    if kind == "ur5":
        way = kinematics.trajectory(
            jnp.asarray(kinematics.HOME), jnp.concatenate([plan.start[None], plan.control])
        )
        return Drive(jnp.append(way.target[0], way.target[0, 6]), way.target[1:], way.reachable)
    raise ValueError(f"sim.robot: {kind!r} is neither 'hand' nor 'ur5'")
