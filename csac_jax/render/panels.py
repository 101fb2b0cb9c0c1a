"""Panels right of a scene's picture: observation, candidates of the search, chosen action."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.evaluation.rollout import StepRecord
from csac_jax.render import heatmaps

CANDIDATES = {Primitive.PUSH: "#0072B2", Primitive.GRASP: "#CC79A7"}  # palette of Okabe and Ito

LEARNED = {"left": 0.106, "right": 0.841, "bottom": 0.092, "top": 0.954, "wspace": 0.11}
OTHERS = {"left": 0.142, "right": 0.809, "bottom": 0.208, "top": 0.792}  # edges of the maps

# A scene's picture [H, W, 3] uint8 and a line of text -> the whole picture.
Frame = Callable[[np.ndarray, str], np.ndarray]


def frame(cfg: Config, step: StepRecord, height: int) -> Frame:
    """Draws an action's panels once, `height` px high; returns a function that adds them."""
    panels = heatmaps.pixels(figure(cfg, step, height))

    def complete(scene: np.ndarray, text: str) -> np.ndarray:
        above = np.concatenate([scene, panels], axis=1)
        return np.concatenate([above, text_line(text, above.shape[1], height)])

    return complete


@functools.lru_cache(maxsize=2)
def text_line(text: str, width: int, scene_height: int) -> np.ndarray:
    """Draws text in black on white [h, width, 3] uint8; a long text takes two lines."""
    fig = heatmaps.figure(width, 0.075 * scene_height, scene_height)
    fig.text(0.012, 0.5, text.strip(), fontsize=12.0, va="center", wrap=True)
    return heatmaps.pixels(fig)


def figure(cfg: Config, step: StepRecord, height: int) -> Figure:
    """Draws Q maps, height map and legend of an action; without Q the height map alone."""
    if step.debug is None:
        fig = heatmaps.figure(0.875 * height, height, height)
        _draw_height_map(cfg, fig.subplots(gridspec_kw=OTHERS), step)
        return fig
    fig = heatmaps.figure(1.1 * height, height, height)
    q_axes, (heights, legend) = fig.subplots(2, 2, sharex=True, sharey=True, gridspec_kw=LEARNED)
    heatmaps.draw_q_maps(cfg, q_axes, step.debug.q)
    kind = int(step.action.primitive)
    heatmaps.draw_action(cfg, q_axes[kind], kind, step.action.pose)
    _draw_height_map(cfg, heights, step)
    handles, _ = heights.get_legend_handles_labels()
    handles.append(Patch(color=heatmaps.INVALID, label="nothing to act on"))
    legend.legend(handles=handles, loc="center left", bbox_to_anchor=(0.3, 0.5), frameon=False)
    legend.set_axis_off()
    return fig


def _draw_height_map(cfg: Config, axes: Axes, step: StepRecord) -> None:
    heatmaps.draw_heights(cfg, axes, step.before.obs.height)
    if step.debug is not None:
        style: dict[str, Any] = {"edgecolors": "white", "linewidths": 0.4, "zorder": 3}
        for primitive, colour in CANDIDATES.items():
            x, y, _ = 1e3 * np.asarray(step.debug.candidates)[primitive].T
            axes.scatter(x, y, 14.0, colour, label=f"{primitive.name.lower()} candidates", **style)
    heatmaps.draw_action(cfg, axes, int(step.action.primitive), step.action.pose)
