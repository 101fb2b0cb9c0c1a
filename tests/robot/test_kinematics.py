"""UR5 and UR5e against the maker's parameters, C MuJoCo, themselves, and at the ends of reach."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax import grippers
from csac_jax.assets import assets
from csac_jax.config import HeightmapConfig, SimConfig
from csac_jax.geometry import cell_centres
from csac_jax.robot import kinematics, mjcf, primitives
from csac_jax.robot.kinematics import TipPose
from csac_jax.robot.primitives import Action

SIM, MAP = SimConfig(robot="ur5"), HeightmapConfig()
ARM, HOME = kinematics.arm(SIM), jnp.asarray(kinematics.HOME)
HALF = 0.5 * MAP.extent
POSITION, ANGLE = 2e-6, 5e-6  # m, rad: a few times what float32 leaves, 7e-7 and 1.3e-6

forward = jax.jit(jax.vmap(functools.partial(kinematics.forward, ARM)))
inverse_of_one = jax.jit(functools.partial(kinematics.inverse, ARM))
inverse = jax.jit(jax.vmap(functools.partial(kinematics.inverse, ARM)))
top_down = jax.jit(jax.vmap(kinematics.top_down))
clearance = jax.jit(jax.vmap(functools.partial(kinematics.clearance, ARM)))
is_clear = functools.partial(kinematics.clear, ARM)
clear = jax.jit(jax.vmap(jax.vmap(is_clear)))
targets_of = jax.jit(functools.partial(kinematics.joint_targets, ARM))
gradients = jax.jit(jax.grad(lambda *pose: jnp.sum(inverse_of_one(*pose)[0]), argnums=(0, 1)))
targets_of_batch = jax.jit(jax.vmap(functools.partial(kinematics.joint_targets, ARM), (None, 0)))


def _random_joints(num: int, seed: int = 0) -> np.ndarray:
    """Joint angles [num, 6] rad, uniform within the limits."""
    shares = np.random.default_rng(seed).uniform(-1, 1, (num, 6))
    return (shares * kinematics.LIMITS).astype(np.float32)


def _errors(pose: TipPose, other: TipPose) -> tuple[np.ndarray, np.ndarray]:
    """Distances [...] m and angles [...] rad between poses [..., 3], [..., 3, 3]."""
    rotations = np.asarray(pose.rotation, np.float64), np.asarray(other.rotation)
    turn = np.einsum("...ij,...ik->...jk", *rotations)
    sine = [turn[..., i, j] - turn[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))]
    angle = np.arctan2(np.linalg.norm(sine, axis=0), np.trace(turn, axis1=-2, axis2=-1) - 1.0)
    return np.linalg.norm(np.asarray(pose.position) - np.asarray(other.position), axis=-1), angle


def _angles_apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Greatest difference of joint angles [..., 6], whole turns aside."""
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi).max(axis=-1)


@functools.cache
def _arm() -> mujoco.MjModel:
    """Compiles the arm with the gripper's capsules."""
    spec = mujoco.MjSpec.from_file(str(assets() / "ur5.xml"))
    tip = ARM.links.d6 + ARM.tool
    capsules = ("tool", 0.0, tip - 0.115, 0.045), ("fingers", tip - 0.115, tip - 0.07, 0.07)
    for name, start, end, radius in capsules:
        size, kind = [radius, 0, 0], mujoco.mjtGeom.mjGEOM_CAPSULE
        geom = spec.body("wrist3").add_geom(name=name, type=kind, size=size, mass=0)
        geom.fromto = [0, 0, start, 0, 0, end]
    return spec.compile()


