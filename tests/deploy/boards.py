"""Images of a printed board at poses that are known, by our own rays."""

import dataclasses

import numpy as np
from scipy import ndimage

from csac_jax.deploy import images
from csac_jax.deploy.board import DPI, Board

INCH = 0.0254  # m
LENS = images.Intrinsics(640, 480, 615.0, 612.0, 322.0, 241.0)
DISTORTED = dataclasses.replace(LENS, distortion=(-0.35, 0.1, 0.002, -0.004, 0.0))
FINE = 2  # rays along each side of a pixel


def take(board: Board, pose: np.ndarray, lens: images.Intrinsics = LENS) -> np.ndarray:
    """Returns the image [h, w, 3] uint8 of a printed board at `pose` [4, 4], board to camera."""
    page = ndimage.gaussian_filter(board.picture().astype(np.float64), 2.0)  # no print is sharper
    big = images.Intrinsics(
        *(FINE * lens.width, FINE * lens.height, FINE * lens.fx, FINE * lens.fy),
        *(FINE * (lens.cx + 0.5) - 0.5, FINE * (lens.cy + 0.5) - 0.5),
        lens.distortion,
    )
    rays = images.rays(big).astype(np.float64) @ pose[:3, :3]  # in the board's axes
    eye = -pose[:3, :3].T @ pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = np.moveaxis((eye + rays * (-eye[2] / rays[..., 2:]))[..., :2], -1, 0)
    rows, cols = page.shape
    col, row = x / INCH * DPI + 0.5 * (cols - 1), 0.5 * (rows - 1) - y / INCH * DPI
    grey = ndimage.map_coordinates(page, [row, col], order=1, cval=120.0)
    small = grey.reshape(lens.height, FINE, lens.width, FINE).mean(axis=(1, 3))
    return np.repeat(np.round(small)[..., None], 3, axis=-1).astype(np.uint8)
