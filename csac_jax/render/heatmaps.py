"""Q maps and height maps of the workspace with an action drawn in, in millimetres."""

from typing import Any

import matplotlib
import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from csac_jax import grippers
from csac_jax.config import Config
from csac_jax.constants import Primitive

CHOSEN = "#D55E00"  # palette of Okabe and Ito
INVALID = "#EBEBEB"  # cells of a Q map with nothing to act on
TALLEST = 120.0  # mm, the end of the height map's scale
OUTLINE = [patheffects.withStroke(linewidth=3.9, foreground="white")]

DPI = 90.0  # of a picture 480 px high; it grows with the picture
BAR = (1.04, 0.0, 0.05, 1.0)  # colour bar right of a map, in shares of it


def figure(width: float, height: float, scene_height: int) -> Figure:
    """Makes a blank figure of even sides, px, as videos need."""
    dpi = DPI * max(scene_height / 480.0, 0.1)  # smaller letters cannot be drawn
    across, up = (
        (2 * round(0.5 * side) + 0.1) / dpi for side in (width, height)
    )  # Agg rounds down
    return Figure((across, up), dpi)


def pixels(fig: Figure) -> np.ndarray:
    """Renders a figure as a picture [H, W, 3] uint8."""
    canvas = FigureCanvasAgg(fig)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def draw_q_maps(cfg: Config, axes: tuple[Axes, Axes], q: Any) -> None:
    """Draws Q [P, H, W] of pushes and of grasps, -inf if invalid, in the same colours."""
    valid = np.ma.masked_invalid(q)
    colours = matplotlib.colormaps["viridis"].with_extremes(bad=INVALID)
    for primitive, ax in zip(Primitive, axes, strict=True):
        values = valid[primitive]
        best = f"best {values.max():+.2f}" if values.count() else "nowhere"
        title = f"{primitive.name.title()} value, {best}"
        image = _draw_map(cfg, ax, title, values, colours)
        image.set_clim(valid.min(), valid.max())
    ax.figure.colorbar(image, cax=ax.inset_axes(BAR), label="Q, best over yaws")


def draw_heights(cfg: Config, axes: Axes, height: Any) -> None:
    """Draws a height map [H, W] m."""
    values, grey = 1e3 * np.asarray(height), matplotlib.colormaps["Greys"]
    image = _draw_map(cfg, axes, "Height map", values, grey)
    image.set_clim(0.0, TALLEST)
    axes.figure.colorbar(image, cax=axes.inset_axes(BAR), label="height, mm")


def _draw_map(cfg: Config, axes: Axes, title: str, values: np.ndarray, cmap: Colormap) -> AxesImage:
    half = 500.0 * cfg.heightmap.extent
    image = axes.imshow(values, cmap, origin="lower", extent=(-half, half) * 2)
    axes.set_title(title, fontsize="medium")
    axes.set(xlabel="x, mm", autoscale_on=False)
    axes.set_ylabel("y, mm", labelpad=-4.0)
    axes.locator_params(nbins=4)
    axes.label_outer()
    return image


def draw_action(cfg: Config, axes: Axes, primitive: int, pose: Any) -> None:
    """Draws a push as an arrow, a grasp as fingers and the line they close along."""
    x, y, yaw = np.asarray(pose, float)
    centre, along = 1e3 * np.array([x, y]), 1e3 * np.array([np.cos(yaw), np.sin(yaw)])
    style: dict[str, Any] = {"color": CHOSEN, "path_effects": OUTLINE}
    if primitive == Primitive.PUSH:
        way = cfg.sim.push_length * along
        arrow = axes.arrow(*centre, *way, width=5.0, head_width=26.0, length_includes_head=True)
        arrow.set(lw=0.6, label="chosen push", zorder=4, **style)
        return
    gripper = grippers.load(cfg.sim.gripper)
    half = gripper.half[1] * along
    across = gripper.footprint[1] * np.array([-along[1], along[0]])
    tips = np.stack([centre - half, centre + half])
    axes.plot(*tips.T, lw=1.3, label="chosen grasp", **style)
    for tip in tips:
        axes.plot(*np.stack([tip - across, tip + across]).T, lw=3.3, **style)
