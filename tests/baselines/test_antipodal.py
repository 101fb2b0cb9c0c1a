"""The geometric baseline on height maps that are drawn by hand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from csac_jax.baselines import antipodal
from csac_jax.baselines.antipodal import Weights
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.geometry import cell_centres
from csac_jax.robot.primitives import Action

CFG = Config()
PLACES = np.asarray(cell_centres(CFG.heightmap))  # [H, W, 2] m
STEP = np.pi / antipodal.YAWS  # rad, between two yaws that are tried

_choose = jax.jit(functools.partial(antipodal.grasp, weights=Weights()), static_argnames="cfg")


def _inside(x: float, y: float, yaw: float, half: tuple[float, float]) -> np.ndarray:
    """Cells [H, W] bool of a rectangle, along `yaw`."""
    off = PLACES - np.array([x, y], np.float32)
    along = np.cos(yaw) * off[..., 0] + np.sin(yaw) * off[..., 1]
    across = np.cos(yaw) * off[..., 1] - np.sin(yaw) * off[..., 0]
    return (np.abs(along) <= half[0]) & (np.abs(across) <= half[1])


def _grasp(
    height: np.ndarray, failures: int = 0, wanted: np.ndarray | None = None, cfg: Config = CFG
) -> Action:
    here = np.ones(height.shape, bool) if wanted is None else wanted
    maps = jnp.asarray(height, jnp.float32), jnp.asarray(here)
    seen = {"height": maps[0], "wanted": maps[1], "failures": jnp.int32(failures)}
    return _choose(jax.random.key(0), cfg=cfg, **seen)


@pytest.mark.parametrize("yaw", np.linspace(0.0, 2.8, 5))
def test_fingers_close_across_a_bar(yaw: float):
    """Claim: of a bar, whatever its yaw, the long sides are taken, in their middle line."""
    action = _grasp(0.05 * _inside(0.04, -0.03, yaw, (0.07, 0.02)))
    assert action.primitive == Primitive.GRASP
    off = (action.pose[2] - yaw - 0.5 * np.pi + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    assert abs(off) <= 1.5 * STEP
    assert _inside(0.04, -0.03, yaw, (0.06, 0.01))[_cell(action)]


def _cell(action: Action) -> tuple[int, int]:
    away = np.linalg.norm(PLACES - np.asarray(action.pose[:2]), axis=-1)
    row, col = np.unravel_index(away.argmin(), away.shape)
    return int(row), int(col)


@pytest.mark.parametrize(("opening", "far"), [("full", 0.067), ("fit", 0.048)])
def test_fingers_come_down_on_free_ground(opening: str, far: float):
    """Claim: where a wall stands along a part of a bar, the bar is taken where there is none: where
    the open fingers would come down, or closer than a finger needs to one that opens about it."""
    cfg = CFG.change(sim={"opening": opening})
    bar = _inside(0.0, 0.0, 0.0, (0.10, 0.02))
    wall = _inside(-0.03, far, 0.0, (0.10, 0.006))
    only = bar & (PLACES[..., 0] > -0.1)
    assert _grasp(0.05 * bar, wanted=only, cfg=cfg).pose[0] < 0.05
    assert _grasp(0.05 * (bar | wall), wanted=only, cfg=cfg).pose[0] > 0.06


def test_what_is_too_wide_is_left():
    """Claim: a square wider than the hand opens is not chosen where a low bar can be taken."""
    wide = _inside(-0.12, 0.0, 0.0, (0.07, 0.07))
    bar = _inside(0.12, 0.0, 0.0, (0.02, 0.05))
    assert _grasp(0.05 * wide + 0.015 * bar).pose[0] > 0.05


def test_only_what_is_wanted_is_taken():
    """Claim: the middle of the hand is over a wanted cell."""
    one, two = (_inside(x, 0.0, 0.0, (0.02, 0.05)) for x in (-0.12, 0.12))
    for wanted, side in ((one, -1.0), (two, 1.0)):
        assert side * _grasp(0.05 * (one | two), wanted=wanted).pose[0] > 0.05


@pytest.mark.slow
def test_what_is_out_of_reach_is_left():
    """Claim: an arm that stands far away takes the bar that it reaches, the hand the narrower."""
    one, two = _inside(-0.15, 0.0, 0.0, (0.012, 0.05)), _inside(0.15, 0.0, 0.0, (0.03, 0.05))
    height, wanted = 0.05 * (one | two), one | two
    assert _grasp(height, wanted=wanted).pose[0] < 0.0
    far = CFG.change(sim={"robot": "ur5", "base": (0.87, 0.0, 0.35, 0.0)})
    arm = functools.partial(antipodal.grasp, cfg=far, weights=Weights(), wanted=jnp.asarray(wanted))
    maps, none = jnp.asarray(height, jnp.float32), jnp.int32(0)
    assert jax.jit(arm)(jax.random.key(0), height=maps, failures=none).pose[0] > 0.0


def test_another_grasp_is_tried_after_a_failure():
    """Claim: without failures the choice is the same for any key, after some it is not."""
    height = 0.05 * _inside(0.0, 0.0, 0.5, (0.06, 0.02))
    first = _grasp(height).pose
    assert_array_equal(first, _grasp(height).pose)
    assert not np.array_equal(first, _grasp(height, failures=3).pose)
