"""Images of scenes by our own rays, as a depth camera would give them."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry
from csac_jax.config import CameraConfig
from csac_jax.vision import camera, observe, raycast
from csac_jax.vision.raycast import Polytopes
from csac_jax.world import blocks

CAMERA = CameraConfig()
HALF = np.array([0.05, 0.025, 0.025])  # of the blocks, m
MOST = 4  # blocks of most images


class Image(NamedTuple):
    """The arguments of `CameraPolicy.decide`."""

    rgb: np.ndarray  # [h, w, 3] uint8
    depth: np.ndarray  # [h, w] float32 m
    intrinsics: dict[str, Any]
    pose: np.ndarray  # [4, 4]


def blocks_at(poses: Any, half_size: Any = HALF, colours: Any = None) -> Polytopes:
    """Places boxes at poses [N, 3] m, m, rad; half_size [3] or [N, 3] m; colours [N]."""
    poses = np.array(poses, np.float32).reshape(-1, 3)
    half = np.broadcast_to(half_size, (len(poses), 3)).astype(np.float32)
    chosen = np.arange(len(poses)) if colours is None else np.array(colours)
    palette = jnp.asarray(blocks.COLOURS)[chosen % len(blocks.COLOURS)]
    return _placed(poses, half, palette)


@jax.jit
def _placed(poses: jax.Array, half: jax.Array, palette: jax.Array) -> Polytopes:
    normal, offset = blocks.half_spaces(("box",) * len(poses), half)
    position = jnp.column_stack([poses[:, :2], half[:, 2]])
    turn = jax.vmap(lambda yaw: geometry.quat_to_matrix(geometry.quat_from_yaw(yaw)))
    return Polytopes(normal, offset, position, turn(poses[:, 2]), palette)


def pose_of(cfg: CameraConfig = CAMERA) -> np.ndarray:
    """Returns the camera's pose [4, 4] in the workspace."""
    eye, pose = camera.make(cfg), np.eye(4)
    pose[:3, :3], pose[:3, 3] = eye.rotation, eye.position
    return pose


@functools.partial(jax.jit, static_argnums=1)
def _rendered(shapes: Polytopes, cfg: CameraConfig) -> Any:
    eye = camera.make(cfg)
    hits = camera.cast_rays(eye, raycast.cast_polytopes, shapes)
    lit = observe.surface_tables(shapes, jnp.ones(len(shapes.offset), bool)).colour
    return hits.distance, hits.surface, hits.valid, lit


def take(shapes: Polytopes, cfg: CameraConfig = CAMERA) -> Image:
    """Renders blocks on the table; depth is NaN where the camera sees the horizon."""
    most = max(MOST, len(shapes.offset))  # the last block several times: one program for all
    padded = jax.tree.map(lambda leaf: leaf[np.arange(most).clip(max=len(leaf) - 1)], shapes)
    distance, surface, valid, lit = jax.device_get(_rendered(padded, cfg))
    rgb = np.round(255 * np.where(valid[..., None], lit[surface], 0.0)).astype(np.uint8)
    depth = np.where(valid, distance, np.nan).astype(np.float32)
    names = ("width", "height", "fx", "fy", "cx", "cy")
    intrinsics = dict(zip(names, (*cfg.size, *cfg.focal, *cfg.centre), strict=True))
    return Image(rgb, depth, intrinsics, pose_of(cfg))


def random_poses(rng: np.random.Generator, num: int) -> np.ndarray:
    """Draws poses [num, 3] of blocks that do not overlap, in the inner half of the workspace."""
    poses = np.zeros((0, 3))
    while len(poses) < num:
        new = rng.uniform([-0.15, -0.15, 0.0], [0.15, 0.15, np.pi])
        if np.all(np.linalg.norm(poses[:, :2] - new[:2], axis=1) > 0.115):
            poses = np.concatenate([poses, new[None]])
    return poses
