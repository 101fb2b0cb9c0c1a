"""Images, intrinsics and poses as files. Each function raises SettingsError, one line."""

import contextlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import imageio.v2
import imageio.v3
import numpy as np
import pydantic

from csac_jax.deploy import images
from csac_jax.deploy.images import Intrinsics
from csac_jax.errors import SettingsError, first_fault
from csac_jax.io import files
from csac_jax.section import require

_FOUR = {"type": "array", "minItems": 4, "maxItems": 4}
_MATRIX = pydantic.WithJsonSchema({**_FOUR, "items": {**_FOUR, "items": {"type": "number"}}})


class PoseBody(pydantic.BaseModel, extra="forbid"):
    """A pose as its file has it, m."""

    matrix: Annotated[list[list[float]], _MATRIX]  # 4 x 4


def read_rgb(path: Path) -> np.ndarray:
    """Reads a colour image [h, w, 3] uint8, of any format that keeps red first, such as PNG."""
    return _read(path, decode)


def read_depth(path: Path) -> np.ndarray:
    """Reads depth [h, w] float32 m: a PNG of 16 bits in mm, or an .npy of floats in m."""
    if path.suffix != ".npy":
        return _read(path, lambda content: metres(decode(content)))
    depth: np.ndarray = _read(path, _array)
    fault = f"{path}: is {depth.dtype}; an .npy file holds metres as float32"
    require(depth.dtype.kind == "f", fault)
    return depth


def read_mask(path: Path) -> np.ndarray:
    """Reads a mask [h, w] bool, True where an image or an .npy is not 0."""
    mask: np.ndarray = _read(path, _array if path.suffix == ".npy" else decode)
    require(mask.ndim == 2, f"{path}: a mask has one channel, not shape {list(mask.shape)}")
    return mask != 0


def read_intrinsics(path: Path) -> Intrinsics:
    """Reads {"width", "height", "fx", "fy", "cx", "cy", "distortion"?} in px, OpenCV's order."""
    return _read(path, lambda content: Intrinsics.of(files.parse(content, "content")))


def read_pose(path: Path) -> np.ndarray:
    """Reads {"matrix": 4 x 4 rows}, m."""
    return images.rigid(read_json(path, PoseBody).matrix, f"{path}: matrix")


def read_image(
    rgb: Path, depth: Path, intrinsics: Path, pose: Path
) -> tuple[np.ndarray, np.ndarray, Intrinsics, np.ndarray]:
    """Reads the first four arguments of `CameraPolicy.decide`, each from its file."""
    return read_rgb(rgb), read_depth(depth), read_intrinsics(intrinsics), read_pose(pose)


def read_json(path: Path, kind: Any) -> Any:
    """Reads JSON as a model or another type; errors name the key."""
    return _read(path, pydantic.TypeAdapter(kind).validate_json)


def metres(depth: np.ndarray) -> np.ndarray:
    """Converts depth of an image of 16 bits, in mm, to float32 m."""
    fits = depth.dtype.itemsize >= 2 and depth.dtype.kind in "iu"
    require(fits, f"depth: is {depth.dtype}; give a PNG of 16 bits, in mm, or metres")
    return (1e-3 * depth).astype(np.float32)


def decode(content: bytes) -> np.ndarray:
    """Decodes the pixels of an image file's content. Raises SettingsError."""
    with _opened(content) as file:
        cols, rows = _size(file)
        fits = max(cols, rows) <= images.MOST_PIXELS
        require(fits, f"the image has {cols} x {rows} px; at most {images.MOST_PIXELS} a side")
        return file.read(index=0)


def size(content: bytes) -> tuple[int, int]:
    """Returns width and height, px, of what `decode` would decode. Raises SettingsError."""
    with _opened(content) as file:
        return _size(file)


@contextlib.contextmanager
def _opened(content: bytes) -> Iterator[Any]:
    """Opens an image, whose pixels are decoded as they are read."""
    try:
        with imageio.v3.imopen(content, "r", plugin="pillow") as file:
            yield file
    except SettingsError:
        raise
    except Exception as error:  # damaged images raise nearly anything
        raise SettingsError(f"the image is damaged or huge: {files.first_line(error)}") from None


def _size(file: Any) -> tuple[int, int]:
    """Returns width and height as the decoder takes them: a PNG's header may occur twice."""
    rows, cols = file.properties(index=0).shape[:2]
    return cols, rows


def encode(pixels: np.ndarray, dots_per_inch: int = 72) -> bytes:
    """Encodes pixels [h, w] or [h, w, 3] uint8 as a PNG."""
    buffer = io.BytesIO()
    imageio.v2.imwrite(buffer, pixels, format="png", dpi=(dots_per_inch, dots_per_inch))
    return buffer.getvalue()


def _array(content: bytes) -> np.ndarray:
    return np.load(io.BytesIO(content), allow_pickle=False)


def _read(path: Path, convert: Callable[[bytes], Any]) -> Any:
    """Reads a file and converts its content; errors name the file."""
    try:
        return convert(files.read_bytes(path))
    except FileNotFoundError:
        raise SettingsError(f"there is no file {path}") from None
    except Exception as error:  # damaged files raise nearly anything
        known = isinstance(error, pydantic.ValidationError)
        reason = first_fault(error) if known else files.first_line(error)
        raise SettingsError(f"{path}: {reason}") from None
