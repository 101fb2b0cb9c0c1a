"""Push and grasp as one fixed-length sequence of set-points: both run in the same scan."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from csac_jax import geometry, grippers
from csac_jax.config import HeightmapConfig, SimConfig
from csac_jax.constants import Primitive
from csac_jax.grippers import Fingers, Gripper
from csac_jax.robot import fit, kinematics

BLOCK = 0.05  # m, height of a common block
START_GAP = 0.01  # m, between the open hand's tips and what lies under them at the start
DESCENT_SHARE = 0.75  # of its time that a guarded descent takes; then the hand comes to rest (ours)


@struct.dataclass
class Action:
    """A primitive at a place. `z` follows from the heightmap."""

    primitive: Array  # [] int32, Primitive
    pose: Array  # [3] x m, y m, yaw rad: a push goes along the yaw, fingers close along it

    @classmethod
    def grasp(cls, x: Array | float, y: Array | float, yaw: Array | float) -> "Action":
        """Makes a grasp at (x, y) m, closing along `yaw` rad; numbers or arrays [...]."""
        return cls._at(Primitive.GRASP, x, y, yaw)

    @classmethod
    def push(cls, x: Array | float, y: Array | float, yaw: Array | float) -> "Action":
        """Makes a push from (x, y) m along `yaw` rad; numbers or arrays [...]."""
        return cls._at(Primitive.PUSH, x, y, yaw)

    @classmethod
    def _at(cls, kind: Primitive, *pose: Array | float) -> "Action":
        parts = jnp.broadcast_arrays(*(jnp.asarray(value, jnp.float32) for value in pose))
        return cls(jnp.full(parts[0].shape, kind, jnp.int32), jnp.stack(parts, axis=-1))


@struct.dataclass
class Plan:
    """Set-points of the hand. T = substeps."""

    control: Array  # [T, 5] x m, y m, z m (finger tips), yaw rad, half the opening m
    start: Array  # [5] where the hand starts, at rest; same columns
    surface: Array  # [] m, highest surface in the window about the place


@struct.dataclass
class JointTrajectory:
    """A plan as the robot's joints follow it. Q = joints, U = actuators, T = substeps."""

    start: Array  # [Q] joint positions at rest, order of `World.robot_qpos`
    control: Array  # [T, U]
    reachable: Array  # [] bool, False where the robot cannot follow the whole plan


def local_top(cfg: HeightmapConfig, height: Array, xy: Array, side: Any) -> Array:
    """Returns the highest surface [] m of a map [H, W] m in a window of `side` m at `xy` [2] m."""
    distance = jnp.max(jnp.abs(geometry.cell_centres(cfg) - xy[None, None]), axis=-1)
    return jnp.max(jnp.where(distance <= 0.5 * jnp.maximum(side, cfg.cell), height, 0.0))


def plan(
    cfg: SimConfig,
    heightmap: HeightmapConfig,
    height: Array,
    action: Action,
    fingers: Fingers | None = None,
) -> Plan:
    """Plans the set-points of a primitive, one of VPG's two (arXiv:1803.09956).

    Grasp: straight down to `grasp_depth` below the surface, close, lift. With `sim.opening fit` it
    moves and opens as `fit.fit` finds, else fully. Push: down with closed fingers to `push_depth`,
    then `push_length` along the yaw, or to the border of the workspace, then lift. `fingers`
    default to the gripper's.
    """
    is_grasp = action.primitive == Primitive.GRASP
    xy, yaw = action.pose[:2], action.pose[2]
    gripper = grippers.load(cfg.gripper)
    fingers = gripper.fingers if fingers is None else fingers
    surface = local_top(heightmap, height, xy, fingers.width)
    depth = jnp.where(is_grasp, grasp_depth(cfg, gripper), cfg.push_depth)
    low = jnp.maximum(surface - depth, lowest(cfg, gripper))
    around = local_top(heightmap, height, xy, 2.0 * gripper.radius)
    high = jnp.maximum(low + cfg.approach_height, around + START_GAP)
    closed, opening = gripper.half[0], 0.5 * jnp.asarray(fingers.opening)
    start = xy
    if cfg.opening == "fit":
        shift, opening = fit.fit(heightmap, height, action.pose, low, gripper, fingers)
        moved = xy + shift * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
        start = jnp.where(is_grasp, moved, xy)
    opening = jnp.where(is_grasp, opening, closed)
    end = jnp.where(is_grasp, start, _push_end(cfg, heightmap, xy, yaw))
    phases = jnp.where(is_grasp, _progress(cfg, cfg.grasp_phases), _progress(cfg, cfg.push_phases))
    descend, act, lift = phases  # [T] each
    z = high + (low - high) * descend + (high - low) * lift
    place = start[None] + act[:, None] * (end - start)[None]
    half = closed + (opening - closed) * (1.0 - jnp.minimum(1.3 * act, 1.0))  # before the lift
    control = jnp.column_stack([place, z, jnp.full_like(z, yaw), half])
    return Plan(control=control, start=jnp.hstack([start, high, yaw, opening]), surface=surface)