def _plans(num: int, seed: int = 0) -> primitives.Plan:
    """Plans [num, ...] of pushes and grasps over flat surfaces; the first eight in the corners."""
    rng = np.random.default_rng(seed)
    pose = rng.uniform([-HALF, -HALF, 0], [HALF, HALF, 2 * np.pi], (num, 3)).astype(np.float32)
    pose[:8, :2] = HALF * np.repeat(np.float32([[1, 1], [1, -1], [-1, 1], [-1, -1]]), 2, axis=0)
    actions = Action(primitive=jnp.arange(num, dtype=jnp.int32) % 2, pose=jnp.asarray(pose))
    top = rng.choice(np.float32([0.0, 0.05, 0.15]), num)
    height = jnp.asarray(np.broadcast_to(top[:, None, None], (num, MAP.size, MAP.size)))
    return jax.jit(jax.vmap(functools.partial(primitives.plan, SIM, MAP)))(height, actions)


MOVED = {"base": (-0.5, 0.3, 0.2, 1.1), "adapter": 0.04, "gripper": "franka_hand"}
SIMS = {
    "ur5": SIM,
    "ur5e": SimConfig(robot="ur5e", gripper="2f85"),
    "moved": SimConfig(robot="ur5", **MOVED),
}


def _tips_by_c(sim: SimConfig, joints: np.ndarray) -> TipPose:
    """Poses of the tips by C MuJoCo in the MJCF of the robot."""
    spec = mujoco.MjSpec.from_file(str(assets() / "table.xml"))
    mjcf.add(spec, sim, grippers.load(sim.gripper))
    model = spec.compile()
    data, poses = mujoco.MjData(model), []
    for q in joints:
        data.qpos[:6] = q
        mujoco.mj_kinematics(model, data)
        hand = data.body("hand/hand")
        poses.append((hand.xpos.copy(), hand.xmat.reshape(3, 3).copy()))
    return TipPose(*map(np.array, zip(*poses, strict=True)))


@pytest.mark.parametrize("name", SIMS)
def test_forward_agrees_with_c(name: str):
    """Claim: the tips are where C MuJoCo has them, for each arm, base and gripper."""
    joints, arm = _random_joints(300), kinematics.arm(SIMS[name])
    found = jax.jit(jax.vmap(functools.partial(kinematics.forward, arm)))(joints)
    distance, angle = _errors(found, _tips_by_c(SIMS[name], joints))
    assert distance.max() < POSITION
    assert angle.max() < ANGLE


# The makers' tables of Denavit-Hartenberg parameters: d, a [6] m; alpha is the same for both, rad.
DH = {
    "ur5": ((0.089159, 0, 0, 0.10915, 0.09465, 0.0823), (0, -0.425, -0.39225, 0, 0, 0)),
    "ur5e": ((0.1625, 0, 0, 0.1333, 0.0997, 0.0996), (0, -0.425, -0.3922, 0, 0, 0)),
}
ALPHA = np.pi * np.array([0.5, 0.0, 0.0, 0.5, -0.5, 0.0])


@pytest.mark.parametrize("robot", DH)
def test_forward_is_the_makers_table(robot: str):
    """Claim: the flange is where the product of the maker's Denavit-Hartenberg matrices has it."""
    arm = kinematics.arm(SimConfig(robot=robot))._replace(base=(0.0, 0.0, 0.0, 0.0), tool=0.0)
    joints = _random_joints(50, 4)
    found = jax.jit(jax.vmap(functools.partial(kinematics.forward, arm)))(joints)
    for index, angles in enumerate(joints.astype(np.float64)):
        pose = np.eye(4)
        for theta, d, a, alpha in zip(angles, *DH[robot], ALPHA, strict=True):
            (c, s), (ca, sa) = ((np.cos(x), np.sin(x)) for x in (theta, alpha))
            top = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s]]
            pose = pose @ np.array([*top, [0, sa, ca, d], [0, 0, 0, 1]])
        np.testing.assert_allclose(found.position[index], pose[:3, 3], atol=POSITION)
        # The tip frame closes along x and points back along z.
        frame = pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        np.testing.assert_allclose(found.rotation[index], frame, atol=ANGLE)


