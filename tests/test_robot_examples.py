"""The examples that drive a robot, as far as they go without one."""

import json
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import csac_jax

FOLDER = Path(csac_jax.__file__).parents[1] / "examples"
UR = runpy.run_path(str(FOLDER / "11_ur_rtde.py"))
FRANKA = runpy.run_path(str(FOLDER / "10_franka.py"))
REALSENSE = runpy.run_path(str(FOLDER / "09_realsense.py"))
ROS = runpy.run_path(str(FOLDER / "12_ros2_node.py"))
ARGS = SimpleNamespace(speed=0.05, acceleration=0.2, force=15.0, reach=0.85, lowest=0.0)
HEIGHTS = {"approach": 0.2, "descend": 0.1, "act": 0.1, "retreat": 0.2}


def _decision(x: float = 0.4) -> dict[str, Any]:
    """A grasp with the tool pointing down, its x along the robot's y."""
    waypoints = []
    for name, z in HEIGHTS.items():
        tool = [[0, 1, 0, x], [1, 0, 0, 0.1], [0, 0, -1, z], [0, 0, 0, 1]]
        opening = 0.11 if name in ("approach", "descend") else 0.0
        waypoints.append({"name": name, "opening": opening, "tool": tool})
    return {"waypoints": waypoints}


class FakeArm:
    """Both interfaces of an arm. A move begins late: its progress is first that of the last move,
    then 0, then another negative number. At the move `contact` force jumps."""

    def __init__(self, contact: int | None = None) -> None:
        self.log: list[Any] = []
        self._contact, self._moves, self._polls = contact, 0, 9

    def gripper(self, opening: float) -> None:
        self.log.append(("gripper", opening))

    def isPoseWithinSafetyLimits(self, point: list[float]) -> bool:  # noqa: N802
        return point[2] < 0.5

    def moveL(self, point: list[float], *limits: Any) -> None:  # noqa: N802
        assert limits == (0.05, 0.2, True)
        self.log.append(("move", tuple(np.round(point[:3], 6))))
        self._moves, self._polls = self._moves + 1, 0

    def getAsyncOperationProgress(self) -> int:  # noqa: N802
        self._polls += 1
        idle = -1 - (self._moves % 2)
        return (-3 - idle, 0, 0, idle)[min(self._polls, 4) - 1]

    def getActualTCPForce(self) -> list[float]:  # noqa: N802
        touching = self._moves - 1 == self._contact and self._polls == 2
        return [0.0, 0.0, 20.0 if touching else 3.0, 0.0, 0.0, 0.0]

    def stopL(self, deceleration: float) -> None:  # noqa: N802
        self.log.append(("stop",))

    def getActualTCPPose(self) -> list[float]:  # noqa: N802
        return [0.41, 0.1, 0.15, 0.0, 3.1, 0.0]


def test_pose_out_of_reach_is_refused():
    """Claim: nothing moves if a set-point is no number, out of reach, too low, or unsafe."""
    arm, low, high = FakeArm(), SimpleNamespace(**{**vars(ARGS), "lowest": 0.15}), _decision()
    high["waypoints"][0]["tool"][2][3] = 0.6
    cases = [
        (_decision(2.0), ARGS, "out of reach, or lower than"),
        (_decision(float("nan")), ARGS, "out of reach, or lower than"),
        (_decision(), low, r"lower than 0\.15 m"),
        (high, ARGS, "safety limits"),
    ]
    for decision, arguments, message in cases:
        with pytest.raises(ValueError, match=message):
            UR["execute"](arm, arm, arm.gripper, decision, arguments)
    assert arm.log == []


def test_arm_goes_through_the_waypoints():
    """Claim: fingers open before the approach and close before `act`; the arm visits all four; a
    set-point's rotation vector turns as the tool's matrix does."""
    points = UR["set_points"](_decision(), 0.85, 0.0)
    for point, waypoint in zip(points, _decision()["waypoints"], strict=True):
        tool = np.array(waypoint["tool"])
        np.testing.assert_allclose(point[:3], tool[:3, 3])
        turned = Rotation.from_rotvec(point[3:]).as_matrix()
        np.testing.assert_allclose(turned, tool[:3, :3], atol=1e-9)
    arm = FakeArm()
    assert UR["execute"](arm, arm, arm.gripper, _decision(), ARGS)
    openings = [0.11, 0.11, 0.0, 0.0]
    wanted: list[Any] = []
    for opening, z in zip(openings, HEIGHTS.values(), strict=True):
        wanted += [("gripper", opening), ("move", (0.4, 0.1, z))]
    assert arm.log == wanted


