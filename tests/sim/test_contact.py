"""True contact: the hand presses no harder than it may, holds by friction, and stops where told."""

import copy
import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax import env as environment, grippers
from csac_jax.config import Config, PhysicsKind, SceneConfig, SimConfig
from csac_jax.constants import Outcome, Primitive
from csac_jax.grippers import Grip
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Action
from csac_jax.sim import c_physics, outcome, physics as simulation
from csac_jax.vision import observe
from csac_jax.world import model, scene_state
from csac_jax.world.scene_state import SceneState
from tests.sim.conftest import WARP, planned
from tests.world import placed

HALF = 0.025  # m, of a cube
pytestmark = pytest.mark.mjx
LIGHTEST = SceneConfig().density[0]


def _config(blocks: int, **sim: Any) -> Config:
    slots = ("box",) * blocks
    return Config(
        scene=SceneConfig(slots=slots, min_blocks=1), sim=SimConfig(**{"physics": "c"} | sim)
    )


def _scene(places: Any, half: Any = (HALF,) * 3, density: float = 600.0) -> SceneState:
    """Boxes at (x, y) m on the table, all in play."""
    count = len(places)
    scene = scene_state.parked(("box",) * count)
    return scene.replace(
        position=np.float32([[x, y, half[2]] for x, y in places]),
        half_size=np.tile(np.float32(half), (count, 1)),
        density=np.full(count, density, np.float32),
        in_play=np.ones(count, bool),
    )


def _grid(side: int) -> SceneState:
    """Cubes that all but touch."""
    places = (np.arange(side) - 0.5 * (side - 1)) * (2 * HALF + 3e-4)
    return _scene([(x, y) for x in places for y in places])


@functools.cache
def _executed(cfg: Config) -> Any:
    return _executor(cfg, simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim))


def _executor(cfg: Config, physics: simulation.Physics) -> Any:
    def run(scene: SceneState, primitive: Any, pose: Any) -> Any:
        height = observe.observe(cfg, scene, None).height
        action = Action(primitive=primitive, pose=pose)
        after, trace, plan = simulation.execute(physics, cfg, scene, height, action)
        hand_rise = plan.start[2] - jnp.min(plan.control[:, 2])
        return after, trace, outcome.lifted_blocks(trace, hand_rise)

    return jax.jit(jax.vmap(run, (None, None, 0)))


def _run(cfg: Config, scene: SceneState, poses: Any, primitive: int = Primitive.GRASP) -> Any:
    scene = jax.tree.map(jnp.asarray, scene)
    return jax.device_get(_executed(cfg)(scene, jnp.int32(primitive), jnp.float32(poses)))


def _exhaustive(half: float, step: float, yaws: int) -> np.ndarray:
    places = np.arange(-half, half + 1e-9, step)
    return np.array([[x, y, np.pi * k / yaws] for x in places for y in places for k in range(yaws)])


@pytest.mark.parametrize("robot", ["hand", "ur5e"])
def test_an_open_hand_sinks_at_most_15_mm_into_a_cube(robot: str):
    """Claim: a finger that comes down on the lightest cube is at most 1.5 mm below its top when the
    descent ends, with the floating hand and with an arm."""
    cfg = _config(1, robot=robot)
    world = model.build(cfg.scene, cfg.sim)
    scene = _scene([(0.0, 0.0)], density=LIGHTEST)
    fields = placed.fields_of(world, scene)
    height = jax.jit(lambda scene: observe.observe(cfg, scene, None).height)(scene)

    @jax.jit
    def joints_at(yaw: jax.Array) -> primitives.JointTrajectory:
        beside = 0.061 * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])  # to the middle of a finger
        grasp = Action.grasp(*beside, yaw)
        plan = primitives.plan(cfg.sim, cfg.heightmap, height, grasp)
        return primitives.joint_trajectory(cfg.sim, plan)

    simulator, sinks = c_physics.CSimulator(world), []
    for number in range(24):
        joints = jax.device_get(joints_at(jnp.float32(number * np.pi / 24)))
        assert joints.reachable
        qpos = simulator.rollout(scene, fields, joints).qpos[cfg.sim.grasp_phases[0] - 1]
        sinks.append(2 * HALF - _tips(world, qpos))
    assert np.median(sinks) > 1e-4  # it stands on the cube
    assert max(sinks) < 1.5e-3


