"""Panels right of a scene's picture: what the policy saw, what its search tried, what it chose."""

import functools
from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.evaluation.rollout import StepRecord
from csac_jax.scene.model import MAX_OPENING

CANDIDATES = {Primitive.PUSH: "#0072B2", Primitive.GRASP: "#CC79A7"}  # palette of Okabe and Ito
CHOSEN = "#D55E00"
INVALID = "#EBEBEB"  # cells of a Q map with nothing to act on
TALLEST = 120.0  # mm, the end of the height map's scale
FINGER = 24.0  # mm, width of a finger as drawn

# The layout is in px for a scene 480 px high; it grows with the picture.
DPI = 90.0  # makes Matplotlib's font of 10 pt as large as the layout needs
SCENE_HEIGHT = 480.0
MAP_SIDE = 184.0
COLUMNS = (56.0, 260.0)  # left edges of the maps
ROWS = (274.0, 44.0)  # lower edges of the maps

Place = tuple[float, float, float]  # left edge, lower edge and side of a map
# A scene's picture [H, W, 3] uint8 and a line of text -> the whole picture
Frame = Callable[[np.ndarray, str], np.ndarray]


def frame(cfg: Config, step: StepRecord, height: int) -> Frame:
    """Draws the panels of an action once; the result adds them to every picture of the scene.

    Args: height of the scene's pictures, px.
    """
    panels = _pixels(figure(cfg, step, height))

    def complete(scene: np.ndarray, text: str) -> np.ndarray:
        above = np.concatenate([scene, panels], axis=1)
        return np.concatenate([above, text_line(text, above.shape[1], height)])

    return complete


@functools.lru_cache(maxsize=2)
def text_line(text: str, width: int, scene_height: int) -> np.ndarray:
    """The text in black on white [h, width, 3] uint8; a long text takes two lines."""
    scale = _scale(scene_height)
    fig = _figure(width, 36.0 * scale, scale)
    fig.text(14.0 * scale / width, 0.5, text.strip(), fontsize=12.0, va="center", wrap=True)
    return _pixels(fig)


def figure(cfg: Config, step: StepRecord, height: int) -> Figure:
    """The panels of an action. A learned policy's Q maps stand above, height map and legend below.

    Any other policy has the height map alone.
    """
    scale = _scale(height)
    if step.debug is None:
        fig = _figure(420.0 * scale, height, scale)
        _draw_height_map(cfg, fig, step, (64.0, 100.0, 280.0))
        return fig
    fig = _figure(528.0 * scale, height, scale)
    _draw_q_maps(cfg, fig, step)
    axes = _draw_height_map(cfg, fig, step, (COLUMNS[0], ROWS[1], MAP_SIDE))
    handles, _ = axes.get_legend_handles_labels()
    handles.append(Patch(color=INVALID, label="nothing to act on"))
    axes.legend(handles=handles, loc="center", bbox_to_anchor=(2.03, 0.5), frameon=False)
    return fig


def _scale(scene_height: int) -> float:
    return max(scene_height / SCENE_HEIGHT, 0.1)  # smaller letters cannot be drawn


def _figure(width: float, height: float, scale: float) -> Figure:
    """A blank figure of even sides, px; videos want them."""
    dpi = scale * DPI
    sides = [(2 * round(0.5 * side) + 0.1) / dpi for side in (width, height)]  # Agg rounds down
    return Figure((sides[0], sides[1]), dpi)


def _pixels(fig: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(fig)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def _draw_q_maps(cfg: Config, fig: Figure, step: StepRecord) -> None:
    """Q of pushes and of grasps, in the same colours."""
    assert step.debug is not None
    every = np.ma.masked_invalid(step.debug.q)
    colours = matplotlib.colormaps["viridis"].with_extremes(bad=INVALID)
    for primitive, left in zip(Primitive, COLUMNS, strict=True):
        values = every[primitive]
        best = f"best {values.max():+.2f}" if values.count() else "nowhere"
        title = f"{primitive.name.title()} value, {best}"
        axes = _add_map(cfg, fig, (left, ROWS[0], MAP_SIDE), title, values, colours)
        axes.images[0].set_clim(every.min(), every.max())
        axes.set_xlabel("")
        if primitive == step.action.primitive:
            _draw_action(cfg, axes, step)
    axes.set(yticklabels=[], ylabel="")
    _add_colour_bar(axes, "Q, best over yaws")


def _draw_height_map(cfg: Config, fig: Figure, step: StepRecord, place: Place) -> Axes:
    """The height map with the search's candidates and the chosen action."""
    height = 1e3 * np.asarray(step.before.obs.height)
    axes = _add_map(cfg, fig, place, "Height map", height, matplotlib.colormaps["Greys"])
    axes.images[0].set_clim(0.0, TALLEST)
    _add_colour_bar(axes, "height, mm")
    if step.debug is not None:
        style: dict[str, Any] = {"edgecolors": "white", "linewidths": 0.4, "zorder": 3}
        for primitive, colour in CANDIDATES.items():
            x, y, _ = 1e3 * np.asarray(step.debug.candidates)[primitive].T
            axes.scatter(x, y, 14.0, colour, label=f"{primitive.name.lower()} candidates", **style)
    _draw_action(cfg, axes, step)
    return axes


def _add_map(
    cfg: Config, fig: Figure, place: Place, title: str, values: np.ndarray, colours: Colormap
) -> Axes:
    """A map of the workspace [H, W], axes in mm, y upwards."""
    left, bottom, side = place
    x, y = DPI * fig.get_size_inches()
    axes = fig.add_axes((left / x, bottom / y, side / x, side / y))
    axes.set_title(title, fontsize=11.0)
    half = 500.0 * cfg.heightmap.extent
    axes.imshow(values, colours, origin="lower", extent=(-half, half) * 2)
    axes.set(xlim=(-half, half), ylim=(-half, half), autoscale_on=False)
    axes.set_xlabel("x, mm", labelpad=1.0)
    axes.set_ylabel("y, mm", labelpad=-4.0)
    axes.locator_params(nbins=4)
    return axes


def _add_colour_bar(axes: Axes, label: str) -> None:
    """A colour bar right of a map."""
    axes.figure.colorbar(axes.images[0], cax=axes.inset_axes((1.04, 0.0, 0.05, 1.0)), label=label)


def _draw_action(cfg: Config, axes: Axes, step: StepRecord) -> None:
    """A push as an arrow over its way; a grasp as open fingers and the line that they close
    along."""
    x, y, yaw = np.asarray(step.action.pose, float)
    centre, along = 1e3 * np.array([x, y]), 1e3 * np.array([np.cos(yaw), np.sin(yaw)])
    outline = [patheffects.withStroke(linewidth=3.9, foreground="white")]
    style: dict[str, Any] = {"color": CHOSEN, "path_effects": outline}
    if step.action.primitive == Primitive.PUSH:
        way = cfg.sim.push_length * along
        arrow = axes.arrow(*centre, *way, width=5.0, head_width=26.0, length_includes_head=True)
        arrow.set(lw=0.6, label="chosen push", zorder=4, **style)
        return
    half = 0.5 * MAX_OPENING * along
    across = 0.5e-3 * FINGER * np.array([-along[1], along[0]])
    tips = np.stack([centre - half, centre + half])
    axes.plot(*tips.T, lw=1.3, label="chosen grasp", **style)
    for tip in tips:
        axes.plot(*np.stack([tip - across, tip + across]).T, lw=3.3, **style)