@pytest.mark.parametrize("name", SIMS)
def test_inverse_returns_to_the_pose(name: str):
    """Claim: of each arm, every branch that counts leads back to the pose, to float32's rounding;
    one of them is the joint angles that the pose was made from."""
    arm, joints = kinematics.arm(SIMS[name]), _random_joints(5000)
    there = functools.partial(kinematics.forward, arm)
    back = jax.jit(jax.vmap(functools.partial(kinematics.inverse, arm)))
    pose = jax.jit(jax.vmap(there))(joints)
    solutions, valid = map(np.asarray, back(*pose))
    again = jax.jit(jax.vmap(jax.vmap(there)))(solutions)
    distance, angle = _errors(again, TipPose(*(np.asarray(leaf)[:, None] for leaf in pose)))
    assert valid.any(axis=1).mean() > 0.99  # else singular
    assert distance[valid].max() < POSITION
    assert angle[valid].max() < ANGLE
    apart = np.where(valid, _angles_apart(solutions, joints[:, None]), np.inf).min(axis=1)
    sines = np.abs(np.stack([np.sin(joints[:, 2]), np.sin(joints[:, 4])]))
    generic = (sines > 0.05).all(axis=0) & valid.all(axis=1)
    assert generic.sum() > 2500
    # Near where two branches meet, an angle is worth the root of an error.
    assert apart[generic].max() < 5e-4


CENTRE, ABOVE_BASE = (0.0, 0.0, 0.1), ARM.base[2] + 0.5
NOWHERE = {
    "beyond": ((-0.6, 0.0, 0.1), 0.0),
    "within the wrist's width": ((ARM.base[0] + 0.5 * ARM.links.d4, 0.0, ABOVE_BASE), 0.0),
    "both shoulders meet": ((ARM.base[0], ARM.links.d4, ABOVE_BASE), 0.0),
    "nan": ((0.0, np.nan, 0.1), 0.0),
    "infinite": ((0.0, 0.0, -np.inf), 0.0),
    "no rotation": (CENTRE, None),
}


@pytest.mark.parametrize("name", NOWHERE)
def test_poses_without_an_answer(name: str):
    """Claim: poses out of reach, singular or not finite: no valid branch, all values finite."""
    xyz, yaw = NOWHERE[name]
    pose = TipPose(jnp.array(xyz), jnp.zeros((3, 3)))
    if yaw is not None:
        pose = kinematics.top_down(pose.position, jnp.array(yaw))
    solutions, valid = inverse_of_one(*pose)
    assert not valid.any()
    assert np.isfinite(solutions).all()
    assert all(np.isfinite(gradient).all() for gradient in gradients(*pose))


@pytest.mark.parametrize(("joint", "angle"), [(2, 0.0), (2, 0.005), (4, 0.0), (4, np.pi)])
def test_singular_branches_are_flagged(joint: int, angle: float):
    """Claim: with a straight elbow or wrist, the branches that meet there do not count."""
    pose = kinematics.forward(ARM, jnp.array([0.3, -0.5, 1.0, -1.0, 1.0, 0.2]).at[joint].set(angle))
    solutions, valid = map(np.asarray, inverse_of_one(*pose))
    assert np.isfinite(solutions).all()
    assert all(np.isfinite(gradient).all() for gradient in gradients(*pose))
    assert not valid.all()
    sines = np.abs(np.sin(solutions[valid][:, [2, 4]]))
    assert (sines > 0.9 * kinematics.SINGULAR).all()


def test_top_down_is_the_floating_hand():
    """Claim: a hand that points down at a yaw stands as the floating hand does at that yaw."""
    spec = mujoco.MjSpec()
    mjcf.add(spec, SimConfig(), grippers.load("rg2"))
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    places = rng.uniform([-0.2, -0.2, 0, 0], [0.2, 0.2, 0.3, 2 * np.pi], (20, 4))
    for values in places.astype(np.float32):
        data.qpos[:4] = values
        mujoco.mj_kinematics(model, data)
        pose = kinematics.top_down(jnp.asarray(values[:3]), jnp.asarray(values[3]))
        hand = data.body("hand/hand")
        np.testing.assert_allclose(pose.position, hand.xpos, atol=1e-6)
        np.testing.assert_allclose(pose.rotation, hand.xmat.reshape(3, 3), atol=1e-6)