def _tips(world: model.World, qpos: np.ndarray) -> float:
    data = mujoco.MjData(world.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(world.model, data)
    pads = world.pads
    return float(np.min(data.geom_xpos[pads, 2] - world.model.geom_size[pads, 2]))


@pytest.mark.parametrize("engine", ["c", "mjx", WARP])
def test_a_finger_holds_above_its_pad(engine: PhysicsKind):
    """Claim: a plank on a thin post is lifted by what is above the pads of a Franka Hand."""
    post, plank = (0.008, 0.0125, 0.0225), (0.03, 0.0125, 0.006)
    scene = _scene([(0.0, 0.0), (0.0, 0.0)])
    scene = scene.replace(
        half_size=np.float32([post, plank]),
        position=np.float32([[0.0, 0.0, post[2]], [0.0, 0.0, 2 * post[2] + plank[2]]]),
    )
    cfg = _config(2, physics=engine, gripper="franka_hand")
    _, trace, lifted = _run(cfg, scene, [[0.0, 0.0, 0.0]])
    assert trace.touched[0]
    assert lifted[0].tolist() == [False, True]


@pytest.mark.parametrize("gripper", ["rg2", "2f85", "franka_hand", "wsg32"])
def test_fingers_are_all_that_moves_with_a_pad(gripper: str):
    """Claim: a hand's parts are its palm and, of each side, the geoms of the bodies that a finger
    joint moves; each pad is the first of its finger."""
    cfg = _config(1, gripper=gripper)
    world = model.build(cfg.scene, cfg.sim)
    data, moved = mujoco.MjData(world.model), []
    for opening in world.gripper.positions[0][1], world.gripper.positions[0][0]:
        data.qpos[world.robot_qpos[-len(world.gripper.joints) :]] = opening
        mujoco.mj_kinematics(world.model, data)
        moved.append(data.geom_xpos[:, 0].copy())
    inwards = moved[1] - moved[0]
    meets = world.model.geom_contype > 0
    for part, way in ((1, 1.0), (2, -1.0)):
        found = np.flatnonzero(meets & (way * inwards > 1e-4))
        assert sorted(world.hand_geoms[world.hand_parts == part]) == found.tolist()
        assert world.hand_geoms[world.hand_parts == part][0] == world.pads[part - 1]
    assert (world.hand_parts == 0).sum() == 1


@pytest.mark.slow
def test_touching_cubes_cannot_be_grasped():
    """Claim: of exhaustive grasps of 3 x 3 touching cubes at most 3 % lift; of a hand that presses
    with 100 N, more do. Two cubes alone are lifted alike."""
    poses = _exhaustive(0.072, 0.012, 8)
    lifts = _run(_config(9), _grid(3), poses)[-1].any(axis=1)
    assert lifts.mean() <= 0.03
    strong = _run(_config(9, down_force=100.0), _grid(3), poses[::3])[-1].any(axis=1)
    assert strong.mean() > 1.5 * lifts.mean()
    alone = _scene([(-0.08, 0.0), (0.08, 0.02)])
    shares = [
        _run(_config(2, down_force=force), alone, poses[::3])[-1].any(axis=1).mean()
        for force in (20.0, 100.0)
    ]
    assert abs(shares[0] - shares[1]) < 0.06


@pytest.mark.parametrize("gripper", grippers.shipped())
def test_all_of_a_finger_collides(gripper: str):
    """Claim: every geom of palm and fingers meets blocks."""
    compiled = model.build(_config(1).scene, SimConfig(physics="c", gripper=gripper)).model
    root = compiled.body("hand/hand").id
    is_hand = compiled.body_rootid[compiled.geom_bodyid] == root
    assert is_hand.sum() >= 3
    assert (compiled.geom_contype[is_hand] == 2).all()


@pytest.mark.parametrize(("friction", "holds"), [(0.8, True), (0.1, True), (0.03, False)])
def test_grip_holds_by_friction(friction: float, holds: bool):
    """Claim: two pads of 20 N hold a block of 150 g for 2 s within 1 mm where Coulomb's law says
    so, above a friction of 0.037; else it falls."""
    half = np.float32([0.02, 0.04, 0.025])
    scene = _scene([(0.0, 0.0)], half, density=0.15 / (8 * half.prod()))
    scene = scene.replace(
        grip=Grip(np.float32(friction), np.float32(20.0)), friction=np.float32([0.1])
    )
    cfg = _config(1, pad_friction=(0.03, 1.2), grip_force=(15.0, 40.0), grasp_phases=(60, 50, 80))
    world = model.build(cfg.scene, cfg.sim)
    fields = placed.fields_of(world, scene)
    height = np.full((cfg.heightmap.size,) * 2, 2 * half[2])
    joints = planned(cfg, height, Action.grasp(0.0, 0.0, 0.0))
    waiting = np.repeat(joints.control[-1:], 500, axis=0)  # 2 s
    held = joints.replace(control=np.concatenate([joints.control, waiting]))
    qpos = c_physics.CSimulator(world).rollout(scene, fields, held).qpos
    hangs = qpos[:, world.block_qpos[0, 2]] - qpos[:, world.press_qpos]
    lifted = cfg.sim.substeps
    if holds:
        assert qpos[-1, world.block_qpos[0, 2]] > 0.1
        assert abs(hangs[-1] - hangs[lifted]) < 1e-3
    else:
        assert qpos[-1, world.block_qpos[0, 2]] < 0.03


def test_slippery_pads_lift_a_cube_as_a_converged_solver_says():
    """Claim: pads of friction 0.5 lift a cube that they meet up to 4 mm and 0.1 rad off its middle,
    and leave it where 100 iterations of the solver do."""
    cfg = _config(1, pad_friction=(0.5, 0.5))
    rng = np.random.default_rng(0)
    scene = _scene([(0.0, 0.0)]).replace(grip=Grip(np.float32(0.5), np.float32(0.0)))
    poses = rng.uniform(-1.0, 1.0, (8, 3)) * (0.004, 0.004, 0.1)
    after, _, lifted = _run(cfg, scene, poses)
    assert lifted.all()
    world = model.build(cfg.scene, cfg.sim)
    converged = copy.copy(world.model)
    converged.opt.iterations = converged.opt.ls_iterations = 100
    engine = simulation.make(dataclasses.replace(world, model=converged), cfg.sim)
    expected, _, _ = jax.device_get(
        _executor(cfg, engine)(
            jax.tree.map(jnp.asarray, scene), jnp.int32(Primitive.GRASP), jnp.float32(poses)
        )
    )
    np.testing.assert_allclose(after.position, expected.position, atol=1e-5)


def test_an_episode_draws_its_grip():
    """Claim: friction and force of a grip are drawn for each episode from their ranges, and do not
    appear in what the net sees."""
    cfg = _config(2, pad_friction=(0.5, 1.2), grip_force=(15.0, 40.0))
    env = environment.make_env(cfg, num_scenes=2)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 64))
    friction, force = states.scene.grip
    for values, (low, high) in ((friction, (0.5, 1.2)), (force, (15.0, 40.0))):
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high
    assert states.obs.fingers is None


