"""Checks that an image agrees with its camera's pose, with the table and with the workspace.

They raise ViewError, one line that says what is wrong by how much.
"""

import dataclasses
import warnings
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from csac_jax.config import HeightmapConfig
from csac_jax.constants import CHANGE_AREA
from csac_jax.deploy import images
from csac_jax.deploy.images import CameraView
from csac_jax.errors import DataWarning, ViewError
from csac_jax.world.blocks import COLOURS

TABLE_TOLERANCE = 0.008  # m (ours): finger tips go down to 12 mm above z = 0
SEEN_SHARE = 0.8  # of the workspace's cells (ours)
HIGHEST_POSE = 5.0  # m, farther cameras are poses in another unit
_WINDOW = 5  # px, side of the window in which one pixel with a depth is enough
_INLIER = 0.005  # m, of a point on the table
_TRIALS, _SAMPLE = 128, 1500  # planes tried, points that judge them
_LEAST = 50  # points to look for a table or for colours in
_STEEPEST = 1.0  # largest slope of a table that is looked for
_LEAST_TABLE = 0.15  # share of the points around the workspace that a table has at least
_SWAPPED = 0.5  # ratio of distances to the blocks' colours that tells BGR from RGB
_AROUND = 1.25  # side of the square in which the table is looked for, of the workspace's
_UNITS = {  # measured over expected depth, as a power of ten -> what the numbers are
    3: "millimetres; multiply it by 0.001",
    2: "centimetres; multiply it by 0.01",
    1: "scaled for 1 mm where the camera counts in 0.1 mm; multiply it by 0.1",
    -1: "scaled for 0.1 mm where the camera counts in 1 mm; multiply it by 10",
    -2: "divided by 100 too much; multiply it by 100",
    -3: "scaled twice; multiply it by 1000",
}


@dataclasses.dataclass(frozen=True, eq=False)
class Table:
    """A plane z = height + slope . (x, y) in the workspace's frame."""

    height: float  # m, above z = 0 at the workspace's centre
    slope: np.ndarray  # [2] along x and y
    noise: float  # m, standard deviation of the points on it

    @property
    def tilt_deg(self) -> float:
        """Returns the angle between the plane and z = 0, degrees."""
        return float(np.degrees(np.arctan(np.hypot(*self.slope))))

    def worst(self, extent: float) -> float:
        """Returns the largest distance from z = 0 over the square of side `extent` m, m."""
        return float(abs(self.height) + 0.5 * extent * np.abs(self.slope).sum())


class CameraReport(NamedTuple):
    """Measurements in an image of the empty table, which show if pose and intrinsics fit."""

    height_mm: float  # of the table above z = 0, at the workspace's centre
    tilt_deg: float  # of the table
    worst_mm: float  # largest distance of the table from z = 0 in the workspace
    noise_mm: float  # standard deviation of the points on the table
    seen: float  # share of the workspace
    covered_cm2: float  # area higher than 1 cm, which an empty table has none of


def faults(report: CameraReport) -> list[str]:
    """Lists what must be mended before decisions are taken, one line each."""
    faults = {
        "the table is not at z = 0: measure the pose again": (
            report.worst_mm > 1e3 * TABLE_TOLERANCE
        ),
        "too little of the workspace is seen: move the camera": report.seen < SEEN_SHARE,
        "the table is not empty, or its depth too noisy": report.covered_cm2 > CHANGE_AREA,
    }
    return [fault for fault, holds in faults.items() if holds]


def pose(view: CameraView) -> None:
    """Checks that the camera stands above the table and sees the workspace's centre."""
    pose = view.pose
    if np.abs(pose[:3, 3]).max() > HIGHEST_POSE:
        far = np.linalg.norm(pose[:3, 3])
        raise ViewError(f"camera_pose: the camera is {far:.0f} m away; its unit is m")
    if _sees_centre(view, pose):
        return
    flipped = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
    others = {
        "it seems to map workspace to camera; give its inverse": np.linalg.inv(pose),
        "its axes seem to be OpenGL's; turn y and z round": flipped,
    }
    hints = [hint for hint, other in others.items() if _sees_centre(view, other)]
    hint = hints[0] if hints else "check it, x right, y down, z forward"
    raise ViewError(f"camera_pose: the workspace's centre is not in the image; {hint}")


def _sees_centre(view: CameraView, pose: np.ndarray) -> bool:
    _, inside = images.project(view.intrinsics, pose, np.zeros((1, 3)))
    return bool(inside[0] and pose[2, 3] > 0.0)


def depth_unit(view: CameraView, extent: float) -> None:
    """Checks that depth is in metres: near to a table's by the pose."""
    ratio = _depth_ratio(view, extent)
    power = round(np.log10(ratio))
    if power in _UNITS and abs(np.log10(ratio) - power) < 0.15:
        text = f"depth is {ratio:.3g} times what camera_pose says: it seems to be {_UNITS[power]}"
        raise ViewError(text)


def _depth_ratio(view: CameraView, extent: float) -> float:
    """Returns the median of measured over expected depth of the table in the workspace."""
    ray, depth = view.directions[view.sparse], view.depth[view.sparse]
    falling = ray[..., 2] < -1e-6
    expected = np.where(falling, -view.pose[2, 3] / np.where(falling, ray[..., 2], 1.0), 0.0)
    place = expected[..., None] * ray[..., :2] + view.pose[:2, 3]
    here = falling & (depth > 0.0) & np.all(np.abs(place) <= 0.5 * extent, axis=-1)
    if not here.any():
        raise ViewError("depth: all of the workspace is 0 or NaN; check the camera")
    return float(np.median(depth[here] / expected[here]))