@pytest.mark.slow
def test_whole_workspace_is_reachable():
    """Claim: over every cell, tips 0.01 to 0.35 m high, at 16 yaws, a clear branch counts. At HOME
    the tips are 0.2 m above the workspace centre, and the arm is clear."""
    np.testing.assert_allclose(kinematics.forward(ARM, HOME).position, [0, 0, 0.2], atol=2e-3)
    assert is_clear(HOME)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, None, None))
    def reachable(xy, z, yaw):
        solutions, valid = kinematics.inverse(ARM, *kinematics.top_down(jnp.append(xy, z), yaw))
        return jnp.any(valid & jax.vmap(is_clear)(solutions))

    centres = cell_centres(MAP).reshape(-1, 2)
    for z in np.float32([0.01, 0.12, 0.23, 0.35]):
        for yaw in np.float32(np.arange(16) * np.pi / 8):
            assert reachable(centres, z, yaw).all(), (z, yaw)


ARM_PARTS = ("base", "shoulder", "upper_arm", "elbow", "forearm", "wrist1", "wrist2")
CAPSULES = (*ARM_PARTS, "tool", "fingers")


def _distances(q: np.ndarray) -> np.ndarray:
    """Distances [9, 9] m between the capsules by C MuJoCo."""
    model = _arm()
    data, ids = mujoco.MjData(model), [model.geom(name).id for name in CAPSULES]
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    apart = functools.partial(mujoco.mj_geomDistance, model, data)
    rows = [[apart(a, b, 2.0, None) if a != b else 0 for b in ids] for a in ids]
    return np.array(rows)


def test_clearance_agrees_with_c():
    """Claim: the room between links, and above the table, is that of the capsules of `ur5.xml`."""
    model, joints = _arm(), _random_joints(200, 2)
    above, apart = map(np.asarray, clearance(joints))
    first, second = kinematics._PAIRS.T
    expected = np.array([_distances(q)[first, second].min() for q in joints])
    free = expected > 0
    assert 20 < free.sum() < 180
    np.testing.assert_allclose(apart[free], expected[free], atol=1e-5)
    assert (apart[~free] < 1e-5).all()
    data, links = mujoco.MjData(model), [model.geom(name).id for name in CAPSULES[2:8]]
    for q, room in zip(joints, above, strict=True):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        radius, half = model.geom_size[links, :2].T
        lowest = data.geom_xpos[links, 2] - half * np.abs(data.geom_xmat[links, 8]) - radius
        assert abs(room - lowest.min()) < 1e-5


def test_targets_hits_the_set_points():
    """Claim: the joint targets put the tips on every set-point of a plan. Over flat surfaces no
    joint turns faster between them than the maker's 180 degrees per second, none leaves its limits,
    and the arm is clear all the way."""
    plan = _plans(64)
    control = jnp.concatenate([plan.start[:, None], plan.control], axis=1)
    target, reachable = targets_of_batch(HOME, control)
    assert reachable.all()
    tips = jax.jit(jax.vmap(jax.vmap(functools.partial(kinematics.forward, ARM))))(target[..., :6])
    wanted = jax.jit(jax.vmap(jax.vmap(kinematics.top_down)))(control[..., :3], control[..., 3])
    distance, angle = _errors(tips, wanted)
    assert distance.max() < POSITION
    assert angle.max() < ANGLE
    joints = np.asarray(target[..., :6])
    assert np.abs(np.diff(joints, axis=1)).max() < np.pi * SIM.timestep
    assert (np.abs(joints) <= kinematics.LIMITS).all()
    assert clear(joints).all()


def _line(start: tuple[float, ...], end: tuple[float, ...], num: int = 50) -> jax.Array:
    """Set-points [num, 5] on a straight line."""
    return jnp.asarray(np.linspace(start, end, num), jnp.float32)


