"""A gripper whose opening and fingers differ in every episode."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax import api, deploy, grippers, presets
from csac_jax.agent import actor_critic, values
from csac_jax.baselines import oracle
from csac_jax.cli import main
from csac_jax.config import PhysicsKind
from csac_jax.env import Env, State, make_env
from csac_jax.errors import SettingsError
from csac_jax.grippers import Fingers
from csac_jax.io import policy_file
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Action
from csac_jax.vision import heightmap
from csac_jax.world import model, scene_state
from csac_jax.world.scene_state import SceneState
from tests.networks import learner_state, random_params
from tests.world import placed

CONFIG = presets.smoke().change(sim={"physics": "c", "gripper": "varied"}, net={"gripper": True})
VARIED = grippers.load("varied")
ASKED = "gripper: name the robot's, one of 2f85, franka_hand, rg2"
THIN = Fingers(0.08, 0.009, 0.015)  # m


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Env:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("pool")))
        return make_env(CONFIG)


@pytest.fixture(scope="module")
def states(env: Env) -> State:
    return jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 64))


def _scene(fingers: Fingers = THIN) -> SceneState:
    scene = jax.tree.map(jnp.asarray, scene_state.parked(CONFIG.scene.slots))
    return scene.replace(fingers=jax.tree.map(jnp.float32, fingers))


def _fields(world: model.World, fingers: Fingers) -> model.BlockFields:
    return placed.fields_of(world, _scene(fingers))


def test_every_episode_has_its_own(env: Env, states: State):
    """Claim: fingers of episodes fill the gripper's ranges, all differ, and are observed; a gripper
    without ranges has one kind."""
    drawn = np.stack(states.scene.fingers, axis=1)
    low, high = (np.array(ends, np.float32) for ends in VARIED.varies)
    assert (drawn >= low).all()
    assert (drawn <= high).all()
    assert (np.ptp(drawn, axis=0) > 0.9 * (high - low)).all()
    assert len(np.unique(drawn[:, 0])) == len(drawn)
    np.testing.assert_array_equal(states.obs.fingers, drawn)
    assert all(env.observation_spec.fingers.contains(row) for row in drawn)
    plain = dataclasses.replace(env, cfg=CONFIG.change(sim={"gripper": "rg2"}))
    one = jax.jit(plain.reset)(jax.random.key(0))
    assert one.scene.fingers is None
    np.testing.assert_allclose(one.obs.fingers, [0.11, 0.012, 0.02])
    blind = dataclasses.replace(env, cfg=CONFIG.change(net={"gripper": False}))
    assert jax.eval_shape(blind.reset, jax.random.key(0)).obs.fingers is None


@pytest.mark.slow
@pytest.mark.mjx
def test_fingers_stay_for_the_episode(env: Env, states: State):
    """Claim: a step keeps the fingers, also where physics fails; the next episode has others; a
    given scene has its own, or the largest."""
    first = jax.tree.map(lambda leaf: leaf[0], states)
    spoilt = first.replace(obs=first.obs.replace(height=first.obs.height.at[0, 0].set(jnp.nan)))
    step = jax.jit(env.step)
    for state, fails in ((first, False), (spoilt, True)):
        after = step(state, Action.grasp(0.0, 0.0, 0.0))
        assert bool(after.info.physics_diverged) == fails
        np.testing.assert_array_equal(after.scene.fingers, first.scene.fingers)
        np.testing.assert_array_equal(after.obs.fingers, first.obs.fingers)
    following = env.auto_reset(jax.random.key(7), first)
    assert (np.stack(following.scene.fingers) != np.stack(first.scene.fingers)).all()
    given = env.reset_to(first.scene.replace(fingers=None))
    np.testing.assert_allclose(given.scene.fingers, VARIED.fingers, rtol=1e-6)
    np.testing.assert_array_equal(env.reset_to(first.scene).scene.fingers, first.scene.fingers)


@pytest.mark.parametrize("fingers", [THIN, VARIED.fingers, VARIED.varies[0]])
def test_pads_in_mujoco(fingers: Fingers):
    """Claim: in C MuJoCo, at a grasp's start, the pads' inner faces are the opening apart; pads and
    their bounding spheres have the fingers' sizes."""
    world = model.build(CONFIG.scene, CONFIG.sim)
    own = model.with_blocks(world, _fields(world, fingers))
    data = mujoco.MjData(own)
    plan = _plan(fingers)
    joints = jax.jit(functools.partial(primitives.joint_trajectory, CONFIG.sim))(plan)
    data.qpos[world.robot_qpos] = joints.start
    mujoco.mj_kinematics(own, data)
    low, high = world.pads
    apart = np.linalg.norm((data.geom_xpos[high] - data.geom_xpos[low])[:2])
    np.testing.assert_allclose(apart - fingers.thickness, fingers.opening, atol=1e-6)
    for pad in (low, high):
        half = 0.5 * fingers.thickness, 0.5 * fingers.width, 0.00925
        np.testing.assert_allclose(own.geom_size[pad], half, rtol=1e-6)
        np.testing.assert_allclose(own.geom_rbound[pad], np.linalg.norm(half), rtol=1e-6)


def _plan(fingers: Fingers | None) -> primitives.Plan:
    """Of a grasp at a cube in the middle, fully open."""
    height = jnp.zeros((32, 32)).at[14:18, 14:18].set(0.05)
    grasp = Action.grasp(0.0, 0.0, 0.3)
    sim = dataclasses.replace(CONFIG.sim, opening="full")
    return jax.jit(lambda f: primitives.plan(sim, CONFIG.heightmap, height, grasp, f))(fingers)


