"""An image as a depth camera gives it, drawn by our own rays: to try `csac-jax act` without one.

python examples/08_camera_image.py demo          # rgb.png, depth.png, intrinsics.json, pose.json
                                              # and request.json, all of them for `csac-jax serve`
python examples/08_camera_image.py empty --empty # the same camera over the empty table
python examples/08_camera_image.py board --board board.png  # the table with a printed page on it
"""

import base64
import json
import sys
from pathlib import Path

import imageio.v2 as imageio
import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from csac_jax import geometry
from csac_jax.config import CameraConfig
from csac_jax.vision import camera, observe, raycast
from csac_jax.world import blocks

POSES = ((0.10, 0.09, 0.4), (-0.10, -0.02, 1.0), (0.05, -0.12, 2.0))  # x m, y m, yaw rad
HALF = (0.05, 0.025, 0.025)  # m, half sizes of a block
DOTS = 300 / 0.0254  # of a printed page, per metre
COARSE = 8  # dots along each side of what the camera tells apart
AWAY = 3.0  # m, where the blocks lie if the table is to be empty


def draw(cfg: CameraConfig, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Draws colour [h, w, 3] uint8 and depth [h, w] uint16 mm, 0 where the camera sees no table."""
    x, y, yaw = np.array(POSES, np.float32).T
    half = jnp.broadcast_to(jnp.array(HALF), (len(POSES), 3))
    normal, offset = blocks.half_spaces(("box",) * len(POSES), half)
    position = jnp.array(np.stack([x + shift, y, np.full_like(x, HALF[2])], axis=1))
    turned = jax.vmap(lambda a: geometry.quat_to_matrix(geometry.quat_from_yaw(a)))(jnp.array(yaw))
    palette = jnp.array(blocks.COLOURS[: len(POSES)])
    shapes = raycast.Polytopes(normal, offset, position, turned, palette)
    hits = camera.cast_rays(camera.make(cfg), raycast.cast_polytopes, shapes)
    lit = observe.surface_tables(shapes, jnp.ones(len(POSES), bool)).colour
    colour = np.where(hits.valid[..., None], np.asarray(lit)[hits.surface], 0.0)
    depth = np.where(hits.valid, hits.distance, 0.0)
    return np.round(255 * colour).astype(np.uint8), np.round(1000 * depth).astype(np.uint16)


def lay(cfg: CameraConfig, colour: np.ndarray, page: np.ndarray) -> np.ndarray:
    """Draws a page [rows, columns] uint8 into the image, on the empty table around the origin."""
    rows, cols = (side // COARSE for side in page.shape)
    ink = page[: rows * COARSE, : cols * COARSE].reshape(rows, COARSE, cols, COARSE).mean((1, 3))
    eye = camera.make(cfg)
    start, ahead = (
        np.asarray(eye.position),
        np.asarray(camera.points(eye, jnp.ones(cfg.size[::-1]))),
    )
    rays = ahead - start
    x, y, _ = np.moveaxis(start - rays * (start[2] / np.minimum(rays[..., 2:], -1e-3)), -1, 0)
    col, row = x * DOTS / COARSE + 0.5 * (cols - 1), 0.5 * (rows - 1) - y * DOTS / COARSE
    grey = ndimage.map_coordinates(ink, [row, col], order=1, cval=-1.0)
    return np.where(grey[..., None] >= 0.0, grey[..., None], colour).astype(np.uint8)


def main(folder: str, *options: str) -> None:
    """Writes the files."""
    cfg, out = CameraConfig(), Path(folder)
    eye, pose = camera.make(cfg), np.eye(4)
    pose[:3, :3], pose[:3, 3] = eye.rotation, eye.position
    names = ("width", "height", "fx", "fy", "cx", "cy")
    intrinsics = dict(zip(names, (*cfg.size, *cfg.focal, *cfg.centre), strict=True))
    out.mkdir(parents=True, exist_ok=True)
    colour, depth = draw(cfg, AWAY if options else 0.0)
    if "--board" in options:
        page = imageio.imread(options[options.index("--board") + 1])
        colour = lay(cfg, colour, page)
    imageio.imwrite(out / "rgb.png", colour)
    imageio.imwrite(out / "depth.png", depth)
    (out / "intrinsics.json").write_text(json.dumps(intrinsics))
    (out / "pose.json").write_text(json.dumps({"matrix": pose.tolist()}))
    images = {name: (out / f"{name}.png").read_bytes() for name in ("rgb", "depth")}
    request = {name: base64.b64encode(content).decode() for name, content in images.items()}
    request |= {"intrinsics": intrinsics, "pose": {"matrix": pose.tolist()}}
    (out / "request.json").write_text(json.dumps(request))


if __name__ == "__main__":
    if not sys.argv[1:] or sys.argv[1].startswith("-"):
        print(__doc__)
        sys.exit(sys.argv[1:] not in (["-h"], ["--help"]))
    main(*sys.argv[1:])
