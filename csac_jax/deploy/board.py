"""The camera's pose from a printed board: ChArUco, by OpenCV (extra `calibrate`).

The board lies on the table in one image, and its middle becomes the workspace's centre. Or the
gripper holds it in several poses of the arm: hand-eye calibration. Its axes begin at its middle: x
to the right of the page, y up the page, z out of it.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from csac_jax.deploy import images
from csac_jax.deploy.calibration import Calibration
from csac_jax.errors import FailedError
from csac_jax.section import require

COLUMNS, ROWS = 8, 6  # squares of the board; with 30 mm they fit A4
DPI = 300  # of the printed picture
LEAST_CORNERS = 12  # of 35 that must be seen
LEAST_POSES = 3  # of the arm; OpenCV's methods need two rotations between them
LEAST_TURN = np.radians(10.0)  # between two poses of the arm: less says too little (ours)
_MARKER_SHARE = 0.7  # of a square
_MARGIN = 0.01  # m, white border, in which the axes are drawn
_INCH = 0.0254  # m


@dataclasses.dataclass(frozen=True)
class Board:
    """A board as it came out of the printer."""

    square: float = 0.03  # m, side of a square: measure it

    def __post_init__(self) -> None:
        require(0.003 <= self.square <= 0.3, "square: the side of a square in m, 0.003 to 0.3")

    @functools.cached_property
    def charuco(self) -> Any:
        """Returns OpenCV's board."""
        words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        marker = _MARKER_SHARE * self.square
        return cv2.aruco.CharucoBoard((COLUMNS, ROWS), self.square, marker, words)

    @functools.cached_property
    def corners(self) -> np.ndarray:
        """Returns the inner corners [35, 3] m in the board's axes, by OpenCV's numbers."""
        corners = np.asarray(self.charuco.getChessboardCorners(), np.float64)
        middle = 0.5 * self.square * np.array([COLUMNS, ROWS, 0])
        return (corners - middle) * [1.0, -1.0, -1.0]  # OpenCV's y runs down the page

    def picture(self) -> np.ndarray:
        """Draws the page to print at DPI, [rows, columns] uint8, with both axes in the margin."""
        size = [round(side * self.square / _INCH * DPI) for side in (COLUMNS, ROWS)]
        margin = round(_MARGIN / _INCH * DPI)
        page = np.pad(self.charuco.generateImage(size), margin, constant_values=255)
        left, low, length = margin // 2, page.shape[0] - margin // 2, 4 * margin
        axes = (("x", (length, low), (10, 10)), ("y", (left, low - length), (-10, -20)))
        for name, tip, label in axes:
            cv2.arrowedLine(page, (left, low), tip, 0, 3, tipLength=0.05)
            place = (tip[0] + label[0], tip[1] + label[1])
            cv2.putText(page, name, place, cv2.FONT_HERSHEY_SIMPLEX, 1.2, 0, 3)
        return page


def locate(board: Board, rgb: Any, intrinsics: Any) -> Calibration:
    """Finds the pose of the board, board to camera, in an image [h, w, 3] uint8.

    The residual is that of each corner seen, from where the pose puts it, at the board. Raises
    SettingsError for arrays of a wrong form, FailedError if too little of the board is seen.
    """
    camera, pixels = images.Intrinsics.of(intrinsics), np.asarray(rgb)
    fits = pixels.shape == (*camera.shape, 3) and pixels.dtype == np.uint8
    require(fits, "rgb: must be uint8 [rows, columns, 3] of the intrinsics' size")
    seen, corners = _corners(board, pixels)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    lens = np.array(camera.distortion or (0.0,) * 5)
    solved, turn, place = cv2.solvePnP(corners, seen, matrix, lens, flags=cv2.SOLVEPNP_IPPE)
    if not solved:
        raise FailedError("the board's pose cannot be found; take another image")
    turn, place = cv2.solvePnPRefineLM(corners, seen, matrix, lens, turn, place)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], place.ravel()
    again = cv2.projectPoints(corners, turn, place, matrix, lens)[0].reshape(-1, 2)
    depth = corners @ pose[2, :3] + pose[2, 3]
    off = (again - seen) / [camera.fx, camera.fy]
    return Calibration(pose, 1e3 * depth * np.linalg.norm(off, axis=1))


def _corners(board: Board, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the corners that are seen: [n, 2] px, and [n, 3] m in the board's axes."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    seen, numbers, *_ = cv2.aruco.CharucoDetector(board.charuco).detectBoard(grey)
    count = 0 if numbers is None else len(numbers)
    if count < LEAST_CORNERS:
        raise FailedError(
            f"{count} of the board's {len(board.corners)} corners are seen, {LEAST_CORNERS} are "
            "needed; bring it nearer, or give it more light"
        )
    return seen.reshape(-1, 2).astype(np.float64), board.corners[numbers.reshape(-1)]


def hand_eye(boards: Sequence[Calibration], robot: Sequence[Any]) -> Calibration:
    """Computes a fixed camera's pose in the robot's frame by a board in the gripper.

    Park and Martin 1994. Args: robot, for each image the pose [4, 4] from gripper to robot. The
    residual is the board's middle in the hand, from its mean. Raises SettingsError for too few
    poses, and for poses that differ too little.
    """
    arms = [images.rigid(pose, "robot") for pose in robot]
    counts = f"{LEAST_POSES} or more, not {len(arms)} for {len(boards)}"
    enough = len(arms) == len(boards) and len(arms) >= LEAST_POSES
    require(enough, f"robot: give a pose of the arm for each image, {counts}")
    axes = [cv2.Rodrigues(arms[0][:3, :3].T @ arm[:3, :3])[0].ravel() for arm in arms[1:]]  # rad
    turned = np.linalg.svd(np.array(axes), compute_uv=False)[1] >= LEAST_TURN
    remedy = "turn the hand about two, by 30 degrees or more"
    require(turned, f"robot: the poses turn about one axis; {remedy}")
    hands = np.linalg.inv(arms)  # OpenCV's names are of a camera in the hand
    seen, pose = np.array([board.pose for board in boards]), np.eye(4)
    solve: Any = functools.partial(cv2.calibrateHandEye, method=cv2.CALIB_HAND_EYE_PARK)
    parts = hands[:, :3, :3], hands[:, :3, 3], seen[:, :3, :3], seen[:, :3, 3]
    pose[:3, :3], place = solve(*parts)
    pose[:3, 3] = place.ravel()
    middles = (hands @ pose @ seen)[:, :3, 3]
    off = np.linalg.norm(middles - middles.mean(axis=0), axis=1)
    return Calibration(pose, 1e3 * off)
