"""UR5 and UR5e in closed form: forward and inverse kinematics of the finger tips.

The tip frame is the gripper's: between the open finger tips, z back to the flange, fingers closing
along x. Joint angles [6] rad have the maker's order and sense: shoulder pan, shoulder lift, elbow,
wrist 1, 2, 3. Sums are written out, since a GPU may round matrix products to ten bits.
"""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from csac_jax import grippers
from csac_jax.config import SimConfig
from csac_jax.geometry import FULL_TURN


class DHParameters(NamedTuple):
    """Denavit-Hartenberg parameters of an arm by its maker, m, and capsules about its links."""

    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float
    shoulder_offset: float  # along `side`, of the upper arm's middle
    forearm_offset: float  # and of the forearm's
    radii: tuple[float, ...]  # of the capsules along `_chain`, pedestal to wrist 2


_RADII = (0.06, 0.06, 0.054, 0.06, 0.04, 0.045, 0.045)  # of both; sources: scenes/README.md
_UR5 = 0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823, 0.13585, 0.0165
_UR5E = 0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996, 0.138, 0.007
ARMS = {"ur5": DHParameters(*_UR5, _RADII), "ur5e": DHParameters(*_UR5E, _RADII)}


class Arm(NamedTuple):
    """An arm where it stands, with its gripper."""

    links: DHParameters
    base: tuple[float, float, float, float]  # x, y, z m and yaw rad
    tool: float  # m, flange to tip frame
    body_radius: float  # m, of the capsule about wrist 3 and the gripper's body
    hand_capsule: tuple[float, float, float]  # m, about the open hand: back from the tips, radius


def arm(cfg: SimConfig) -> Arm:
    """Returns the arm of a config, with its gripper."""
    gripper = grippers.load(cfg.gripper)
    tool = cfg.adapter + gripper.depth[1]
    return Arm(ARMS[cfg.robot], cfg.base, tool, gripper.body_radius, gripper.hand_capsule)


LIMITS = np.pi * np.array([2.0, 2.0, 1.0, 2.0, 2.0, 2.0], np.float32)  # rad, either way
# rad, ours: tips 0.2 m above the centre
HOME = np.array([-0.183, -0.976, 1.832, -2.426, -1.571, 1.388], np.float32)

SINGULAR = 0.01  # least sine of shoulder, elbow and wrist angle for a branch to count: ours
_TABLE_CLEARANCE = 0.02  # m, least distance between a link and the table
_LINK_CLEARANCE = 0.01  # m, least distance between two links
_FAR = 10.0  # m, positions beyond are out of reach whatever the arm does

# Signs of shoulder, elbow and wrist: the eight solutions for a pose.
BRANCHES = np.array(list(itertools.product((1.0, -1.0), repeat=3)), np.float32)


class TipPose(NamedTuple):
    """Pose of the finger tips, world frame."""

    position: Array  # [3] m
    rotation: Array  # [3, 3], tip to world


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=-1)


def _frames(arm: Arm, q: Array) -> tuple[list[Array], Array, Array, Array]:
    """Computes the arm at the joint angles `q` [6]; world frame, [3] each.

    Returns: shoulder, elbow and wrists 1, 2, 3, m; the axes of joints 2 to 4, of x of the tip
    frame, and of joint 6, from the flange to the tips.
    """
    links, (*base, yaw) = arm.links, arm.base
    q = q.at[0].add(yaw)
    cos, sin = jnp.cos(q), jnp.sin(q)
    ahead, side = jnp.array([cos[0], sin[0], 0.0]), jnp.array([sin[0], -cos[0], 0.0])
    up = jnp.array([0.0, 0.0, 1.0])

    def along(angle):
        return jnp.cos(angle) * ahead + jnp.sin(angle) * up

    shoulder = jnp.array(base) + links.d1 * up
    elbow = shoulder + links.a2 * along(q[1])
    wrist1 = elbow + links.a3 * along(q[1] + q[2])
    bend = q[1] + q[2] + q[3]
    x4, z4 = along(bend), jnp.sin(bend) * ahead - jnp.cos(bend) * up
    wrist2 = wrist1 + links.d4 * side
    wrist3 = wrist2 + links.d5 * z4
    closing = cos[5] * (cos[4] * x4 + sin[4] * side) - sin[5] * z4
    down = cos[4] * side - sin[4] * x4
    return [shoulder, elbow, wrist1, wrist2, wrist3], side, closing, down