def test_a_guarded_descent_that_is_stopped_is_undone():
    """Claim: with `guarded`, a grasp that comes down on packed cubes leaves the scene as it was and
    counts as a touch; a grasp of a cube alone lifts it."""
    cfg = _config(9, approach="guarded")
    env = environment.make_env(cfg, num_scenes=1)
    step = jax.jit(env.step)
    scene = jax.tree.map(jnp.asarray, _grid(3))
    state = env.reset_to(scene)
    after = step(state, Action.grasp(0.0, 0.0, 0.0))
    assert after.info.blocked
    assert after.info.outcome == Outcome.TOUCHED
    assert after.failed_grasps == 1
    np.testing.assert_array_equal(after.scene.position, state.scene.position)
    alone = scene_state.park(scene, jnp.arange(9) == 4)
    after = step(env.reset_to(alone), Action.grasp(0.0, 0.0, 0.0))
    assert not after.info.blocked
    assert after.info.outcome == Outcome.LIFTED


def test_a_double_grasp_takes_both():
    """Claim: two planks side by side between the pads are lifted together, and both are taken."""
    scene = _scene([(-0.0126, 0.0), (0.0126, 0.0)], half=(0.0125, 0.03, 0.02))
    env = environment.make_env(_config(2), num_scenes=1)
    state = env.reset_to(jax.tree.map(jnp.asarray, scene))
    after = jax.jit(env.step)(state, Action.grasp(0.0, 0.0, 0.0))
    assert after.info.cleared == 2
    assert after.info.outcome == Outcome.LIFTED
