"""The walls of the tray, `scene.tray`: four boxes about its square. Needs no MuJoCo."""

import numpy as np

from csac_jax.config import TRAY_WALL

COLOUR = np.array([0.55, 0.48, 0.40], np.float32)  # red, green, blue in 0 .. 1
NUMBER = 4


def walls(side: float) -> tuple[np.ndarray, np.ndarray]:
    """Computes centres and half sizes [4, 3] m of the walls of a tray of inner `side` m."""
    half, thick, high = 0.5 * side, 0.5 * TRAY_WALL[0], 0.5 * TRAY_WALL[1]
    out, along = half + thick, half + 2.0 * thick  # two walls reach round the corners
    centre = np.array([[-out, 0, high], [out, 0, high], [0, -out, high], [0, out, high]])
    size = np.array([[thick, along, high]] * 2 + [[half, thick, high]] * 2)
    return centre.astype(np.float32), size.astype(np.float32)


def heights(side: float, xy: np.ndarray, margin: float) -> np.ndarray:
    """Computes the height [...] m of the walls at places `xy` [..., 2] m; 0 beside them.

    Walls count as wider by `margin` m on either side.
    """
    out = np.abs(xy).max(axis=-1) - 0.5 * side  # m beyond the inner faces
    is_wall = (out >= -margin) & (out <= TRAY_WALL[0] + margin)
    return np.where(is_wall & (side > 0.0), np.float32(TRAY_WALL[1]), np.float32(0.0))
