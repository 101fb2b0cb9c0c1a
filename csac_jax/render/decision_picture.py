"""Pictures of a policy's decisions: the camera's image with them, and Q maps."""

import itertools
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from csac_jax import grippers
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.deploy import Maps, images
from csac_jax.deploy.decision import Decision
from csac_jax.deploy.images import CameraView
from csac_jax.render import heatmaps

HEIGHT = 640  # px
OTHERS = "#56B4E9"  # alternatives
_LAYOUT = {"left": 0.01, "right": 0.93, "bottom": 0.09, "top": 0.93, "wspace": 0.12}


def picture(cfg: Config, view: CameraView, decisions: list[Decision], values: Maps) -> np.ndarray:
    """Draws the image with the decisions, and Q of both primitives, [H, W, 3] uint8."""
    fig = heatmaps.figure(1.95 * HEIGHT, HEIGHT, HEIGHT)
    image, push, grasp = fig.subplot_mosaic("IIP;IIG", gridspec_kw=_LAYOUT).values()
    _draw_image(cfg, image, view, decisions)
    heatmaps.draw_q_maps(cfg, (push, grasp), values.q)
    for decision in decisions[:1]:
        primitive = Primitive[decision.primitive.upper()]
        pose = (*decision.position[:2], decision.yaw)
        heatmaps.draw_action(cfg, (push, grasp)[primitive], primitive, pose)
    return heatmaps.pixels(fig)


def _draw_image(cfg: Config, axes: Axes, view: CameraView, decisions: list[Decision]) -> None:
    axes.imshow(view.colour)
    axes.set_title(line(decisions[0]) if decisions else "nothing to act on", fontsize="medium")
    axes.set(autoscale_on=False)
    axes.set_axis_off()
    half = 0.5 * cfg.heightmap.extent
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]])
    _draw_path(axes, view, corners, color="white", lw=0.8)
    for number, decision in reversed(list(enumerate(decisions))):
        colour = OTHERS if number else heatmaps.CHOSEN
        for path in paths(decision, grippers.load(cfg.sim.gripper).footprint[1]):
            _draw_path(axes, view, path, color=colour, lw=2.2, path_effects=heatmaps.OUTLINE)


def paths(decision: Decision, half_finger: float) -> list[np.ndarray]:
    """Returns lines [n, 3] m: a push's way; a grasp's descent, gap and fingers, `half_finger` m."""
    places = np.array([waypoint.position for waypoint in decision.waypoints])
    if decision.primitive == "push":
        return [places[:3]]
    along = np.array([np.cos(decision.yaw), np.sin(decision.yaw), 0.0])
    across = half_finger * np.array([-along[1], along[0], 0.0])
    tips = places[1] + 0.5 * decision.width * np.stack([-along, along])
    return [places[:2], tips, *(np.stack([tip - across, tip + across]) for tip in tips)]


def _draw_path(axes: Axes, view: CameraView, path: np.ndarray, **style: Any) -> None:
    """Draws a line through points [n, 3] m of the workspace, as the camera sees it."""
    steps = np.linspace(0.0, 1.0, 16)[:, None]
    dense = [start + steps * (end - start) for start, end in itertools.pairwise(path)]
    pixel, inside = images.project(view.intrinsics, view.pose, np.concatenate(dense))
    axes.plot(*np.where(inside[:, None], pixel, np.nan).T, **style)


def line(decision: Decision) -> str:
    """Describes a decision in a line of text."""
    x, y, z = decision.position
    width = f", {1e3 * decision.width:.0f} mm open" if decision.width else ""
    return (
        f"{decision.primitive} at x {x:+.3f}, y {y:+.3f}, z {z:.3f} m, "
        f"yaw {np.degrees(decision.yaw):.0f} degrees{width}, score {decision.score:+.2f}"
    )
