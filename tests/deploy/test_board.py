"""The printed board against poses that are known, and what is refused."""

import json
import re
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from csac_jax import cli
from csac_jax.deploy import images
from csac_jax.deploy.calibration import Calibration
from csac_jax.errors import FailedError, SettingsError
from tests.deploy import boards, scenes

pytest.importorskip("cv2")

from csac_jax.deploy import board  # isort: skip

BOARD = board.Board()
ON_TABLE = np.linalg.inv(scenes.pose_of())  # the camera of VPG, 0.7 m away, 45 degrees down


def _rigid(turn: Rotation, place: Any) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), place
    return pose


def _off(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Returns the distance of two poses, mm and degrees."""
    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude()
    return 1e3 * float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(np.degrees(turn))


@pytest.mark.parametrize("lens", [boards.LENS, boards.DISTORTED], ids=["ideal", "distorted"])
def test_board_on_the_table(lens: images.Intrinsics):
    """Claim: one image of the board on the table gives the camera's pose to 1 mm and 0.1 degrees,
    also through a distorted lens, with a residual below 0.3 mm."""
    found = board.locate(BOARD, boards.take(BOARD, ON_TABLE, lens), lens)
    place, turn = _off(np.linalg.inv(found.pose), np.linalg.inv(ON_TABLE))
    assert place < 1.0
    assert turn < 0.1
    assert len(found.residual_mm) >= 20
    assert found.residual_mm.max() < 0.3


CAMERA = _rigid(Rotation.from_euler("xyz", [150, 10, 80], degrees=True), [0.6, -0.2, 0.9])
IN_HAND = _rigid(Rotation.from_euler("xyz", [20, -10, 30], degrees=True), [0.03, -0.02, 0.1])
"""Camera to robot, and board to gripper."""


def _arm(seed: int, num: int) -> list[np.ndarray]:
    """Returns gripper poses in which the camera sees the board, gripper to robot."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(num):
        turns = rng.uniform([155, -25, -25], [205, 25, 25])
        tilt = Rotation.from_euler("xyz", turns, degrees=True)
        seen = _rigid(tilt, rng.uniform([-0.05, -0.05, 0.45], [0.05, 0.05, 0.6]))
        poses.append(CAMERA @ seen @ np.linalg.inv(IN_HAND))
    return poses


def _seen_by_camera(arm: np.ndarray) -> np.ndarray:
    return np.linalg.inv(CAMERA) @ arm @ IN_HAND


def test_hand_eye_residual_is_the_arms_error():
    """Claim: exact poses give the camera to 1e-6 and no residual; with 2 mm of error at the arm
    the residual is between 1 and 4 mm."""
    arms, rng = _arm(1, 12), np.random.default_rng(2)
    located = [Calibration(_seen_by_camera(arm), np.zeros(35)) for arm in arms]
    exact = board.hand_eye(located, arms)
    np.testing.assert_allclose(exact.pose, CAMERA, atol=1e-6)
    assert exact.residual_mm.max() < 1e-3
    for arm in arms:
        arm[:3, 3] += rng.normal(scale=0.002, size=3)
    assert 1.0 < board.hand_eye(located, arms).residual_mm.mean() < 4.0


def test_too_little_is_refused():
    """Claim: a covered board, an image of another size and arms that turn about one axis are
    refused in one line."""
    image = boards.take(BOARD, ON_TABLE)
    image[:, :330] = 0
    with pytest.raises(FailedError, match=r"\d of the board's 35 corners are seen, 12 are needed"):
        board.locate(BOARD, image, boards.LENS)
    with pytest.raises(SettingsError, match="of the intrinsics' size"):
        board.locate(BOARD, image[::2], boards.LENS)
    located = [Calibration(np.eye(4), np.zeros(35))] * 4
    turned = [_rigid(Rotation.from_euler("z", 30 * i, degrees=True), [0, 0, 0]) for i in range(4)]
    with pytest.raises(SettingsError, match="the poses turn about one axis"):
        board.hand_eye(located, turned)
    with pytest.raises(SettingsError, match="3 or more, not 2 for 4"):
        board.hand_eye(located, turned[:2])


def _write(file: str, pose: np.ndarray) -> str:
    Path(file).write_text(json.dumps({"matrix": pose.tolist()}))
    return file


def _calibrate(*options: str) -> np.ndarray:
    """Runs the command in the working folder; returns the pose that it writes."""
    Path("lens.json").write_text(json.dumps(vars(boards.LENS)))
    assert cli.main(["calibrate", *options, "--intrinsics", "lens.json"]) == 0
    return np.array(json.loads(Path("pose.json").read_text())["matrix"])


def test_command_on_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    """Claim: the command prints a board of the size that it says, and writes the pose of an image
    of it; the print's squares and the image's are the same."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["calibrate", "--board", "board.png"]) == 0
    assert "240 x 180 mm at 300 dpi" in capsys.readouterr().out
    printed = imageio.imread("board.png")
    np.testing.assert_array_equal(printed, BOARD.picture())
    assert printed.shape == (round(200 / 25.4 * 300), round(260 / 25.4 * 300))
    imageio.imwrite("rgb.png", boards.take(BOARD, ON_TABLE))
    assert _off(_calibrate("--rgb", "rgb.png"), np.linalg.inv(ON_TABLE))[0] < 1.0
    assert "corners, residual 0." in capsys.readouterr().out


def test_command_in_the_hand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    """Claim: five images of the board in the gripper, with poses of the arm, give the camera in the
    workspace to 2 mm and 0.2 degrees, and no residual is above 2 mm."""
    monkeypatch.chdir(tmp_path)
    arms = _arm(0, 5)
    pictures = [f"{number}.png" for number in range(5)]
    for picture, arm in zip(pictures, arms, strict=True):
        imageio.imwrite(picture, boards.take(BOARD, _seen_by_camera(arm)))
    robots = [_write(f"{number}.json", arm) for number, arm in enumerate(arms)]
    workspace = _rigid(Rotation.from_euler("z", 90, degrees=True), [0.5, 0.0, 0.02])
    options = ["--workspace", _write("workspace.json", workspace)]
    pose = _calibrate("--rgb", *pictures, "--robot", *robots, *options)
    place, turn = _off(pose, np.linalg.inv(workspace) @ CAMERA)
    assert place < 2.0
    assert turn < 0.2
    residuals = re.findall(r"json: (\S+) mm off", capsys.readouterr().out)
    assert len(residuals) == 5
    assert max(map(float, residuals)) < 2.0
