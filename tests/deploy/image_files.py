"""An image as the files that `csac-jax act` reads."""

import json
import struct
import zlib
from pathlib import Path

import imageio.v2 as imageio
import numpy as np

from tests.deploy.scenes import Image


def rounded(image: Image) -> Image:
    """Returns the image with depths of whole millimetres, as a PNG holds them."""
    depth = np.round(1000 * np.nan_to_num(image.depth).clip(0, 60)) / 1000
    return image._replace(depth=depth.astype(np.float32))


def png_start(*sizes: tuple[int, int]) -> bytes:
    """Returns a PNG of 8-bit colours, cut off in its pixels, with a header per size."""
    heads = (struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0) for size in sizes)
    chunks = [*((b"IHDR", head) for head in heads), (b"IDAT", zlib.compress(bytes(100)))]
    parts = (
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def write(folder: Path, image: Image) -> list[str]:
    """Writes the files; returns the options that name them."""
    folder.mkdir(parents=True, exist_ok=True)
    depth = rounded(image).depth
    imageio.imwrite(folder / "rgb.png", image.rgb)
    imageio.imwrite(folder / "depth.png", np.round(1000 * depth).astype(np.uint16))
    np.save(folder / "depth.npy", depth)
    (folder / "intrinsics.json").write_text(json.dumps(image.intrinsics))
    (folder / "pose.json").write_text(json.dumps({"matrix": image.pose.tolist()}))
    files = ("rgb.png", "depth.png", "intrinsics.json", "pose.json")
    return [part for name in files for part in (f"--{name.split('.')[0]}", str(folder / name))]
