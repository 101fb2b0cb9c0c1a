"""A contact sheet of objects: each by itself, with its name and size."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from csac_jax.objects.body import Object
from csac_jax.render import heatmaps, media
from csac_jax.vision import camera
from csac_jax.world import blocks

MOST = 120  # objects on a sheet
_COLUMNS, _INCHES, _DOTS = 8, 1.5, 90
_TITLE = 0.33  # inches above a row, for name and size


def write(path: Path, objects: Sequence[Object]) -> None:
    """Draws at most MOST objects at one scale and writes the picture."""
    shown = objects[:MOST]
    columns = min(len(shown), _COLUMNS)
    rows = math.ceil(len(shown) / columns)
    height = (_INCHES + _TITLE) * rows
    figure = Figure(figsize=(_INCHES * columns, height), dpi=_DOTS)
    reach = 0.4 * max(float(np.ptp(member.bounds, axis=0).max()) for member in shown)
    for number, member in enumerate(shown):
        axes = figure.add_subplot(rows, columns, number + 1, projection="3d")
        _draw(axes, member, reach, blocks.COLOURS[number % len(blocks.COLOURS)])
    figure.subplots_adjust(0.0, 0.0, 1.0, 1.0 - _TITLE / height, 0.0, _TITLE / _INCHES)
    media.write_picture(path, heatmaps.pixels(figure))


def _draw(axes: Any, member: Object, reach: float, colour: np.ndarray) -> None:
    middle = member.bounds.mean(axis=0)
    corners = [part.vertices[part.triangles] - middle for part in member.parts]
    triangles = np.concatenate(corners)  # [T, 3, 3]
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    lit = camera.shade(jnp.asarray(colour[None]), jnp.asarray(normal))
    faces = np.clip(np.asarray(lit), 0.0, 1.0)
    axes.add_collection3d(Poly3DCollection(triangles, facecolors=faces))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(-reach, reach))
    axes.set_box_aspect((1, 1, 1))
    axes.set_axis_off()
    size = " x ".join(f"{1e3 * side:.0f}" for side in np.ptp(member.bounds, axis=0))
    axes.set_title(f"{member.name[:24]}\n{size} mm", fontsize=6)
