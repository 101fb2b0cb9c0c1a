"""The image of a depth camera, checked: colour, depth, intrinsics and a pose; and its points.

The camera's axes are OpenCV's: x right, y down, z forward. Pixel centres are whole numbers, depth
is along z. A pose `T_workspace_camera` maps camera to workspace. h, w = rows and columns, px.
"""

import dataclasses
import functools
from typing import Annotated, Any

import numpy as np
import pydantic
import pydantic.dataclasses

from csac_jax.errors import SettingsError, first_fault
from csac_jax.section import require

MOST_PIXELS = 4096  # of a side
_ROUNDS = 20  # at most, of the iteration that removes distortion, OpenCV's undistortPoints
_EXACT = 1e-4  # px, an error at which it ends
_STRIP = 16  # rows at a time, which fit into a processor's cache
_RIGID = 1e-3  # largest error of a rotation matrix's products


def _flat(values: Any) -> tuple[Any, ...]:
    return () if values is None else tuple(np.ravel(values).tolist())


_Pixels = Annotated[int, pydantic.Field(strict=True, ge=16, le=MOST_PIXELS)]
_Number = Annotated[float, pydantic.Field(strict=True, allow_inf_nan=False)]
_Positive = Annotated[_Number, pydantic.Field(gt=0.0)]


@pydantic.dataclasses.dataclass(frozen=True, config={"extra": "forbid"})
class Intrinsics:
    """A pinhole camera."""

    width: _Pixels
    height: _Pixels
    fx: _Positive  # px
    fy: _Positive  # px
    cx: _Number  # px, from the left
    cy: _Number  # px, from the top
    distortion: Annotated[tuple[_Number, ...], pydantic.BeforeValidator(_flat)] = ()  # OpenCV's

    def __post_init__(self) -> None:
        if len(self.distortion) not in (0, 4, 5):
            raise ValueError("distortion must have 4 or 5 numbers, k1 k2 p1 p2 k3")
        if not (0.0 <= self.cx <= self.width and 0.0 <= self.cy <= self.height):
            raise ValueError("cx and cy must lie in the image, in pixels")

    @classmethod
    def of(cls, values: Any) -> "Intrinsics":
        """Returns intrinsics, or those of a mapping. Raises SettingsError for bad ones."""
        try:
            return pydantic.TypeAdapter(cls).validate_python(values)
        except pydantic.ValidationError as error:
            raise SettingsError(f"intrinsics: {first_fault(error)}") from None

    @property
    def shape(self) -> tuple[int, int]:
        """Returns rows and columns of the image."""
        return self.height, self.width


def distort(intrinsics: Intrinsics, xy: np.ndarray) -> np.ndarray:
    """Moves ideal image points `xy` [..., 2] at depth 1 as OpenCV's lens (Brown's model)."""
    k1, k2, p1, p2, k3 = np.pad(np.array(intrinsics.distortion), (0, 5))[:5]
    x, y = xy[..., 0], xy[..., 1]
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    along = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
    down = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([along, down], axis=-1)


@functools.lru_cache(maxsize=4)
def rays(intrinsics: Intrinsics) -> np.ndarray:
    """Returns the directions [h, w, 3] float32 of all pixels in the camera's frame, 1 m deep.

    Raises SettingsError for a distortion that has no inverse over the image.
    """
    u, v = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    ideal = np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32)
    if any(intrinsics.distortion):
        for row in range(0, intrinsics.height, _STRIP):
            seen = np.stack([x[row : row + _STRIP], y[row : row + _STRIP]], axis=-1)
            ideal[row : row + _STRIP, :, :2] = _undistort(intrinsics, seen)
    return ideal


def _undistort(intrinsics: Intrinsics, distorted: np.ndarray) -> np.ndarray:
    """Inverts `distort`. Raises SettingsError if it has no inverse there."""
    ideal, error = distorted, np.inf
    with np.errstate(all="ignore"):  # it may diverge
        for _ in range(_ROUNDS):
            step = distorted - distort(intrinsics, ideal)
            ideal, error = ideal + step, np.abs(step).max() * intrinsics.fx
            if error < _EXACT:
                break
    fault = "intrinsics.distortion: has no inverse over the image; rectify it"
    require(bool(error < 0.1), fault)
    return ideal


def finite(values: Any) -> np.ndarray:
    """Converts to float64; returns an empty array unless all are finite numbers."""
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError):
        return np.empty(0)
    return array if np.isfinite(array).all() else np.empty(0)


def rigid(matrix: Any, name: str) -> np.ndarray:
    """Converts a matrix to a pose [4, 4] float64. Raises SettingsError if it is not rigid."""
    pose = finite(matrix)
    require(pose.shape == (4, 4), f"{name}: must be a 4 x 4 matrix of finite numbers")
    rotation = pose[:3, :3]
    square = np.abs(rotation @ rotation.T - np.eye(3)).max() < _RIGID
    is_rigid = square and np.linalg.det(rotation) >= 0.0 and np.all(pose[3] == [0, 0, 0, 1])
    form = "a rotation and a translation in m, last row 0 0 0 1"
    require(bool(is_rigid), f"{name}: must be {form}; it may be transposed, scaled or mirrored")
    return pose