def _branches(start: tuple, end: tuple) -> tuple:
    """Set-points [50, 5], solutions [50, 8, 6], and [50, 8] bool each, valid and clear."""
    control = _line(start, end)
    solutions, valid = inverse(*top_down(control[:, :3], control[:, 3]))
    return control, solutions, np.asarray(valid), np.asarray(clear(solutions))


WAY = (0.05, 0.0, 0.1, 0.3, 0.0), (-0.05, 0.1, 0.1, 0.3, 0.0)


def test_targets_takes_the_branch_it_is_in():
    """Claim: of branches that reach every set-point, the one with the least motion is taken; none
    through the table or the arm itself."""
    control, solutions, valid, is_free = _branches(*WAY)
    whole = np.flatnonzero((valid & is_free).all(axis=0))
    assert whole.size >= 2
    for branch in whole:
        target, _ = targets_of(solutions[0, branch], control)
        np.testing.assert_allclose(target[0, :6], solutions[0, branch], atol=1e-5)
    blocked = np.flatnonzero(valid.all(axis=0) & ~is_free.any(axis=0))
    assert blocked.size
    for branch in blocked:
        target, reachable = targets_of(solutions[0, branch], control)
        assert reachable
        assert clear(target[None, :, :6]).all()


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_targets_stays_within_limits_as_the_hand_turns(turn: float):
    """Claim: a full circle of the hand is followed without a jump, within the limits."""
    start = (0.0, 0.0, 0.1, 0.0, 0.0)
    control = _line(start, (0.0, 0.0, 0.1, 2 * np.pi * turn, 0.0), 400)
    for wrist3 in (-5.0, 0.0, 5.0):
        target, reachable = targets_of(HOME.at[5].set(wrist3), control)
        assert reachable
        assert np.abs(np.diff(target[:, :6], axis=0)).max() < 0.02
        assert (np.abs(target[:, :6]) <= kinematics.LIMITS).all()


@pytest.mark.parametrize("lost", [(-0.6, 0.0, 0.1, 0.0, 0.0), (np.nan, 0.0, 0.1, 0.0, 0.0)])
def test_targets_stops_where_reach_ends(lost: tuple[float, ...]):
    """Claim: from the first unreachable set-point the arm holds the last target, flagged."""
    control = _line((0.0, 0.0, 0.1, 0.0, 0.05), (-0.1, 0.0, 0.1, 0.0, 0.05))
    target, reachable = targets_of(HOME, control.at[30:40].set(jnp.array(lost)))
    whole, _ = targets_of(HOME, control)
    assert not reachable
    np.testing.assert_array_equal(target[:30], whole[:30])
    np.testing.assert_array_equal(target[30:, :6], np.broadcast_to(whole[29, :6], (20, 6)))
    nowhere, reachable = targets_of(HOME, control.at[0].set(jnp.array(lost)))
    assert not reachable
    np.testing.assert_array_equal(nowhere[:, :6], np.broadcast_to(kinematics.HOME, (50, 6)))


def test_reaches_is_what_the_targets_say():
    """Claim: a way whose ends are not reached is never followed, any other mostly."""
    far = kinematics.arm(SimConfig(robot="ur5", base=(0.85, 0.0, 0.35, 0.0)))
    places = np.random.default_rng(6).uniform(-HALF, HALF, (200, 2)).astype(np.float32)
    ends = np.stack([np.column_stack([places, np.full(200, z)]) for z in (0.012, 0.16)], axis=1)
    reached = jax.jit(jax.vmap(functools.partial(kinematics.reaches, far), (0, None)))(ends, 0.4)
    ways = np.concatenate([ends, np.full((200, 2, 1), 0.4)], axis=2)
    ways = np.stack([np.linspace(*way, 12) for way in ways])
    follow = jax.vmap(functools.partial(kinematics.joint_targets, far), (None, 0))
    _, followed = jax.jit(follow)(HOME, jnp.asarray(ways, jnp.float32))
    reached, followed = np.asarray(reached).all(axis=1).any(axis=1), np.asarray(followed)
    assert 20 < reached.sum() < 180
    assert not (followed & ~reached).any()
    assert followed[reached].mean() > 0.9
