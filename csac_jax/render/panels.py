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
from matplotlib.image import AxesImage
from matplotlib.patches import Patch

from csac_jax.config import Config
from csac_jax.constants import MAX_OPENING, Primitive
from csac_jax.evaluation.rollout import StepRecord

CANDIDATES = {Primitive.PUSH: "#0072B2", Primitive.GRASP: "#CC79A7"}  # palette of Okabe and Ito
CHOSEN = "#D55E00"
INVALID = "#EBEBEB"  # cells of a Q map with nothing to act on
TALLEST = 120.0  # mm, the end of the height map's scale
FINGER = 24.0  # mm, width of a finger as drawn

DPI = 90.0  # beside a scene 480 px high; it grows with the picture
LEARNED = {"left": 0.106, "right": 0.841, "bottom": 0.092, "top": 0.954, "wspace": 0.11}
OTHERS = {"left": 0.142, "right": 0.809, "bottom": 0.208, "top": 0.792}  # edges of the maps
BAR = (1.04, 0.0, 0.05, 1.0)  # colour bar right of a map, in shares of it

# A scene's picture [H, W, 3] uint8 and a line of text -> the whole picture
Frame = Callable[[np.ndarray, str], np.ndarray]


def frame(cfg: Config, step: StepRecord, height: int) -> Frame:
    """Draws an action's panels once, `height` px; the result adds them to each of its pictures."""
    panels = _pixels(figure(cfg, step, height))

    def complete(scene: np.ndarray, text: str) -> np.ndarray:
        above = np.concatenate([scene, panels], axis=1)
        return np.concatenate([above, text_line(text, above.shape[1], height)])

    return complete


@functools.lru_cache(maxsize=2)
def text_line(text: str, width: int, scene_height: int) -> np.ndarray:
    """The text in black on white [h, width, 3] uint8; a long text takes two lines."""
    fig = _figure(width, 0.075 * scene_height, scene_height)
    fig.text(0.012, 0.5, text.strip(), fontsize=12.0, va="center", wrap=True)
    return _pixels(fig)


def figure(cfg: Config, step: StepRecord, height: int) -> Figure:
    """An action's Q maps, height map and legend; of a policy without Q the height map alone."""
    if step.debug is None:
        fig = _figure(0.875 * height, height, height)
        _draw_height_map(cfg, fig.subplots(gridspec_kw=OTHERS), step)
        return fig
    fig = _figure(1.1 * height, height, height)
    (push, grasp), (heights, legend) = fig.subplots(
        2, 2, sharex=True, sharey=True, gridspec_kw=LEARNED
    )
    _draw_q_maps(cfg, (push, grasp), step)
    _draw_height_map(cfg, heights, step)
    handles, _ = heights.get_legend_handles_labels()
    handles.append(Patch(color=INVALID, label="nothing to act on"))
    legend.legend(handles=handles, loc="center left", bbox_to_anchor=(0.3, 0.5), frameon=False)
    legend.set_axis_off()
    return fig


def _figure(width: float, height: float, scene_height: int) -> Figure:
    """A blank figure of even sides, px; videos want them."""
    dpi = DPI * max(scene_height / 480.0, 0.1)  # smaller letters cannot be drawn
    sides = [(2 * round(0.5 * side) + 0.1) / dpi for side in (width, height)]  # Agg rounds down
    return Figure((sides[0], sides[1]), dpi)


def _pixels(fig: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(fig)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def _draw_q_maps(cfg: Config, maps: tuple[Axes, Axes], step: StepRecord) -> None:
    """Q of pushes and of grasps, in the same colours."""
    assert step.debug is not None
    every = np.ma.masked_invalid(step.debug.q)
    colours = matplotlib.colormaps["viridis"].with_extremes(bad=INVALID)
    for primitive, axes in zip(Primitive, maps, strict=True):
        values = every[primitive]
        best = f"best {values.max():+.2f}" if values.count() else "nowhere"
        image = _draw_map(cfg, axes, f"{primitive.name.title()} value, {best}", values, colours)
        image.set_clim(every.min(), every.max())
        if primitive == step.action.primitive:
            _draw_action(cfg, axes, step)
    axes.figure.colorbar(image, cax=axes.inset_axes(BAR), label="Q, best over yaws")


def _draw_height_map(cfg: Config, axes: Axes, step: StepRecord) -> None:
    """The height map with the search's candidates and the chosen action."""
    height = 1e3 * np.asarray(step.before.obs.height)
    image = _draw_map(cfg, axes, "Height map", height, matplotlib.colormaps["Greys"])
    image.set_clim(0.0, TALLEST)
    axes.figure.colorbar(image, cax=axes.inset_axes(BAR), label="height, mm")
    if step.debug is not None:
        style: dict[str, Any] = {"edgecolors": "white", "linewidths": 0.4, "zorder": 3}
        for primitive, colour in CANDIDATES.items():
            x, y, _ = 1e3 * np.asarray(step.debug.candidates)[primitive].T
            axes.scatter(x, y, 14.0, colour, label=f"{primitive.name.lower()} candidates", **style)
    _draw_action(cfg, axes, step)


def _draw_map(cfg: Config, axes: Axes, title: str, values: np.ndarray, cmap: Colormap) -> AxesImage:
    """A map of the workspace [H, W], axes in mm, y upwards."""
    half = 500.0 * cfg.heightmap.extent
    image = axes.imshow(values, cmap, origin="lower", extent=(-half, half) * 2)
    axes.set_title(title, fontsize="medium")
    axes.set(xlabel="x, mm", autoscale_on=False)
    axes.set_ylabel("y, mm", labelpad=-4.0)
    axes.locator_params(nbins=4)
    axes.label_outer()
    return image


def _draw_action(cfg: Config, axes: Axes, step: StepRecord) -> None:
    """A push as an arrow over its way; a grasp as fingers and the line that they close along."""
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