def forward(arm: Arm, q: Array) -> TipPose:
    """Returns the pose of the finger tips at the joint angles `q` [6] rad."""
    (*_, wrist3), _, closing, down = _frames(arm, q)
    columns = (closing, jnp.cross(closing, down), -down)
    return TipPose(wrist3 + (arm.links.d6 + arm.tool) * down, jnp.stack(columns, axis=1))


def top_down(xyz: Array, yaw: Array) -> TipPose:
    """Returns the pose of a hand pointing down, tips at `xyz` [3] m, closing along `yaw` [] rad."""
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return TipPose(xyz, jnp.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]))


def inverse(arm: Arm, position: Array, rotation: Array) -> tuple[Array, Array]:
    """Solves for the joint angles of all eight branches to a pose of the tips, in closed form.

    After Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms" (2013).
    Arc cosines take their `atan2` form: near 1, one rounding of a float32 cosine is an angle of
    3e-4. Every step uses the rounded angles of the steps before and so corrects them.

    Args: position [3] m; rotation [3, 3], tip to world.
    Returns: [8, 6] rad in [-pi, pi], order of BRANCHES, finite; [8] bool, False where the pose is
    out of the branch's reach or within SINGULAR of where two branches meet.
    """
    unit = jnp.all(jnp.abs(jnp.sum(rotation**2, axis=0) - 1.0) < 0.01)
    sane = jnp.all(jnp.abs(position) < _FAR) & unit  # False for NaN
    position, rotation = jnp.where(sane, position, 0.0), jnp.where(sane, rotation, jnp.eye(3))
    branch = functools.partial(_branch, arm)
    joints, valid = jax.vmap(branch, (None, None, 0))(position, rotation, jnp.asarray(BRANCHES))
    return joints, valid & sane


def _branch(arm: Arm, position: Array, rotation: Array, signs: Array) -> tuple[Array, ...]:
    """Solves one branch, of these `signs` [3]: joint angles [6], valid [] bool."""
    links, (*base, yaw) = arm.links, arm.base
    x6, y6, down = rotation[:, 0], -rotation[:, 1], -rotation[:, 2]
    from_base = position - jnp.array(base) - (links.d6 + arm.tool) * down  # wrist 3
    pan, shoulder_ok = _shoulder(links, from_base[:2], signs[0])
    cos, sin = jnp.cos(pan), jnp.sin(pan)
    ahead, side = jnp.array([cos, sin, 0.0]), jnp.array([sin, -cos, 0.0])

    wrist2, wrist3, wrist_ok = _wrist(_dot(side, x6), _dot(side, y6), _dot(side, down), signs[2])
    x5 = jnp.cos(wrist3) * x6 - jnp.sin(wrist3) * y6
    x4 = jnp.cos(wrist2) * x5 - jnp.sin(wrist2) * down
    z4 = -jnp.sin(wrist3) * x6 - jnp.cos(wrist3) * y6
    bend = jnp.arctan2(x4[2], _dot(x4, ahead))

    wrist1 = from_base - links.d5 * z4 - links.d4 * side
    place = _dot(wrist1, ahead), wrist1[2] - links.d1
    lift, elbow, elbow_ok = _elbow(links, *place, signs[1])
    q = jnp.stack([pan - yaw, lift, elbow, bend - lift - elbow, wrist2, wrist3])
    return q - FULL_TURN * jnp.round(q / FULL_TURN), shoulder_ok & elbow_ok & wrist_ok


def _shoulder(links: DHParameters, xy: Array, sign: Array) -> tuple[Array, Array]:
    """Solves for the shoulder pan [] with wrist 3 at `xy` [2] m, d4 away from the arm's plane."""
    d4, square = links.d4, _dot(xy, xy)
    ok = square - d4**2 > SINGULAR**2 * square
    xy, square = jnp.where(ok, xy, jnp.array([1.0, 0.0])), jnp.where(ok, square, 1.0)
    towards, offset = jnp.arctan2(xy[1], xy[0]), jnp.arctan2(jnp.sqrt(square - d4**2), d4)
    return towards + 0.5 * np.pi + sign * offset, ok


