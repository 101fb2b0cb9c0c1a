"""From an image to decisions."""

from typing import Any

import jax
import numpy as np
import pytest

import csac_jax
from csac_jax import grippers, presets
from csac_jax.config import CameraConfig
from csac_jax.deploy import CameraPolicy, Decision, decision as decisions_of
from csac_jax.errors import DataWarning, SettingsError
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Action
from csac_jax.vision import camera, observe, raycast
from tests.deploy import scenes
from tests.networks import random_params

POSES = np.array([[0.1, 0.09, 0.4], [-0.1, 0.0, 1.0], [0.06, -0.1, 2.0]])
SHAPES = scenes.blocks_at(POSES)
IMAGE = scenes.take(SHAPES)
WORKSPACE = np.array([[0, -1, 0, 0.4], [1, 0, 0, -0.2], [0, 0, 1, 0.05], [0, 0, 0, 1]], float)


@pytest.fixture(scope="module")
def policy() -> CameraPolicy:
    return CameraPolicy.load("shipped_clutter", WORKSPACE)


def _untrained(**sections: Any) -> CameraPolicy:
    cfg = presets.smoke().change(**sections)
    return CameraPolicy(cfg, random_params(cfg))


@pytest.fixture(scope="module")
def decisions(policy: CameraPolicy) -> list[Decision]:
    return policy.decide(*IMAGE, top=4)


def _block_under(decision: Decision) -> int | None:
    """Returns the block whose top holds the place of a decision, by the block's own frame."""
    for number, (x, y, yaw) in enumerate(POSES):
        cos, sin = np.cos(yaw), np.sin(yaw)
        dx, dy = decision.position[0] - x, decision.position[1] - y
        if abs(cos * dx + sin * dy) < 0.055 and abs(cos * dy - sin * dx) < 0.03:
            return number
    return None


def test_decides_on_the_blocks(decisions: list[Decision]):
    """Claim: each of four decisions is a grasp on a block, tips 3.5 cm below its top, and two on
    different places."""
    assert len(decisions) == 4
    assert {decision.primitive for decision in decisions} == {"grasp"}
    assert None not in map(_block_under, decisions)
    for decision in decisions:
        assert decision.position[2] == pytest.approx(0.05 - 0.035, abs=1e-3)
        assert 0.05 <= decision.width <= 0.11 + 1e-6  # the block's, or fully open
    places = np.array([decision.position[:2] for decision in decisions])
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)[np.triu_indices(4, 1)]
    assert apart.min() >= decisions_of.APART - 1e-6
    assert decisions[0].score == max(decision.score for decision in decisions)


def test_width_is_the_simulated_opening(policy: CameraPolicy):
    """Claim: width and position of a decision among close neighbours are those that the simulated
    hand comes down with, less than fully open."""
    image = scenes.take(scenes.blocks_at([[0.0, y, 0.0] for y in (-0.08, 0.0, 0.08)]))
    policy = CameraPolicy(policy.cfg.change(sim={"opening": "fit"}), policy.params, WORKSPACE)
    decided, height = policy.decide(*image, top=3), policy.observe(*image).height

    @jax.jit
    def joints(x: float, y: float, yaw: float) -> jax.Array:
        plan = primitives.plan(
            policy.cfg.sim, policy.cfg.heightmap, height, Action.grasp(x, y, yaw)
        )
        return primitives.joint_trajectory(policy.cfg.sim, plan).start

    for decision in decided:
        gap = grippers.load("rg2").gap(float(joints(*decision.position[:2], decision.yaw)[4]))
        assert decision.width == pytest.approx(gap, abs=1e-5)
    assert min(decision.width for decision in decided) < 0.1


def test_decides_as_in_simulation(decisions: list[Decision]):
    """Claim: the first decision is the simulated policy's in the observation of the same camera."""
    eye = camera.make(CameraConfig())
    trained = csac_jax.load_policy("shipped_clutter")
    marks = np.ones(len(POSES), bool)

    @jax.jit
    def observed() -> Any:
        tables = observe.surface_tables(SHAPES, marks)
        hits = camera.cast_rays(eye, raycast.cast_polytopes, SHAPES)
        return observe.from_pixels(trained.cfg.heightmap, eye, hits, tables)

    obs = observed()
    action = trained(obs, jax.random.key(0))
    descended = decisions_of.stations(trained.cfg, obs.height, action)[1]
    np.testing.assert_allclose(decisions[0].position[:2], descended[:2], atol=1e-3)
    assert np.cos(2 * (decisions[0].yaw - float(action.pose[2]))) > 0.999
    assert decisions[0].primitive == "grasp"


def test_batch_decides_as_each_alone(policy: CameraPolicy):
    """Claim: views that are decided about together get the decisions of each alone, as many as its
    `top` asks for and there are. Swapped colours are warned of."""
    empty, one = (scenes.take(scenes.blocks_at([pose])) for pose in ([3.0, 3.0, 0.0], [0, 0, 0.5]))
    images, tops = (IMAGE, empty, one, IMAGE), (3, 2, 1, 1)
    views = [policy.inspect(*image)[0] for image in images]
    batch = policy.decide_each(views, tops, only_target=False)
    assert [len(decisions) for decisions in batch] == [3, 0, 1, 1]
    for image, top, decisions in zip(images, tops, batch, strict=True):
        for got, alone in zip(decisions, policy.decide(*image, top=top), strict=True):
            assert got.primitive == alone.primitive
            np.testing.assert_allclose(got.position, alone.position, atol=1e-4)
            np.testing.assert_allclose(got.score, alone.score, atol=1e-4)
    with pytest.warns(DataWarning, match="red and blue seem to be swapped"):
        policy.decide(*IMAGE._replace(rgb=IMAGE.rgb[..., ::-1]))