def test_hand_opens_as_far_as_the_fingers():
    """Claim: a grasp begins with the episode's opening and ends closed; a push stays closed."""
    plan = _plan(THIN)
    assert plan.start[4] == plan.control[:, 4].max() == np.float32(0.04)
    assert plan.control[-1, 4] == 0.0
    assert _plan(None).start[4] == np.float32(0.07)
    bare, action = jnp.zeros((32, 32)), Action.push(0.0, 0.0, 0.0)
    push = primitives.plan(CONFIG.sim, CONFIG.heightmap, bare, action, THIN)
    assert push.control[:, 4].max() == 0.0


@pytest.mark.mjx
@pytest.mark.parametrize("physics", ["mjx", "warp"])
def test_other_physics_have_the_same_pads(physics: PhysicsKind):
    """Claim: size, place and bounds of the pads in MJX and on Warp are those in C MuJoCo."""
    sim = dataclasses.replace(CONFIG.sim, physics=physics)
    world, scene = model.build(CONFIG.scene, sim), _scene()
    wanted = model.with_blocks(world, _fields(world, THIN))
    if physics == "mjx":
        from csac_jax.sim import mjx_physics

        found = vars(mjx_physics.scene_model(mjx_physics.MjxPhysics(world, sim), scene))
    else:
        from csac_jax.sim import warp_physics

        found = warp_physics._model_fields(world, scene)
        bounds = found["geom_aabb"][world.pads]
        np.testing.assert_allclose(bounds[:, 1], wanted.geom_size[world.pads], rtol=1e-6)
    for name in ("geom_size", "geom_pos", "geom_rbound"):
        np.testing.assert_allclose(found[name], getattr(wanted, name), rtol=1e-6, err_msg=name)


@pytest.mark.slow
@pytest.mark.mjx
def test_oracle_takes_what_fits(env: Env):
    """Claim: the planner takes the high block if narrower than the opening, else the low one."""
    half = jnp.array([[0.026, 0.026, 0.06], [0.025, 0.025, 0.02], [0.02, 0.02, 0.02]])
    position = jnp.array([[-0.08, 0.0, 0.06], [0.08, 0.0, 0.02], [3.6, 0.0, 1.0]])
    here = jnp.array([True, True, False])
    scene = _scene().replace(half_size=half, position=position, in_play=here)
    for opening, x in ((0.073, -0.08), (0.071, 0.08)):
        own = scene.replace(fingers=Fingers(jnp.float32(opening), *scene.fingers[1:]))
        taken = oracle.grasp(CONFIG, own, env.reset_to(own).obs.height)
        np.testing.assert_allclose(taken.pose[0], x, atol=0.005)


def test_net_sees_the_fingers(states: State):
    """Claim: Q follows the fingers, which a stored observation keeps."""
    learner, params = actor_critic.make(CONFIG), random_params(CONFIG)
    look = jax.jit(functools.partial(values.dense_maps, learner, params))
    obs = jax.tree.map(lambda leaf: leaf[:2], states.obs)
    same = obs.replace(fingers=obs.fingers[:1].repeat(2, axis=0))
    other = same.replace(fingers=same.fingers + 0.004)
    assert float(jnp.abs(look(other).q - look(same).q).max()) > 1e-3
    packed = heightmap.unpack(heightmap.pack(obs))
    np.testing.assert_array_equal(packed.fingers, obs.fingers)


def test_start_from_a_policy_that_sees_no_gripper(tmp_path: Path, states: State):
    """Claim: networks without the last inputs, gripper, target and how the hand fits, are a start:
    Q is the same for all fingers and targets, and the nets still see the gripper. Those that lack
    another input are refused."""
    blind = presets.smoke().change(sim={"physics": "c"})
    params, path = random_params(blind), tmp_path / "policy.safetensors"
    policy_file.save(path, params, blind)
    changes: Any = {"task": {"kind": "target"}}, {"net": {"fit": True}}
    for cfg in (CONFIG, *(CONFIG.change(**one) for one in changes)):
        start: Any = api.initial_networks(cfg, path)
        found = start(learner_state(cfg, 3)).online
        target = np.random.default_rng(1).uniform(size=states.obs.target[:2].shape) < 0.5
        obs = jax.tree.map(lambda leaf: leaf[:2], states.obs).replace(target=target)
        seen, both = (
            jax.jit(functools.partial(values.dense_maps, learner))(params, obs)
            for learner, params, obs in (
                (actor_critic.make(blind), params, obs.replace(fingers=None)),
                (actor_critic.make(cfg), found, obs),
            )
        )
        np.testing.assert_allclose(both.q, seen.q, atol=1e-5)
    found = api.match_networks(CONFIG.change(net={"fit": True}), "shipped_clutter").net
    assert found.gripper
    assert found.fit
    for changes in ({"task": {"kind": "target"}}, {"net": {"colour": False}}):
        other = blind.change(**changes)
        policy_file.save(path, random_params(other), other)
        with pytest.raises(SettingsError, match="its networks are not those of these settings"):
            api.initial_networks(CONFIG.change(task={"kind": "target"}), path)


@pytest.mark.mjx
def test_robot_has_one_gripper(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Claim: a policy for any gripper is exported as it is; a program, or a decision for a robot,
    asks for its gripper in one line."""
    path, program_file = tmp_path / "policy.safetensors", tmp_path / "program.onnx"
    policy_file.save(path, random_params(CONFIG), CONFIG)
    assert main(["export", str(path), str(tmp_path / "copy.safetensors")]) == 0
    with pytest.raises(SettingsError, match=f"^{ASKED}"):
        deploy.CameraPolicy.load(path).warm_up(64, 48)
    given = ["export", str(path), str(program_file), "--format", "onnx"]
    capsys.readouterr()
    assert main(given) == 2
    assert ASKED in capsys.readouterr().err
    assert not program_file.exists()
