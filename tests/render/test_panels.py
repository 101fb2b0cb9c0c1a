"""Panels right of the scene: what they show, where, and how often they are drawn."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure

from csac_jax import grippers, presets
from csac_jax.constants import Primitive
from csac_jax.render import heatmaps, panels

CFG = presets.smoke()
RG2 = grippers.load("rg2")
SIZE = CFG.heightmap.size
HEIGHT = 480  # px
HIGHEST = to_hex(colormaps["viridis"](1.0))


def _step(primitive: int, pose: tuple[float, float, float], learned: bool) -> SimpleNamespace:
    """A block at (0.1, -0.15) m; Q of pushes highest at (-0.1, 0.1) m; push candidates at
    (0.15, 0.15) m, grasp candidates at (-0.15, 0.15) m."""
    height, q = np.zeros((SIZE, SIZE)), np.full((2, SIZE, SIZE), -np.inf)
    row, col = _cell(0.1, -0.15)
    height[row - 1 : row + 2, col - 1 : col + 2] = 0.1
    q[:, 4:-4, 4:-4] = 0.0
    row, col = _cell(-0.1, 0.1)
    q[0, row, col] = 2.0
    candidates = np.tile([0.15, 0.15, 0.0], (2, 8, 1))
    candidates[1, :, 0] = -0.15
    debug = SimpleNamespace(q=q, candidates=candidates) if learned else None
    action = SimpleNamespace(primitive=np.int32(primitive), pose=np.array(pose))
    before = SimpleNamespace(obs=SimpleNamespace(height=height))
    return SimpleNamespace(before=before, action=action, debug=debug)


def _cell(x: float, y: float) -> tuple[int, int]:
    """Row and column of the height map."""
    row, col = (int((value / CFG.heightmap.extent + 0.5) * SIZE) for value in (y, x))
    return row, col


def _drawn(fig: Figure, title: str) -> tuple[np.ndarray, np.ndarray]:
    """Colours [n, 3] uint8 and places (x, y) [n, 2], m, of the pixels of a map."""
    pixels = heatmaps.pixels(fig)[::-1]  # row 0 is the lowest
    (axes,) = [axes for axes in fig.axes if axes.get_title().startswith(title)]
    left, bottom, right, top = np.round(axes.bbox.extents).astype(int)
    row, col = np.mgrid[bottom:top, left:right].reshape(2, -1)
    centres = np.stack([col, row], axis=1) + 0.5
    return pixels[row, col], 1e-3 * axes.transData.inverted().transform(centres)


def _places(fig: Figure, title: str, colour: str) -> np.ndarray:
    """Places (x, y) [n, 2], m, of a colour in a map."""
    colours, places = _drawn(fig, title)
    off = np.abs(colours - 255 * np.array(to_rgb(colour))).max(axis=1)
    return places[off <= 1.0]


def test_height_map_and_grasp_lie_where_they_are():
    """Claim: x runs to the right and y upwards; a grasp is drawn at its place, along its yaw."""
    fig = panels.figure(CFG, _step(Primitive.GRASP, (-0.1, 0.05, 0.0), learned=False), HEIGHT)
    colours, places = _drawn(fig, "Height map")
    inner = np.abs(places).max(axis=1) < 0.215  # without the frame
    dark = inner & (colours.max(axis=1) < 100)
    block = places[dark].mean(axis=0)
    np.testing.assert_allclose(block, [0.1, -0.15], atol=0.5 * CFG.heightmap.cell)
    hand = _places(fig, "Height map", heatmaps.CHOSEN)
    np.testing.assert_allclose(hand.mean(axis=0), [-0.1, 0.05], atol=0.003)
    width, height = np.ptp(hand, axis=0)
    assert width == pytest.approx(RG2.opening[1], abs=0.01)
    assert height == pytest.approx(2.0 * RG2.footprint[1], abs=0.01)


def test_learned_policy_shows_its_maps():
    """Claim: Q maps share one scale, invalid cells stand out, candidates are in the height map."""
    fig = panels.figure(CFG, _step(Primitive.GRASP, (0.0, 0.0, 0.0), learned=True), HEIGHT)
    best = _places(fig, "Push value, best +2.00", HIGHEST)
    np.testing.assert_allclose(best.mean(axis=0), [-0.1, 0.1], atol=0.5 * CFG.heightmap.cell)
    assert not len(_places(fig, "Grasp value, best +0.00", HIGHEST))
    invalid = np.abs(_places(fig, "Push value", heatmaps.INVALID)).max(axis=1)
    assert invalid.min() == pytest.approx((0.5 * SIZE - 4) * CFG.heightmap.cell, abs=0.003)
    step = _step(Primitive.PUSH, (0.0, 0.0, 0.0), learned=True)
    step.debug.q[:] = -np.inf
    nowhere = panels.figure(CFG, step, HEIGHT)
    assert len(_places(nowhere, "Push value, nowhere", heatmaps.INVALID)) > 20000
    for primitive, x in ((Primitive.PUSH, 0.15), (Primitive.GRASP, -0.15)):
        places = _places(fig, "Height map", panels.CANDIDATES[primitive])
        np.testing.assert_allclose(places.mean(axis=0), [x, 0.15], atol=0.003)
