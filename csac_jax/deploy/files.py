"""Images, intrinsics and poses as files. Each function raises SettingsError, one line."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np

from csac_jax.deploy import images
from csac_jax.deploy.images import Intrinsics
from csac_jax.errors import SettingsError
from csac_jax.io import files


def read_rgb(path: Path) -> np.ndarray:
    """A colour image [h, w, 3] uint8, of any format that keeps red first, such as PNG."""
    return _image(path)


def read_depth(path: Path) -> np.ndarray:
    """Depth [h, w] float32 m: a PNG of 16 bits in mm, or an .npy of floats in m."""
    if path.suffix == ".npy":
        depth = _array(path)
        if depth.dtype.kind != "f":
            raise SettingsError(f"{path}: is {depth.dtype}; an .npy file holds metres as float32")
        return depth
    return metres(_image(path), str(path))


def read_mask(path: Path) -> np.ndarray:
    """A mask [h, w] bool, True where an image or an .npy is not 0."""
    mask = _array(path) if path.suffix == ".npy" else _image(path)
    if mask.ndim != 2:
        raise SettingsError(f"{path}: a mask has one channel, not shape {list(mask.shape)}")
    return mask != 0


def read_intrinsics(path: Path) -> Intrinsics:
    """{"width", "height", "fx", "fy", "cx", "cy", "distortion"?} in px, OpenCV's order."""
    return _of(path, Intrinsics.of, files.read_object)


def read_pose(path: Path) -> np.ndarray:
    """{"matrix": 4 x 4 rows}, m."""

    def matrix(values: dict[str, Any]) -> np.ndarray:
        if set(values) != {"matrix"}:
            raise SettingsError('give {"matrix": [[4 numbers], 4 times]}')
        return images.rigid(values["matrix"], "matrix")

    return _of(path, matrix, files.read_object)


def metres(depth: np.ndarray, name: str) -> np.ndarray:
    """Depth of an image of 16 bits, in mm, as float32 m."""
    if depth.dtype.itemsize < 2 or depth.dtype.kind not in "iu":
        raise SettingsError(f"{name}: is {depth.dtype}; give a PNG of 16 bits, in mm, or metres")
    return (1e-3 * depth).astype(np.float32)


def decode(content: bytes) -> np.ndarray:
    """The pixels of an image file's content. Raises SettingsError."""
    try:
        return imageio.imread(content)
    except Exception as error:  # damaged images raise nearly anything
        raise SettingsError(f"the image is damaged: {files.first_line(error)}") from None


def encode(pixels: np.ndarray, dots_per_inch: int = 72) -> bytes:
    """A PNG of pixels [h, w] or [h, w, 3] uint8."""
    buffer = io.BytesIO()
    imageio.imwrite(buffer, pixels, format="png", dpi=(dots_per_inch, dots_per_inch))
    return buffer.getvalue()


def encode_array(values: np.ndarray) -> bytes:
    """An .npy file's content."""
    buffer = io.BytesIO()
    np.save(buffer, values, allow_pickle=False)
    return buffer.getvalue()


def _image(path: Path) -> np.ndarray:
    return _of(path, decode, files.read_bytes)


def _array(path: Path) -> np.ndarray:
    return _of(path, lambda name: np.load(name, allow_pickle=False), lambda name: name)


def _of(path: Path, make: Callable[[Any], Any], read: Callable[[Path], Any]) -> Any:
    """What `make` makes of what is read from a file; errors name it."""
    try:
        return make(read(path))
    except FileNotFoundError:
        raise SettingsError(f"there is no file {path}") from None
    except Exception as error:  # damaged images raise nearly anything
        raise SettingsError(f"{path}: {files.first_line(error)}") from None
