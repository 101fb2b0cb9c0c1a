"""Checks that an image agrees with its camera's pose, with the table and with the workspace.

They raise ViewError, one line that says what is wrong by how much.
"""

import dataclasses

import numpy as np
from scipy import ndimage

from csac_jax.config import HeightmapConfig
from csac_jax.constants import CHANGE_AREA
from csac_jax.deploy import images
from csac_jax.deploy.images import CameraView
from csac_jax.errors import ViewError
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
_UNITS = {3: "millimetres", 2: "centimetres"}  # power of ten of measured over expected depth


@dataclasses.dataclass(frozen=True)
class Table:
    """The table under and around the workspace, by an image."""

    height_mm: float  # above z = 0, at the workspace's centre
    tilt_deg: float
    worst_mm: float  # largest distance from z = 0 in the workspace
    noise_mm: float  # standard deviation of the points on it


@dataclasses.dataclass(frozen=True)
class CameraReport(Table):
    """Measurements in an image of the empty table, which show if pose and intrinsics fit."""

    seen: float  # share of the workspace
    covered_cm2: float  # area higher than 1 cm, which an empty table has none of

    @property
    def faults(self) -> list[str]:
        """Lists what must be mended before decisions are taken, one line each."""
        faults = (
            (self.worst_mm > 1e3 * TABLE_TOLERANCE, "the table is not at z = 0: measure the pose"),
            (self.seen < SEEN_SHARE, "too little of the workspace is seen: move the camera"),
            (self.covered_cm2 > CHANGE_AREA, "the table is not empty, or its depth too noisy"),
        )
        return [fault for holds, fault in faults if holds]


def fits(view: CameraView, cfg: HeightmapConfig) -> list[str]:
    """Runs all checks; returns what is doubtful, one line each."""
    pose(view)
    depth_unit(view, cfg.extent)
    plane = table(view, cfg.extent)
    if plane.worst_mm > 1e3 * TABLE_TOLERANCE:
        raise ViewError(
            f"the table lies {plane.height_mm:+.0f} mm from z = 0, tilted by {plane.tilt_deg:.1f} "
            f"degrees: {plane.worst_mm:.0f} mm at a corner of the workspace, "
            f"{1e3 * TABLE_TOLERANCE:.0f} are allowed; measure camera_pose again"
        )
    _coverage(view, cfg)
    text = "rgb: red and blue seem to be swapped (OpenCV reads BGR); give rgb[..., ::-1]"
    return [text] if colours_swapped(view, cfg.extent) else []


def pose(view: CameraView) -> None:
    """Checks that the camera stands above the table and sees the workspace's centre."""
    pose, far = view.pose, np.linalg.norm(view.pose[:3, 3])
    if np.abs(pose[:3, 3]).max() > HIGHEST_POSE:
        raise ViewError(f"camera_pose: the camera is {far:.0f} m away; its unit is m")
    if _sees_centre(view, pose):
        return
    hint = "check it, x right, y down, z forward"
    if _sees_centre(view, np.linalg.inv(pose)):
        hint = "it seems to map workspace to camera; give its inverse"
    elif _sees_centre(view, pose @ np.diag([1.0, -1.0, -1.0, 1.0])):
        hint = "its axes seem to be OpenGL's; turn y and z round"
    raise ViewError(f"camera_pose: the workspace's centre is not in the image; {hint}")


def _sees_centre(view: CameraView, pose: np.ndarray) -> bool:
    _, inside = images.project(view.intrinsics, pose, np.zeros((1, 3)))
    return bool(inside[0] and pose[2, 3] > 0.0)


