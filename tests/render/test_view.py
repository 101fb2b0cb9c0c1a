"""What a policy saw, beside the scene."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from csac_jax import presets
from csac_jax.constants import Primitive
from csac_jax.render import view

CFG = presets.smoke()
SIZE = CFG.heightmap.size
SCENE = np.full((120, 160, 3), 7, np.uint8)


def _step(primitive: int, pose: tuple[float, float, float], learned: bool) -> SimpleNamespace:
    """A block at x 0.1, y -0.15 m; Q of pushes highest at x -0.1, y 0.1 m; candidates at x 0.15, y
    0.15 m."""
    height, q = np.zeros((SIZE, SIZE)), np.full((2, SIZE, SIZE), -np.inf)
    row, col = _cell(0.1, -0.15)
    height[row - 1 : row + 2, col - 1 : col + 2] = 0.1
    q[:, 4:-4, 4:-4] = 0.0
    row, col = _cell(-0.1, 0.1)
    q[0, row, col] = 2.0
    cloud = np.tile([0.15, 0.15, 0.0], (2, 8, 1))
    cloud[1, :, 0] = -0.15
    debug = SimpleNamespace(q=q, candidates=cloud, best_grasp=np.float32(0.5)) if learned else None
    action = SimpleNamespace(primitive=np.int32(primitive), pose=np.array(pose))
    before = SimpleNamespace(obs=SimpleNamespace(height=height))
    return SimpleNamespace(before=before, action=action, debug=debug)


def _cell(x: float, y: float) -> tuple[int, int]:
    """Row and column of the height map."""
    return tuple(int((value / CFG.heightmap.extent + 0.5) * SIZE) for value in (y, x))  # type: ignore[return-value]


def _centre(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Mean place of a colour in a picture of the workspace, (x, y) m, y upwards."""
    row, col = np.argwhere((image == colour).all(axis=2)).mean(axis=0) + 0.5
    height, width = image.shape[:2]
    return np.array([col / width - 0.5, 0.5 - row / height]) * CFG.heightmap.extent


def test_height_map_and_action_lie_where_they_are():
    """Claim: in the height map x runs to the right and y upwards; a grasp is drawn about its place,
    closing along its yaw; a push begins at its place and is as long as it goes."""
    image = view.beside(CFG, SCENE, _step(Primitive.GRASP, (-0.1, 0.05, 0.0), learned=False), "")[
        :120, 160:
    ]
    assert image.shape == (120, 120, 3)
    bright = np.argwhere(image[..., 1] > 150).mean(axis=0) + 0.5
    place = np.array([bright[1] / 120 - 0.5, 0.5 - bright[0] / 120]) * CFG.heightmap.extent
    np.testing.assert_allclose(place, [0.1, -0.15], atol=0.015)
    np.testing.assert_allclose(_centre(image, view.CHOSEN), [-0.1, 0.05], atol=0.005)
    rows, columns = np.argwhere((image == view.CHOSEN).all(axis=2)).T
    assert np.ptp(columns) > 2 * np.ptp(rows)  # along x
    pushed = view.beside(
        CFG, SCENE, _step(Primitive.PUSH, (-0.1, 0.0, 0.5 * np.pi), learned=False), ""
    )[:120, 160:]
    rows, columns = np.argwhere((pushed == view.CHOSEN).all(axis=2)).T
    start, end = (
        (0.5 - row / 120) * CFG.heightmap.extent for row in (rows.max() + 0.5, rows.min() + 0.5)
    )
    assert (start, end) == pytest.approx((0.0, 0.1), abs=0.012)


def test_learned_policy_shows_its_maps():
    """Claim: a learned policy's maps stand above: pushes left, grasps right; candidates below in
    their colours."""
    image = view.beside(CFG, SCENE, _step(Primitive.GRASP, (0.0, 0.0, 0.0), learned=True), "")
    assert image.shape[1] == 160 + 120
    pushes, grasps = image[:60, 160:220], image[:60, 220:280]
    lightest = (253, 231, 37)
    np.testing.assert_allclose(_centre(pushes, lightest), [-0.1, 0.1], atol=0.015)
    assert not (grasps == lightest).all(axis=2).any()
    below = image[60:120, 160:220]
    np.testing.assert_allclose(_centre(below, view.CLOUDS[Primitive.PUSH]), [0.15, 0.15], atol=0.01)
    np.testing.assert_allclose(
        _centre(below, view.CLOUDS[Primitive.GRASP]), [-0.15, 0.15], atol=0.01
    )


@pytest.mark.parametrize("learned", [True, False])
@pytest.mark.parametrize("size", [(120, 160), (98, 130), (16, 16)])
def test_sides_are_even_and_the_scene_is_left_as_it_is(learned: bool, size: tuple[int, int]):
    """Claim: sides are even, as videos need; the scene is untouched, and the text stands below
    everything."""
    scene = np.full((*size, 3), 7, np.uint8)
    step = _step(Primitive.PUSH, (0.0, 0.0, 0.0), learned)
    bare, told = (view.beside(CFG, scene, step, text) for text in ("", "grasp: lifted"))
    assert bare.shape == told.shape
    assert all(side % 2 == 0 for side in told.shape[:2])
    np.testing.assert_array_equal(told[: size[0], : size[1]], scene)
    np.testing.assert_array_equal(told[: size[0]], bare[: size[0]])
    assert told[size[0] :].any()
    assert not bare[size[0] :].any()


def test_nothing_to_act_on():
    """Claim: maps without a valid cell are drawn, too."""
    step = _step(Primitive.PUSH, (0.0, 0.0, 0.0), learned=True)
    step.debug.q[:] = -np.inf
    assert view.beside(dataclasses.replace(CFG), SCENE, step, "").any()
