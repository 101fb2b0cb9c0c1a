"""The picture of a decision."""

import numpy as np
from matplotlib.colors import to_rgb

import csac_jax
from csac_jax import presets
from csac_jax.deploy import Maps, decision, images
from csac_jax.render import decision_picture as drawn, heatmaps
from tests.deploy import scenes

CFG = presets.smoke()
IMAGE = scenes.take(scenes.blocks_at([[0.0, 0.1, 0.0]]))
VIEW = images.make(*IMAGE)
HEIGHT = np.full((CFG.heightmap.size,) * 2, 0.05, np.float32)


def _decision(action: csac_jax.Action) -> decision.Decision:
    stations = decision.stations(CFG, HEIGHT, action)
    choice = decision.Choice(action, np.float32(1.0), np.bool_(True), stations)
    return decision.from_choice(choice, np.eye(4))


def _coloured(picture: np.ndarray) -> np.ndarray:
    """Places (column, row) [n, 2] of the chosen action's colour left of the maps."""
    off = np.abs(picture[:, :800] - 255 * np.array(to_rgb(heatmaps.CHOSEN))).max(axis=2)
    return np.argwhere(off <= 1.0)[:, ::-1]


def _picture(action: csac_jax.Action) -> np.ndarray:
    q = np.zeros((2, *HEIGHT.shape), np.float32)
    return drawn.picture(CFG, VIEW, [_decision(action)], Maps(HEIGHT, q))


def test_grasp_is_drawn_where_it_is():
    """Claim: grasps at y = 0.1 and -0.1 m are drawn at their projections, left and right of the
    image's middle: the camera looks along x."""
    middle = [_coloured(_picture(csac_jax.Action.grasp(0.0, y, 0.0)))[:, 0] for y in (0.1, -0.1)]
    left, right = (np.median(columns) for columns in middle)
    ends = np.array([[0.0, 0.1, 0.015], [0.0, -0.1, 0.015]])
    pixel, _ = images.project(VIEW.intrinsics, VIEW.pose, ends)
    scale = (right - left) / (pixel[1, 0] - pixel[0, 0])
    assert 1.0 < scale < 1.5  # the image is drawn larger than it is
    assert abs(pixel[0, 0] - 232) < 10