def test_contact_ends_the_descent():
    """Claim: a force above the limit stops the arm, which goes straight up and does not act."""
    arm = FakeArm(contact=1)
    assert not UR["execute"](arm, arm, arm.gripper, _decision(), ARGS)
    assert arm.log[-2:] == [("stop",), ("move", (0.41, 0.1, 0.2))]
    assert ("gripper", 0.0) not in arm.log


def test_dry_run_prints(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Claim: without --host the set-points are printed, and nothing is connected."""
    (tmp_path / "d.json").write_text(json.dumps({"decisions": [_decision()]}))
    UR["main"](str(tmp_path / "d.json"))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    assert lines[1].startswith("+0.4000 +0.1000 +0.1000 ")


class FakeFranka:
    """Arm, hand and module of a Franka in one. The move `contact` fails as by a collision."""

    ControlException = ArithmeticError
    max_width = 0.08

    def __init__(self, contact: int | None = None, yaw: float = 0.0) -> None:
        self.log: list[Any] = []
        self.width, self._contact, self._pose = 0.0, contact, np.eye(4)
        self._pose[:3, :3] = Rotation.from_euler("xz", [np.pi, yaw]).as_matrix()

    @property
    def current_pose(self) -> Any:
        return SimpleNamespace(end_effector_pose=SimpleNamespace(matrix=self._pose))

    def Affine(self, pose: np.ndarray) -> np.ndarray:  # noqa: N802
        return pose

    CartesianMotion = Affine

    def move(self, pose: np.ndarray | float, speed: float | None = None) -> None:
        if speed is not None:
            self.width = float(np.asarray(pose))
            self.log.append(("open", self.width))
            return
        self._pose = np.asarray(pose)
        moves = sum(entry[0] == "move" for entry in self.log)
        self.log.append(("move", round(float(self._pose[2, 3]), 4)))
        if moves == self._contact:
            raise ArithmeticError

    def grasp(self, width: float, *limits: float, **tolerance: float) -> None:
        self.width = width
        self.log.append(("grasp", *limits))

    def recover_from_errors(self) -> None:
        self.log.append(("recover",))


FRANKA_ARGS = SimpleNamespace(**vars(ARGS), grip=20.0)


def _franka_moves(arm: FakeFranka, decision: dict[str, Any]) -> bool:
    return FRANKA["execute"](arm, arm, arm, decision, FRANKA_ARGS)


@pytest.mark.parametrize("yaw", [0.0, np.pi])
def test_franka_hand_closes_along_the_tool(yaw: float):
    """Claim: the tips reach the tool's place, fingers along its x, by the smaller turn of the
    wrist; a grasp opens as far as the hand can, and presses once, before `act`."""
    arm, decision = FakeFranka(yaw=yaw), _decision()
    before = arm.current_pose.end_effector_pose.matrix
    assert _franka_moves(arm, decision)
    heights = [round(z + FRANKA["TIPS"], 4) for z in HEIGHTS.values()]
    moves = [("move", z) for z in heights]
    assert arm.log == [("open", 0.08), *moves[:2], ("grasp", 0.05, 20.0), moves[2], moves[3]]
    tool, after = np.array(decision["waypoints"][-1]["tool"]), arm.current_pose.end_effector_pose
    tips = after.matrix @ [0.0, 0.0, FRANKA["TIPS"], 1.0]
    np.testing.assert_allclose(tips, tool[:, 3], atol=1e-9)
    assert abs(after.matrix[:3, 1] @ tool[:3, 0]) == pytest.approx(1.0)
    assert np.trace(before[:3, :3].T @ after.matrix[:3, :3]) >= 1.0 - 1e-9


def test_franka_pushes_with_closed_fingers_and_yields_to_contact():
    """Claim: a push closes the fingers before it; after a collision the arm goes straight up."""
    arm, push = FakeFranka(contact=1), _decision()
    for waypoint in push["waypoints"]:
        waypoint["opening"] = 0.0
    assert not _franka_moves(arm, push)
    up = round(HEIGHTS["retreat"] + FRANKA["TIPS"], 4)
    assert arm.log[0] == ("open", 0.0)
    assert arm.log[3:] == [("recover",), ("move", up)]
    with pytest.raises(ValueError, match="out of reach"):
        _franka_moves(arm, _decision(2.0))


def test_realsense_writes_what_act_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: image, depth in m and lens are files that the readers of `act` take."""
    from csac_jax.deploy import image_files

    counts = np.full((48, 64), 700, np.uint16)
    lens = SimpleNamespace(width=64, height=48, fx=60.0, fy=61.0, ppx=31.5, ppy=23.5)
    lens.coeffs = [0.0] * 5
    video = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(intrinsics=lens))
    colour = SimpleNamespace(get_data=lambda: np.zeros((48, 64, 3), np.uint8), profile=video)
    frames = SimpleNamespace(
        get_color_frame=lambda: colour,
        get_depth_frame=lambda: SimpleNamespace(get_data=lambda: counts),
    )
    sensor = SimpleNamespace(get_depth_scale=lambda: 0.001)
    device = SimpleNamespace(first_depth_sensor=lambda: sensor)
    pipeline = SimpleNamespace(
        start=lambda config: SimpleNamespace(get_device=lambda: device),
        wait_for_frames=lambda: None,
        stop=lambda: None,
    )
    fake = SimpleNamespace(
        config=lambda: SimpleNamespace(enable_stream=lambda *args: None),
        pipeline=lambda: pipeline,
        stream=SimpleNamespace(color=0, depth=1),
        format=SimpleNamespace(rgb8=0, z16=1),
        align=lambda stream: SimpleNamespace(process=lambda frames_: frames),
    )
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
    REALSENSE["main"](str(tmp_path / "shot"))
    depth = image_files.read_depth(tmp_path / "shot" / "depth.npy")
    np.testing.assert_allclose(depth, 0.7, rtol=1e-6)
    assert image_files.read_rgb(tmp_path / "shot" / "rgb.png").shape == (48, 64, 3)
    found = image_files.read_intrinsics(tmp_path / "shot" / "intrinsics.json")
    assert (found.fx, found.fy, found.cx, found.cy) == (60.0, 61.0, 31.5, 23.5)