def _wrist(x: Array, y: Array, z: Array, sign: Array) -> tuple[Array, ...]:
    """Solves for wrist 2 and 3 [] from the axis `x` `y` `z` [] of joints 2 to 4, flange frame."""
    square = x**2 + y**2
    ok = square > SINGULAR**2
    x, y, square = jnp.where(ok, x, 1.0), jnp.where(ok, y, 0.0), jnp.where(ok, square, 1.0)
    return jnp.arctan2(sign * jnp.sqrt(square), z), jnp.arctan2(-sign * y, sign * x), ok


def _elbow(links: DHParameters, ahead: Array, up: Array, sign: Array) -> tuple[Array, ...]:
    """Solves for shoulder lift and elbow q3 [] with wrist 1 `ahead` and `up` [] m of the shoulder.

    With r the distance: sin^2(q3 / 2) = ((a2 + a3)^2 - r^2) / (4 a2 a3), cos^2 likewise.
    """
    a2, a3, square = links.a2, links.a3, ahead**2 + up**2
    sin2 = ((a2 + a3) ** 2 - square) / (4.0 * a2 * a3)
    cos2 = (square - (a2 - a3) ** 2) / (4.0 * a2 * a3)
    ok = jnp.minimum(sin2, cos2) > (0.5 * SINGULAR) ** 2
    ahead, up = jnp.where(ok, ahead, 0.5), jnp.where(ok, up, 0.0)
    sin2, cos2 = jnp.where(ok, sin2, 0.5), jnp.where(ok, cos2, 0.5)
    sin, cos = sign * 2.0 * jnp.sqrt(sin2 * cos2), cos2 - sin2
    lift = jnp.arctan2(up, ahead) - jnp.arctan2(a3 * sin, a2 + a3 * cos)
    return lift, 2.0 * sign * jnp.arctan2(jnp.sqrt(sin2), jnp.sqrt(cos2)), ok


# Capsules that could meet: i and any from `first` on. The shape of the links rules out all others.
_PAIRS = np.array([(i, j) for i, first in enumerate((3, 4, 5, 7, 7)) for j in range(first, 9)])
_ABOVE_TABLE = slice(2, 8)  # not the hand, whose height is the planner's choice


def _chain(arm: Arm, q: Array) -> Array:
    """Returns points [10, 3] m along the arm, ends of capsules; the last two are the gripper's."""
    links, (near, far, _) = arm.links, arm.hand_capsule
    (shoulder, elbow, wrist1, wrist2, wrist3), side, _, down = _frames(arm, q)
    foot = jnp.array([arm.base[0], arm.base[1], 0.0])
    outer, inner = links.shoulder_offset * side, links.forearm_offset * side
    palm, tips = (wrist3 + (links.d6 + arm.tool - back) * down for back in (near, far))
    points = [foot, shoulder, shoulder + outer, elbow + outer, elbow + inner, wrist1 + inner]
    return jnp.stack([*points, wrist2, wrist3, palm, tips])


def _segment_distance(p0: Array, p1: Array, q0: Array, q1: Array) -> Array:
    # Neither segment is a point. Ericson, Real-Time Collision Detection, 5.1.9.
    u, v, w = p1 - p0, q1 - q0, p0 - q0
    uu, uv, vv, uw, vw = _dot(u, u), _dot(u, v), _dot(v, v), _dot(u, w), _dot(v, w)
    cross = uu * vv - uv**2
    skew = cross > 1e-6 * uu * vv
    s = jnp.where(skew, (uv * vw - vv * uw) / jnp.where(skew, cross, 1.0), 0.0)
    t = jnp.clip((uv * jnp.clip(s, 0.0, 1.0) + vw) / vv, 0.0, 1.0)
    s = jnp.clip((uv * t - uw) / uu, 0.0, 1.0)
    gap = w + s * u - t * v
    return jnp.sqrt(jnp.maximum(_dot(gap, gap), 1e-12))


def clearance(arm: Arm, q: Array) -> tuple[Array, Array]:
    """Returns the least distances [] m at `q` [6] rad, from arm to table and between links."""
    chain = _chain(arm, q)
    radii = np.array([*arm.links.radii, arm.body_radius, arm.hand_capsule[2]], np.float32)
    start, end = chain[:-1], chain[1:]
    above = jnp.minimum(start[:, 2], end[:, 2]) - radii
    first, second = _PAIRS.T
    axes = jax.vmap(_segment_distance)(start[first], end[first], start[second], end[second])
    between = axes - (radii[first] + radii[second])
    return jnp.min(above[_ABOVE_TABLE]), jnp.min(between)


