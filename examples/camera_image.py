"""An image as a depth camera gives it, drawn by our own rays: to try `csac-jax act` without one.

python examples/camera_image.py demo          # rgb.png, depth.png, intrinsics.json, pose.json
python examples/camera_image.py empty --empty # the same camera over the empty table
"""

import json
import sys
from pathlib import Path

import imageio.v2 as imageio
import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.config import CameraConfig
from csac_jax.scene import blocks
from csac_jax.vision import camera, observe, raycast

POSES = ((0.10, 0.09, 0.4), (-0.10, -0.02, 1.0), (0.05, -0.12, 2.0))  # x m, y m, yaw rad
HALF = (0.05, 0.025, 0.025)  # m, half sizes of a block
AWAY = 3.0  # m, where the blocks lie if the table is to be empty


def draw(cfg: CameraConfig, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Colour [h, w, 3] uint8 and depth [h, w] uint16 mm, 0 where the camera sees no table."""
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


def main(folder: str, *options: str) -> None:
    """Writes the four files."""
    cfg, out = CameraConfig(), Path(folder)
    eye, pose = camera.make(cfg), np.eye(4)
    pose[:3, :3], pose[:3, 3] = eye.rotation, eye.position
    names = ("width", "height", "fx", "fy", "cx", "cy")
    intrinsics = dict(zip(names, (*cfg.size, *cfg.focal, *cfg.centre), strict=True))
    out.mkdir(parents=True, exist_ok=True)
    colour, depth = draw(cfg, AWAY if "--empty" in options else 0.0)
    imageio.imwrite(out / "rgb.png", colour)
    imageio.imwrite(out / "depth.png", depth)
    (out / "intrinsics.json").write_text(json.dumps(intrinsics))
    (out / "pose.json").write_text(json.dumps({"matrix": pose.tolist()}))


if __name__ == "__main__":
    main(*sys.argv[1:])
