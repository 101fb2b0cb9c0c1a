"""Hand-eye calibration against poses that are known."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from csac_jax.deploy import calibration, images
from csac_jax.errors import SettingsError

LENS = images.Intrinsics(64, 48, 60.0, 62.0, 31.0, 24.0, (0.05, -0.02, 0.001, 0.002, 0.0))
PIXELS = [[5, 40], [60, 44], [50, 6], [10, 8], [33, 25], [20, 30]]
SEEN = np.array([[-0.2, 0.1, 0.7], [0.2, 0.15, 0.6], [0.1, -0.1, 0.9], [-0.1, -0.1, 0.95]])


def _pose(seed: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    pose[:3, 3] = [0.4, -0.3, 0.6]
    return pose


def _moved(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.parametrize("flat", [False, True])
def test_pose_is_found(flat: bool):
    """Claim: exact points give the pose to 1e-9, also where all lie on a table, and no residual."""
    seen = SEEN * ([1, 1, 0] if flat else [1, 1, 1]) + [0, 0, 0.1]
    for seed in range(5):
        found = calibration.fit(seen, _moved(_pose(seed), seen))
        np.testing.assert_allclose(found.pose, _pose(seed), atol=1e-9)
        np.testing.assert_allclose(found.residual_mm, 0.0, atol=1e-6)


def test_residual_is_the_error_of_touching():
    """Claim: with errors of 2 mm along each axis the residuals' mean square is that of least
    squares, 3 - 6 / n error variances, and the pose is within 2 mm at the points' middle."""
    rng, points = np.random.default_rng(0), np.random.default_rng(1).uniform(-0.2, 0.2, (30, 3))
    squares, offs = [], []
    for seed in range(50):
        touched = _moved(_pose(seed), points) + rng.normal(scale=0.002, size=points.shape)
        found = calibration.fit(points, touched)
        squares.append(np.mean(found.residual_mm**2))
        offs.append(_moved(found.pose, points.mean(0)) - _moved(_pose(seed), points.mean(0)))
    assert np.mean(squares) == pytest.approx(4.0 * (3.0 - 6.0 / 30), rel=0.05)
    assert np.abs(offs).max() < 0.002


def test_pixels_are_points():
    """Claim: a pixel's point, seen again through the distorted lens, is that pixel; holes and wild
    depths beside it do not matter. Pixels that have no point are refused."""
    depth = np.random.default_rng(2).uniform(0.7, 0.7001, LENS.shape)
    for col, row in PIXELS:
        depth[row, col], depth[row - 1, col], depth[row, col - 1] = np.nan, 0.0, 3.0
    points = calibration.seen_points(depth, LENS, PIXELS)
    pixel, inside = images.project(LENS, np.eye(4), points)
    assert inside.all()
    np.testing.assert_allclose(pixel, PIXELS, atol=0.01)
    np.testing.assert_allclose(points[:, 2], 0.7, atol=1e-3)
    for depth, place, message in (
        (np.ones((48, 64)), [64, 3], "pixels: must lie in the image"),
        (np.zeros((48, 64)), [6, 3], "pixels: there is no depth at column 6, row 3"),
        (np.ones((64, 48)), [6, 3], "depth: its size is not that of the intrinsics"),
    ):
        with pytest.raises(SettingsError, match=message):
            calibration.seen_points(depth, LENS, [place])


@pytest.mark.parametrize(
    ("seen", "touched", "message"),
    [
        (SEEN[:3], SEEN[:3], "touched: give one point for each one seen, 4 or more, not 3 for 3"),
        (SEEN * [1, 0, 0], SEEN * [1, 0, 0], "touched: the points lie on a line"),
        (SEEN, 1.05 * SEEN, "seen: distances between the points are 0.952 times those touched"),
        ([["a"]], SEEN, "seen: must be rows of 3 finite numbers"),
    ],
)
def test_bad_points_are_refused(seen: Any, touched: Any, message: str):
    """Claim: points that give no pose are refused in one line that says why."""
    with pytest.raises(SettingsError, match=message):
        calibration.fit(seen, touched)
