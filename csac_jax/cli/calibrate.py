"""`csac-jax calibrate`: the camera's pose from a printed board."""

import dataclasses
from pathlib import Path
from typing import Any

from csac_jax.cli import parsing
from csac_jax.cli.failures import check_extra
from csac_jax.errors import SettingsError


@dataclasses.dataclass(frozen=True)
class CalibrateOptions:
    """Finds the camera's pose by a printed board.

    The board lies on the table in one image, its middle the workspace's centre; or the gripper
    holds it in several images."""

    board: Path | None = None
    """Writes the board as a .png to print, and stops."""
    rgb: tuple[Path, ...] = ()
    """Colour images of the board: one of it on the table, or several of it in the gripper."""
    intrinsics: Path | None = None
    """JSON of the camera: width, height, fx, fy, cx, cy in px, and maybe distortion."""
    robot: tuple[Path, ...] = ()
    """For a board in the gripper: for each image a JSON with the matrix from gripper to robot."""
    workspace: Path | None = None
    """For a board in the gripper: JSON with the 4 x 4 matrix from workspace to robot, m."""
    square: float = 0.03
    """Side of a printed square, m: measure it."""
    out: Path = Path("pose.json")
    """File to write the pose to, from camera to workspace."""


def run(arguments: list[str]) -> int:
    """Writes the board or the pose; returns the exit code."""
    options = parsing.parse(CalibrateOptions, arguments, "calibrate")
    check_extra("calibrate", "cv2", "calibrate")
    from csac_jax.deploy import board

    printed = board.Board(options.square)
    if options.board is not None:
        return _print(options.board, printed)
    _check(options)
    import numpy as np

    from csac_jax.deploy import image_files
    from csac_jax.io import files

    assert options.intrinsics is not None
    lens = image_files.read_intrinsics(options.intrinsics)
    boards = [board.locate(printed, image_files.read_rgb(path), lens) for path in options.rgb]
    for path, located in zip(options.rgb, boards, strict=True):
        print(f"{path}: {len(located.residual_mm)} corners, {_spread(located.residual_mm)}")
    if options.workspace is None:
        pose = board.on_table(boards[0])
    else:
        workspace = image_files.read_pose(options.workspace)
        eye = board.hand_eye(boards, [image_files.read_pose(path) for path in options.robot])
        for path, off in zip(options.robot, eye.residual_mm, strict=True):
            print(f"{path}: {off:.2f} mm off")
        print(f"hand-eye: {_spread(eye.residual_mm)}")
        pose = np.linalg.inv(workspace) @ eye.pose
    files.write_json(options.out, {"matrix": pose.tolist()})
    print(f"wrote {options.out}")
    return 0


def _check(options: CalibrateOptions) -> None:
    if not options.rgb or options.intrinsics is None:
        raise SettingsError("calibrate: give --rgb and --intrinsics, or --board FILE to print")
    if bool(options.robot) != (options.workspace is not None):
        raise SettingsError("calibrate: --robot and --workspace go together")
    if not options.robot and len(options.rgb) > 1:
        raise SettingsError("--rgb: one image of a board on the table, or give --robot too")


def _print(path: Path, printed: Any) -> int:
    from csac_jax.deploy import board, image_files
    from csac_jax.io import files

    if path.suffix != ".png":
        raise SettingsError(f"--board: {path} must end in .png")
    files.replace(path, image_files.encode(printed.picture(), board.DPI))
    wide, high = (1e3 * side * printed.square for side in (board.COLUMNS, board.ROWS))
    print(
        f"wrote {path}: a board of {wide:.0f} x {high:.0f} mm at {board.DPI} dpi; print it in its "
        "own size, measure a square, and give that to --square"
    )
    return 0


def _spread(residual_mm: Any) -> str:
    return f"residual {residual_mm.mean():.2f} mm in the mean, {residual_mm.max():.2f} mm at most"