def reachable(cfg: SimConfig, heightmap: HeightmapConfig, xy: Array, yaw: Array) -> Array:
    """Returns [P] bool, the arm reaches each primitive at `xy` [2] m, on the table and above a
    block, on one branch."""
    if cfg.robot == "hand":
        return jnp.ones(len(Primitive), bool)
    low = lowest(cfg, grippers.load(cfg.gripper))
    ends = xy, _push_end(cfg, heightmap, xy, yaw)
    tips = [jnp.append(end, z) for end in ends for z in (low, low + cfg.approach_height + BLOCK)]
    by_branch = kinematics.reaches(kinematics.arm(cfg), jnp.stack(tips), yaw)  # [4, 8]
    needed = {Primitive.PUSH: by_branch, Primitive.GRASP: by_branch[:2]}
    return jnp.stack([jnp.any(jnp.all(needed[p], axis=0)) for p in Primitive])


def _push_end(cfg: SimConfig, heightmap: HeightmapConfig, xy: Array, yaw: Array) -> Array:
    direction, limit = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)]), 0.5 * heightmap.extent
    return jnp.clip(xy + cfg.push_length * direction, -limit, limit)


def grasp_depth(cfg: SimConfig, gripper: Gripper) -> float:
    """Returns how far the tips go below the grasped surface, m; the palm stays above it."""
    return min(cfg.grasp_depth, gripper.deepest)


def lowest(cfg: SimConfig, gripper: Gripper) -> float:
    """Returns the least height of the tips above the table, m."""
    return cfg.clearance or gripper.clearance


def _progress(cfg: SimConfig, phases: tuple[int, int, int]) -> np.ndarray:
    """Returns the progress of each phase, 0 to 1, at every substep, [3, T]."""
    times, lengths = np.arange(1, sum(phases) + 1), np.array(phases)[:, None]
    starts = np.cumsum(lengths, axis=0) - lengths
    share = np.array([DESCENT_SHARE if cfg.approach == "guarded" else 1.0, 1.0, 1.0])[:, None]
    linear = np.clip((times - starts) / (share * lengths), 0, 1)
    linear[2] = linear[2] ** 2 * (3.0 - 2.0 * linear[2])  # a jerky lift shakes blocks loose
    return linear.astype(np.float32)


def joint_trajectory(cfg: SimConfig, plan: Plan) -> JointTrajectory:
    """Converts a plan to joint set-points: as they are for the hand, by an arm's inverse.

    Tips that close on an arc get lower: the hand rises by as much. An arm's tool has a drive of its
    own along its axis, whose set-point is 0.
    """
    gripper = grippers.load(cfg.gripper)
    control = jnp.concatenate([plan.start[None], plan.control])
    half = control[:, 4]
    control = control.at[:, 2].add(gripper.drop(half, jnp))
    start = jnp.stack(gripper.joint_positions(half[0], jnp))
    set_point = gripper.set_point(half[1:], jnp)[:, None]
    if cfg.robot == "hand":
        moved, reachable = control[:, :4], jnp.ones((), bool)
    else:
        arm, home = kinematics.arm(cfg), jnp.asarray(kinematics.HOME)
        moved, reachable = kinematics.joint_targets(arm, home, control)
        moved = jnp.pad(moved, ((0, 0), (0, 1)))
    targets = jnp.concatenate([moved[1:], set_point], axis=1)
    return JointTrajectory(jnp.concatenate([moved[0], start]), targets, reachable)