def depth_unit(view: CameraView, extent: float) -> None:
    """Checks that depth is in metres: near to a table's by the pose."""
    ratio = _depth_ratio(view, extent)
    power = round(min(np.log10(ratio), 99.0))  # it may be infinite
    if 1 <= abs(power) <= 3 and abs(np.log10(ratio) - power) < 0.15:
        raise ViewError(
            f"depth is {ratio:.3g} times what camera_pose says: it seems to be "
            f"{_UNITS.get(power, 'wrongly scaled')}; multiply it by {10.0**-power:g}"
        )


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
    if len(points) >= _LEAST and (plane := _largest_plane(points)):
        (height, x, y), noise = plane
        worst = abs(height) + 0.5 * extent * (abs(x) + abs(y))
        tilt_deg = np.degrees(np.arctan(np.hypot(x, y)))
        return Table(1e3 * height, float(tilt_deg), 1e3 * worst, 1e3 * noise)
    raise ViewError(
        "no table found where camera_pose says that the workspace is: depth there is "
        f"{_depth_ratio(view, extent):.2f} times that of a table at z = 0; check the pose, and "
        "what stands in view"
    )


def _largest_plane(points: np.ndarray) -> tuple[list[float], float] | None:
    """Fits the plane z = p0 + p1 x + p2 y with most of the points [n, 3] m, RANSAC, then twice
    least squares.

    Returns p and the standard deviation of the points on it; None if no plane has enough.
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
    return plane.tolist(), float(np.std(points[on, 2] - basis[on] @ plane))


def _cells(cfg: HeightmapConfig) -> tuple[np.ndarray, ...]:
    """Returns x and y [H, W] m of the cells' centres."""
    along = (np.arange(cfg.size) - 0.5 * (cfg.size - 1)) * cfg.cell
    return np.meshgrid(along, along)


def seen(view: CameraView, cfg: HeightmapConfig) -> tuple[np.ndarray, np.ndarray]:
    """Returns the table's cells [H, W] bool that lie in the image, and those with a depth there.

    Cells behind an object count as seen.
    """
    x, y = _cells(cfg)
    centres = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    pixel, inside = images.project(view.intrinsics, view.pose, centres)
    col, row = np.where(inside[:, None], np.round(pixel), 0).astype(int).T
    has_depth = ndimage.maximum_filter(view.valid, _WINDOW)[row, col] & inside
    return inside.reshape(x.shape), has_depth.reshape(x.shape)


def _coverage(view: CameraView, cfg: HeightmapConfig) -> None:
    """Checks that enough of the workspace is seen."""
    inside, has_depth = seen(view, cfg)
    if has_depth.mean() >= SEEN_SHARE:
        return
    x, y = (np.percentile(places[~has_depth], (2, 98)) for places in _cells(cfg))
    cause = "has no depth" if inside[~has_depth].mean() > 0.5 else "is outside of the image"
    raise ViewError(
        f"{has_depth.mean():.0%} of the workspace is seen, {SEEN_SHARE:.0%} are needed: x "
        f"{x[0]:+.2f} to {x[1]:+.2f} m, y {y[0]:+.2f} to {y[1]:+.2f} m {cause}; move the camera"
    )


def colours_swapped(view: CameraView, extent: float) -> bool:
    """Returns True if objects have the colours of the training's blocks, red and blue swapped."""
    points, valid = view.points[view.sparse], view.valid[view.sparse]
    above = valid & (points[..., 2] > 0.02)
    above &= np.all(np.abs(points[..., :2]) <= 0.5 * extent, axis=-1)
    objects = view.colour[view.sparse][above].astype(np.float32)
    if len(objects) < _LEAST:
        return False
    return _hue_distance(objects[:, ::-1]) < _SWAPPED * _hue_distance(objects)


def _hue_distance(colour: np.ndarray) -> float:
    """Returns the mean distance of colours [n, 3] to the nearest block's, without brightness."""
    shares, blocks = (c / np.maximum(c.sum(axis=1, keepdims=True), 1e-6) for c in (colour, COLOURS))
    return float(np.linalg.norm(shares[:, None] - blocks[None], axis=-1).min(axis=1).mean())