def _message(pixels: np.ndarray, encoding: str, padding: int = 5, big: bool = False) -> Any:
    """A sensor_msgs/Image whose rows end in unused bytes."""
    flat = pixels.astype(pixels.dtype.newbyteorder(">")) if big else pixels
    rows = flat.reshape(len(pixels), -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, padding)))
    height, width = pixels.shape[:2]
    kept = {"height": height, "width": width, "encoding": encoding, "is_bigendian": big}
    return SimpleNamespace(**kept, step=padded.shape[1], data=padded.tobytes())


def test_ros_images():
    """Claim: colours become RGB, depth metres, whatever order and padding the message has."""
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (6, 7, 3), np.uint8)
    depth = rng.integers(1, 5000, (6, 7), np.uint16)
    np.testing.assert_array_equal(ROS["image"](_message(rgb, "rgb8")), rgb)
    np.testing.assert_array_equal(ROS["image"](_message(rgb, "bgr8")), rgb[..., ::-1])
    for big in (False, True):
        found = ROS["image"](_message(depth, "16UC1", big=big))
        np.testing.assert_allclose(found, depth / 1000, rtol=1e-6)
        assert found.dtype == np.float32
    metres = (depth / 1000).astype(np.float32)
    np.testing.assert_array_equal(ROS["image"](_message(metres, "32FC1")), metres)
    with pytest.raises(ValueError, match="encoding mono8 is not one of"):
        ROS["image"](_message(rgb[..., 0].copy(), "mono8"))


def test_ros_camera_and_transform():
    """Claim: camera_info and transform become what `CameraPolicy.decide` takes."""
    matrix = [600, 0, 320, 0, 610, 240, 0, 0, 1]
    info = SimpleNamespace(k=matrix, d=[0.1] * 5, width=640, height=480)
    camera = csac_jax.deploy.images.Intrinsics.of(ROS["intrinsics"](info))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (600, 610, 320, 240)
    assert camera.distortion == (0.1,) * 5
    half = float(np.sqrt(0.5))
    turn = SimpleNamespace(x=0.0, y=0.0, z=half, w=half)  # 90 degrees about z
    move = SimpleNamespace(x=1.0, y=2.0, z=3.0)
    pose = ROS["matrix"](SimpleNamespace(rotation=turn, translation=move))
    np.testing.assert_allclose(pose @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-9)