def table(view: CameraView, extent: float) -> Table:
    """Finds the table under and around the workspace."""
    every, valid = view.points[view.sparse], view.valid[view.sparse]
    near = valid & np.all(np.abs(every[..., :2]) <= 0.5 * _AROUND * extent, axis=-1)
    points = every[near].astype(np.float64)
    plane = _largest_plane(points) if len(points) >= _LEAST else None
    if plane is None:
        ratio = _depth_ratio(view, extent)
        raise ViewError(
            "no table found where camera_pose says that the workspace is: depth there is "
            f"{ratio:.2f} times that of a table at z = 0; check the pose, and what stands in view"
        )
    return plane


def _largest_plane(points: np.ndarray) -> Table | None:
    """Fits the plane with most of the points [n, 3] m; None if no plane has enough.

    RANSAC, then twice least squares.
    """
    rng = np.random.default_rng(0)
    sample = points[rng.integers(len(points), size=_SAMPLE)]
    a, b, c = np.moveaxis(sample[rng.integers(_SAMPLE, size=(_TRIALS, 3))], 1, 0)
    normal = np.cross(b - a, c - a)
    level = np.abs(normal[:, 2]) > 1e-12
    slopes = -normal[:, :2] / np.where(level, normal[:, 2], 1.0)[:, None]
    level &= np.hypot(*slopes.T) < _STEEPEST
    heights = a[:, 2] - np.sum(slopes * a[:, :2], axis=1)
    off = np.abs(sample[:, 2] - heights[:, None] - slopes @ sample[:, :2].T)  # [trials, sample]
    best = int(np.argmax(np.where(level, np.sum(off < _INLIER, axis=1), -1)))
    plane = np.array([heights[best], *slopes[best]])
    basis = np.column_stack([np.ones(len(points)), points[:, :2]])
    for _ in range(2):
        on = np.abs(points[:, 2] - basis @ plane) < _INLIER
        if on.mean() < _LEAST_TABLE:
            return None
        plane = np.linalg.lstsq(basis[on], points[on, 2])[0]
    return Table(float(plane[0]), plane[1:], float(np.std(points[on, 2] - basis[on] @ plane)))


def table_height(table: Table, extent: float) -> None:
    """Checks that the table lies at z = 0."""
    if table.worst(extent) > TABLE_TOLERANCE:
        raise ViewError(
            f"the table lies {1e3 * table.height:+.0f} mm from z = 0, tilted by "
            f"{table.tilt_deg:.1f} degrees: {1e3 * table.worst(extent):.0f} mm at a corner of the "
            f"workspace, {1e3 * TABLE_TOLERANCE:.0f} are allowed; measure camera_pose again"
        )


def seen(view: CameraView, cfg: HeightmapConfig) -> tuple[np.ndarray, np.ndarray]:
    """Returns the table's cells [H, W] bool that lie in the image, and those with a depth there.

    Cells behind an object count as seen.
    """
    along = (np.arange(cfg.size) - 0.5 * (cfg.size - 1)) * cfg.cell
    x, y = np.meshgrid(along, along)
    pixel, inside = view.project(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))
    col, row = np.where(inside[:, None], np.round(pixel), 0).astype(int).T
    has_depth = ndimage.maximum_filter(view.valid, _WINDOW)[row, col] & inside
    return inside.reshape(x.shape), has_depth.reshape(x.shape)


def coverage(view: CameraView, cfg: HeightmapConfig) -> float:
    """Returns the seen share of the workspace, which must be enough."""
    inside, has_depth = seen(view, cfg)
    share = float(has_depth.mean())
    if share < SEEN_SHARE:
        side = (np.arange(cfg.size) - 0.5 * (cfg.size - 1)) * cfg.cell
        rows, cols = np.nonzero(~has_depth)
        x, y = (np.percentile(side[index], (2, 98)) for index in (cols, rows))
        cause = "has no depth" if inside[~has_depth].mean() > 0.5 else "is outside of the image"
        raise ViewError(
            f"{share:.0%} of the workspace is seen, {SEEN_SHARE:.0%} are needed: x {x[0]:+.2f} to "
            f"{x[1]:+.2f} m, y {y[0]:+.2f} to {y[1]:+.2f} m {cause}; move the camera"
        )
    return share


def colours(view: CameraView, extent: float) -> None:
    """Warns of objects with the colours of the training's blocks, red and blue swapped."""
    points, valid = view.points[view.sparse], view.valid[view.sparse]
    above = valid & (points[..., 2] > 0.02)
    above &= np.all(np.abs(points[..., :2]) <= 0.5 * extent, axis=-1)
    objects = view.colour[view.sparse][above].astype(np.float32)
    if len(objects) < _LEAST:
        return
    as_given, swapped = _hue_distance(objects), _hue_distance(objects[:, ::-1])
    if swapped < _SWAPPED * as_given:
        text = "rgb: red and blue seem to be swapped (OpenCV reads BGR); give rgb[..., ::-1]"
        warnings.warn(text, DataWarning, stacklevel=4)


def _hue_distance(colour: np.ndarray) -> float:
    """Returns the mean distance of colours [n, 3] to the nearest block's, without brightness."""
    shares, blocks = (c / np.maximum(c.sum(axis=1, keepdims=True), 1e-6) for c in (colour, COLOURS))
    return float(np.linalg.norm(shares[:, None] - blocks[None], axis=-1).min(axis=1).mean())