def clear(arm: Arm, q: Array) -> Array:
    """Returns [] bool, the arm at the joint angles `q` [6] rad avoids the table and itself."""
    to_table, between_links = clearance(arm, q)
    return (to_table > _TABLE_CLEARANCE) & (between_links > _LINK_CLEARANCE)


def joint_targets(arm: Arm, q_start: Array, control: Array) -> tuple[Array, Array]:
    """Follows set-points of the tips on the branch that reaches the most, with the least motion.

    The only jump is the one from `q_start`. The arm stops for good at the first set-point that the
    branch does not reach, or reaches only through the table or itself.

    Args: q_start [6] rad; control [T, 4 or more] as in `primitives.Plan`, for the tip frame.
    Returns: joint angles [T, 6] rad; [] bool, True if the branch reaches every set-point.
    """
    solutions, valid = _clear_branches(arm, control[:, :3], control[:, 3])
    joints, good, motion = jax.vmap(_follow, (None, 1, 1))(q_start, solutions, valid)  # by branch
    reached = jnp.sum(good, axis=1)
    branch = jnp.argmin(jnp.where(reached == jnp.max(reached), motion, jnp.inf))
    return joints[branch], jnp.all(good[branch])


def reaches(arm: Arm, tips: Array, yaw: Array) -> Array:
    """Returns [T, 8] bool, branches by which the clear arm is at `tips` [T, 3] m, `yaw` [] rad.

    The hand points down. The way between the places is not checked.
    """
    return _clear_branches(arm, tips, jnp.broadcast_to(yaw, len(tips)))[1]


def _clear_branches(arm: Arm, tips: Array, yaw: Array) -> tuple[Array, Array]:
    """Solves for joint angles [T, 8, 6] at tips [T, 3], yaws [T]; [T, 8] bool, valid and clear."""
    poses = jax.vmap(top_down)(tips, yaw)
    solutions, valid = jax.vmap(functools.partial(inverse, arm))(*poses)
    return solutions, valid & jax.vmap(jax.vmap(functools.partial(clear, arm)))(solutions)


def _follow(q_start: Array, solutions: Array, valid: Array) -> tuple[Array, ...]:
    """Follows one branch [T, 6] rad while it is valid [T] bool, without jumps, within LIMITS.

    Returns: [T, 6] rad, constant from the first failure; [T] bool, good until then; [] rad moved.
    """
    step = jnp.diff(solutions, axis=0)
    turns = jnp.cumsum(jnp.round(-step / FULL_TURN), axis=0)  # whole, so that no rounding adds up
    path = solutions + FULL_TURN * jnp.concatenate([jnp.zeros_like(q_start)[None], turns])
    path = path + FULL_TURN * _offset(q_start, path, valid)[None]
    allowed = valid & jnp.all(jnp.abs(path) <= LIMITS[None], axis=1)
    good = jnp.cumprod(allowed.astype(jnp.int32)).astype(bool)
    last = jnp.maximum(jnp.sum(good) - 1, 0)
    path = jnp.where(good[:, None], path, jnp.where(good[0], path[last], q_start)[None])
    return path, good, jnp.sum(jnp.abs(jnp.diff(path, axis=0, prepend=q_start[None])))


def _offset(q_start: Array, path: Array, valid: Array) -> Array:
    """Returns whole turns [6] that bring a path [T, 6] rad within LIMITS, near `q_start` [6]."""
    turns = jnp.arange(-2.0, 3.0)[:, None]
    low = jnp.min(jnp.where(valid[:, None], path, jnp.inf), axis=0)[None] + FULL_TURN * turns
    high = jnp.max(jnp.where(valid[:, None], path, -jnp.inf), axis=0)[None] + FULL_TURN * turns
    excess = jnp.maximum(jnp.maximum(-LIMITS[None] - low, high - LIMITS[None]), 0.0)
    away = jnp.abs(path[:1] + FULL_TURN * turns - q_start[None])
    return turns[jnp.argmin(away + 100.0 * excess, axis=0), 0]