@functools.lru_cache(maxsize=4)
def _rotated_rays(intrinsics: Intrinsics, rotation: bytes) -> np.ndarray:
    """Rotates `rays` by a matrix [3, 3] float64; cached, as cameras seldom move."""
    right, down, forward = np.frombuffer(rotation).reshape(3, 3).T.astype(np.float32)
    ideal = rays(intrinsics)
    return ideal[..., :1] * right + ideal[..., 1:2] * down + forward


@dataclasses.dataclass(frozen=True, eq=False)
class CameraView:
    """One image of a scene; see `make`."""

    colour: np.ndarray  # [h, w, 3] uint8, red green blue
    depth: np.ndarray  # [h, w] float32 m; 0 where not valid
    valid: np.ndarray  # [h, w] bool, there is a depth
    target: np.ndarray | None  # [h, w] bool, pixels of the object to get
    intrinsics: Intrinsics
    pose: np.ndarray  # [4, 4] T_workspace_camera

    @functools.cached_property
    def directions(self) -> np.ndarray:
        """Returns the pixels' rays [h, w, 3] float32 in the workspace's frame, 1 m deep."""
        return _rotated_rays(self.intrinsics, self.pose[:3, :3].tobytes())

    @functools.cached_property
    def points(self) -> np.ndarray:
        """Returns the pixels' points [h, w, 3] float32 m in the workspace's frame."""
        return self.depth[..., None] * self.directions + self.pose[:3, 3].astype(np.float32)

    @property
    def sparse(self) -> tuple[slice, slice]:
        """Returns rows and columns of some 20,000 pixels all over the image, for measurements."""
        return (slice(None, None, max(1, int(np.sqrt(self.depth.size / 20_000)))),) * 2


def project(
    intrinsics: Intrinsics, pose: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Projects points [n, 3] m of the workspace to a camera at `pose`.

    Returns column and row [n, 2] px, and [n] bool, True inside the image.
    """
    x, y, depth = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    ahead = depth > 1e-3
    ideal = np.stack([x, y], axis=1) / np.where(ahead, depth, 1.0)[:, None]
    edge = rays(intrinsics)[[0, 0, -1, -1], [0, -1, 0, -1], :2]  # distortion folds beyond the image
    near = np.sum(ideal**2, axis=1) <= 1.1 * np.max(np.sum(edge**2, axis=1))
    scale, centre = (intrinsics.fx, intrinsics.fy), (intrinsics.cx, intrinsics.cy)
    pixel = distort(intrinsics, ideal) * scale + centre
    size = np.array([intrinsics.width, intrinsics.height])
    inside = np.all((pixel >= -0.5) & (pixel < size - 0.5), axis=1)
    return pixel, ahead & near & inside


def make(
    rgb: Any, depth: Any, intrinsics: Any, camera_pose: Any, target_mask: Any = None
) -> CameraView:
    """Makes a view of the arguments of `CameraPolicy.decide`. Raises SettingsError for bad ones."""
    camera, pose = Intrinsics.of(intrinsics), rigid(camera_pose, "camera_pose")
    colour, metres = _colour(np.asarray(rgb)), _depth(np.asarray(depth))
    target = None if target_mask is None else _mask(np.asarray(target_mask))
    arrays = {"rgb": colour, "depth": metres, "target_mask": target, "intrinsics": camera}
    sizes = {name: array.shape[:2] for name, array in arrays.items() if array is not None}
    shown = ", ".join(f"{name} {cols} x {rows}" for name, (rows, cols) in sizes.items())
    require(len(set(sizes.values())) == 1, f"{shown}: align them to one camera and one size")
    valid = np.isfinite(metres) & (metres > 0.0)
    metres = np.where(valid, metres, 0.0).astype(np.float32)
    return CameraView(colour, metres, valid, target, camera, pose)


def _colour(rgb: np.ndarray) -> np.ndarray:
    hint = "; leave out its alpha: rgb[..., :3]" if rgb.shape[2:] == (4,) else ""
    shape = f"rgb: must have shape [rows, columns, 3], not {list(rgb.shape)}{hint}"
    require(rgb.shape[2:] == (3,), shape)
    require(rgb.dtype == np.uint8, f"rgb: is {rgb.dtype}; give 0 to 255 as uint8, red first")
    return rgb


def _depth(depth: np.ndarray) -> np.ndarray:
    require(depth.ndim == 2, f"depth: must have shape [rows, columns], not {list(depth.shape)}")
    remedy = "give metres as float: depth * 0.001 for millimetres"
    require(depth.dtype.kind == "f", f"depth: is {depth.dtype}, which has no unit; {remedy}")
    return depth


def _mask(mask: np.ndarray) -> np.ndarray:
    fits = mask.ndim == 2 and mask.dtype.kind in "bu"
    require(fits, "target_mask: must be bool or whole numbers [rows, columns]")
    require(bool(mask.any()), "target_mask: marks no pixel; mark the object, or leave the mask out")
    return mask != 0
