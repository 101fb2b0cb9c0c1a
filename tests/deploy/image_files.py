"""An image as the files that `csac-jax act` reads."""

import io
import json
from pathlib import Path

import imageio.v2 as imageio
import numpy as np

from tests.deploy.scenes import Image


def png(pixels: np.ndarray) -> bytes:
    """Encodes an image."""
    buffer = io.BytesIO()
    imageio.imwrite(buffer, pixels, format="png")
    return buffer.getvalue()


def rounded(image: Image) -> Image:
    """Returns the image with depths of whole millimetres, as a PNG holds them."""
    depth = np.round(1000 * np.nan_to_num(image.depth).clip(0, 60)) / 1000
    return image._replace(depth=depth.astype(np.float32))


def write(folder: Path, image: Image) -> list[str]:
    """Writes the files; returns the options that name them."""
    folder.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(folder / "rgb.png", image.rgb)
    millimetres = np.round(1000 * rounded(image).depth).astype(np.uint16)
    imageio.imwrite(folder / "depth.png", millimetres)
    np.save(folder / "depth.npy", rounded(image).depth)
    (folder / "intrinsics.json").write_text(json.dumps(image.intrinsics))
    (folder / "pose.json").write_text(json.dumps({"matrix": image.pose.tolist()}))
    files = {"rgb": "rgb.png", "depth": "depth.png"}
    files |= {name: f"{name}.json" for name in ("intrinsics", "pose")}
    return [part for name, file in files.items() for part in (f"--{name}", str(folder / file))]