def test_flying_pixels_are_left_out(policy: CameraPolicy):
    """Claim: single pixels with depths that no neighbour has change the map by 2 mm at most."""
    rng = np.random.default_rng(0)
    flies = rng.uniform(size=IMAGE.depth.shape) < 0.005
    depth = np.where(flies, IMAGE.depth - rng.uniform(0.1, 0.3, flies.shape), IMAGE.depth)
    exact, found = (
        policy.maps(*IMAGE._replace(depth=np.float32(one))).height for one in (IMAGE.depth, depth)
    )
    assert exact.max() > 0.049
    assert np.abs(found - exact).max() < 0.002


def test_waypoints_are_a_grasp(decisions: list[Decision]):
    """Claim: the tool goes straight down with open fingers, closes, and goes up again, 10 cm. Its
    pose is the workspace's pose times the place: z down, x along the yaw."""
    names, places, yaws, openings, _ = zip(*decisions[0].waypoints, strict=True)
    assert names == ("approach", "descend", "act", "retreat")
    assert len(set(yaws)) == len({place[:2] for place in places}) == 1
    low = decisions[0].position[2]
    heights = [place[2] for place in places]
    np.testing.assert_allclose(heights, [low + 0.1, low, low, low + 0.1], atol=1e-5)
    width = decisions[0].width
    np.testing.assert_allclose(openings, [width, width, 0.0, 0.0], atol=1e-6)
    for waypoint in decisions[0].waypoints:
        tool, (x, y, z) = np.array(waypoint.tool), waypoint.position
        np.testing.assert_allclose(tool[:3, 3], [0.4 - y, -0.2 + x, 0.05 + z], atol=1e-6)
        np.testing.assert_allclose(tool[:3, :3].T @ tool[:3, :3], np.eye(3), atol=1e-6)
        assert np.linalg.det(tool[:3, :3]) == pytest.approx(1.0)
        np.testing.assert_allclose(tool[:3, 2], [0.0, 0.0, -1.0], atol=1e-6)
        yaw = waypoint.yaw + 0.5 * np.pi  # the workspace's own turn
        np.testing.assert_allclose(tool[:2, 0], [np.cos(yaw), np.sin(yaw)], atol=1e-6)


def test_push_waypoints(policy: CameraPolicy):
    """Claim: a push goes 10 cm along its yaw with closed fingers, 2 cm below the top, and ends at
    the workspace's edge."""
    height = np.full((64, 64), 0.05, np.float32)
    for x, length in ((0.0, 0.1), (0.2, 0.024)):
        action = csac_jax.Action.push(x, 0.0, 0.0)
        stations = np.asarray(decisions_of.stations(policy.cfg, height, action))
        np.testing.assert_allclose(stations[:, 0], [x, x, x + length, x + length], atol=1e-5)
        np.testing.assert_allclose(stations[:, 2], [0.13, 0.03, 0.03, 0.13], atol=1e-5)
        np.testing.assert_allclose(stations[:, 4], 0.0)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_target_is_grasped(policy: CameraPolicy, number: int):
    """Claim: with a mask, the policy grasps the marked block alone, whichever it is."""
    x, y = POSES[number, :2]
    points = np.nan_to_num(IMAGE.depth)[..., None] * camera.directions(camera.make(scenes.CAMERA))
    place = np.asarray(points) + IMAGE.pose[:3, 3]
    mask = (np.hypot(place[..., 0] - x, place[..., 1] - y) < 0.06) & (place[..., 2] > 0.005)
    found = policy.decide(*IMAGE, target_mask=mask, top=2)
    assert found
    assert {_block_under(decision) for decision in found} == {number}


def test_policy_of_the_target_task_needs_a_mask():
    """Claim: a policy that was trained to get one block asks for its mask."""
    policy = _untrained(task={"kind": "target"})
    with pytest.raises(SettingsError, match="target_mask: this policy gets a marked object"):
        policy.decide(*IMAGE)
    assert policy.decide(*IMAGE, target_mask=np.asarray(IMAGE.depth > 0))


def test_robot_may_have_another_gripper(decisions: list[Decision]):
    """Claim: a policy decides for the gripper that it is given, by default for its own."""
    other = CameraPolicy.load("shipped_clutter", gripper="2f85").decide(*IMAGE)[0]
    assert (decisions[0].width, other.width) == pytest.approx((0.11, 0.085))
    with pytest.raises(SettingsError, match="neither one of"):
        CameraPolicy.load("shipped_clutter", gripper="2f86")


def test_net_of_heights_sees_no_colours():
    """Claim: a policy with `net.colour` off decides the same whatever the colours are."""
    heights = _untrained(net={"colour": False})
    other = IMAGE._replace(rgb=np.roll(255 - IMAGE.rgb, 7, axis=1))
    first, second = (heights.decide(*image)[0].to_dict() for image in (IMAGE, other))
    assert first == second
