"""The camera's pose from points that the robot has touched: hand-eye calibration without a board.

Mark five places or more, not on one line. Note each one's pixel in an image, touch it with the
point between the closed finger tips, and note where the robot is.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from csac_jax.deploy import images
from csac_jax.section import require

LEAST = 4  # points: three fit always, and leave no residual
SCALE_TOLERANCE = 0.02  # of distances in the image over distances touched (ours)
_AROUND = 2  # px to all sides in which the median depth is taken
_LINE = 0.01  # m, least standard deviation of the points across the line through them


class Calibration(NamedTuple):
    """A pose, and its error at each of n measurements."""

    pose: np.ndarray  # [4, 4]
    residual_mm: np.ndarray  # [n]


def seen_points(depth: Any, intrinsics: Any, pixels: Any) -> np.ndarray:
    """Returns the points [n, 3] m in the camera's frame of pixels [n, 2], column and row.

    Args: depth [h, w] m, 0 or NaN where it is missing; intrinsics as for `CameraPolicy.decide`.
    Raises SettingsError for pixels outside of the image, or with no depth around them.
    """
    camera, depth = images.Intrinsics.of(intrinsics), np.asarray(depth, np.float64)
    require(depth.shape == camera.shape, "depth: its size is not that of the intrinsics")
    places = _points(pixels, 2, "pixels").round().astype(int)
    inside = np.all((places >= 0) & (places < depth.shape[::-1]))
    require(bool(inside), "pixels: must lie in the image, column first")
    distance = np.array([_median_depth(depth, col, row) for col, row in places])
    return images.rays(camera)[places[:, 1], places[:, 0]] * distance[:, None]


def _median_depth(depth: np.ndarray, col: int, row: int) -> float:
    top, left = max(row - _AROUND, 0), max(col - _AROUND, 0)
    around = depth[top : row + _AROUND + 1, left : col + _AROUND + 1]
    measured = around[around > 0.0]
    found = measured.size > 0
    require(found, f"pixels: there is no depth at column {col}, row {row}; choose another")
    return float(np.median(measured))


def fit(seen: Any, touched: Any) -> Calibration:
    """Fits the rigid pose that maps seen points [n, 3] to touched ones [n, 3], m: least squares.

    Closed form: Kabsch, Acta Crystallographica A 32, 1976. Raises SettingsError for fewer than
    LEAST points, for points on a line, and for distances that differ by more than SCALE_TOLERANCE.
    """
    seen, touched = _points(seen, 3, "seen"), _points(touched, 3, "touched")
    counts = f"{LEAST} or more, not {len(touched)} for {len(seen)}"
    enough = len(seen) == len(touched) and len(seen) >= LEAST
    require(enough, f"touched: give one point for each one seen, {counts}")
    from_mean, to_mean = seen - seen.mean(axis=0), touched - touched.mean(axis=0)
    spread = np.linalg.svd(to_mean, compute_uv=False)[1] / len(seen) ** 0.5
    require(spread >= _LINE, "touched: the points lie on a line; choose some off it")
    scale = float(np.linalg.norm(from_mean) / np.linalg.norm(to_mean))
    fault = f"seen: distances between the points are {scale:.3f} times those touched"
    remedy = "check the intrinsics, the unit of the depth, and the points"
    require(abs(scale - 1.0) <= SCALE_TOLERANCE, f"{fault}; {remedy}")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.align_vectors(to_mean, from_mean)[0].as_matrix()
    pose[:3, 3] = touched.mean(axis=0) - pose[:3, :3] @ seen.mean(axis=0)
    off = seen @ pose[:3, :3].T + pose[:3, 3] - touched
    return Calibration(pose, 1e3 * np.linalg.norm(off, axis=1))


def _points(values: Any, size: int, name: str) -> np.ndarray:
    """Converts values to an array [n, size]. Raises SettingsError unless all are finite numbers."""
    points = images.finite(values)
    rows = points.shape[1:] == (size,)
    require(rows, f"{name}: must be rows of {size} finite numbers")
    return points
