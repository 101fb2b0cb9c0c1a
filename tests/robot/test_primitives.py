"""Set-points of the two primitives, in closed form."""

import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import grippers
from csac_jax.config import HeightmapConfig, SimConfig
from csac_jax.constants import Primitive
from csac_jax.geometry import cell_centres
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Action, Plan

SIM = SimConfig(opening="full")
RG2 = grippers.load("rg2")
MAP = HeightmapConfig(size=224)  # 2 mm cells
X, Y, Z, YAW, FINGERS = range(5)


def _height(*surfaces: tuple[float, float, float, float]) -> jnp.ndarray:
    """Height map of square surfaces: centre x, y, side, height, m."""
    height, centres = np.zeros((MAP.size, MAP.size), np.float32), np.asarray(cell_centres(MAP))
    for x, y, side, top in surfaces:
        inside = (np.abs(centres - [x, y]) <= side / 2).all(axis=-1)
        height[inside] = np.maximum(height[inside], top)
    return jnp.asarray(height)


def _plan(primitive: Primitive, height: jnp.ndarray, *pose: float) -> Plan:
    place = jnp.array(pose or [0.0, 0.0, 0.0], jnp.float32)
    action = Action(primitive=jnp.int32(primitive), pose=place)
    return primitives.plan(SIM, MAP, height, action)


@pytest.mark.parametrize(
    ("primitive", "top", "low"),
    [
        (Primitive.GRASP, 0.05, 0.015),  # grasp_depth 35 mm below the top
        (Primitive.GRASP, 0.025, 0.012),  # clearance
        (Primitive.PUSH, 0.05, 0.03),  # push_depth 20 mm below the top
        (Primitive.PUSH, 0.0, 0.012),
    ],
)
def test_depth_of_the_tips(primitive: Primitive, top: float, low: float):
    """Claim: tips go to grasp_depth or push_depth below the top, never below the clearance."""
    plan = _plan(primitive, _height((0.0, 0.0, 0.05, top)), 0.0, 0.0, 0.3)
    z = np.asarray(plan.control[:, Z])
    assert plan.surface == pytest.approx(top)
    assert z.min() == pytest.approx(low, abs=1e-6)
    assert plan.start[Z] == pytest.approx(max(low + SIM.approach_height, top + 0.01), abs=1e-6)
    assert z[-1] == pytest.approx(float(plan.start[Z]), abs=1e-6)


@pytest.mark.parametrize("primitive", list(Primitive))
def test_descent_and_lift(primitive: Primitive):
    """Claim: the descent is uniform, the tips stay low meanwhile, the lift is smooth."""
    phases = SIM.grasp_phases if primitive == Primitive.GRASP else SIM.push_phases
    plan = _plan(primitive, _height())
    assert plan.control.shape == (SIM.substeps, 5)  # of both: they run in one scan
    z, high, low = np.asarray(plan.control[:, Z]), float(plan.start[Z]), RG2.clearance
    descent = high + (low - high) * np.arange(1, phases[0] + 1) / phases[0]
    share = np.arange(1, phases[2] + 1) / phases[2]
    rise = low + (high - low) * (3 * share**2 - 2 * share**3)
    wanted = np.concatenate([descent, np.full(phases[1], low), rise])
    np.testing.assert_allclose(z, wanted, atol=1e-6)


def test_grasp_closes_in_place():
    """Claim: a grasp stays over its place at its yaw, and is closed before the lift begins."""
    plan = _plan(Primitive.GRASP, _height((0.05, -0.1, 0.05, 0.05)), 0.05, -0.1, 2.0)
    wanted = np.tile([0.05, -0.1, 2.0], (SIM.substeps, 1))
    np.testing.assert_allclose(plan.control[:, [X, Y, YAW]], wanted, atol=1e-6)
    down, close, _ = SIM.grasp_phases
    fingers = np.asarray(plan.control[:, FINGERS])
    np.testing.assert_allclose(fingers[:down], RG2.half[1])
    assert (np.diff(fingers) <= 0.0).all()
    assert fingers[down + close - 1] == 0.0
    kept = np.array([X, Y, YAW, FINGERS])
    np.testing.assert_allclose(plan.start[kept], plan.control[0, kept], atol=1e-6)


@pytest.mark.parametrize("yaw", [0.0, 1.0, 3.5, 5.5])
def test_push_runs_along_the_yaw(yaw: float):
    """Claim: a push goes push_length straight along its yaw at even speed, with closed fingers."""
    plan = _plan(Primitive.PUSH, _height(), 0.02, -0.03, yaw)
    down, act, _ = SIM.push_phases
    share = np.clip((np.arange(1, SIM.substeps + 1) - down) / act, 0, 1)[:, None]
    expected = [0.02, -0.03] + share * 0.10 * np.array([np.cos(yaw), np.sin(yaw)])
    np.testing.assert_allclose(plan.control[:, :2], expected, atol=1e-6)
    np.testing.assert_allclose(plan.control[:, YAW], yaw, atol=1e-6)
    assert not np.any(plan.control[:, FINGERS])


@pytest.mark.parametrize(
    ("yaw", "end"), [(0.0, (0.224, 0.2)), (np.pi / 4, (0.224, 0.224)), (np.pi, (0.1, 0.2))]
)
def test_push_ends_in_the_workspace(yaw: float, end: tuple[float, float]):
    """Claim: the end of a push is clipped to the workspace square."""
    plan = _plan(Primitive.PUSH, _height(), 0.2, 0.2, yaw)
    np.testing.assert_allclose(plan.control[-1, :2], end, atol=1e-6)


@pytest.mark.parametrize("primitive", list(Primitive))
def test_starts_above_whatever_is_under_the_hand(primitive: Primitive):
    """Claim: the hand starts a centimetre above the highest thing within its reach."""
    near, far = (_plan(primitive, _height((x, 0.0, 0.04, 0.2))) for x in (0.09, 0.13))
    assert near.start[Z] == pytest.approx(0.21, abs=1e-6)
    assert far.start[Z] == pytest.approx(0.112, abs=1e-6)
    assert near.control[:, Z].min() == pytest.approx(0.012, abs=1e-6)  # the place itself is bare


def test_local_top_is_that_of_the_window():
    """Claim: the highest surface in a window of 2 cm counts, corners included; where cells are
    wider than the window, the cell of the place."""
    for offset, top in ((0.0, 0.04), (0.009, 0.04), (0.013, 0.0)):
        height = _height((offset, -offset, 0.0022, 0.04))
        assert primitives.local_top(MAP, height, jnp.zeros(2), RG2.finger[1]) == pytest.approx(top)
    coarse = HeightmapConfig(size=16)  # 28 mm cells
    height = jnp.zeros((16, 16)).at[8, 8].set(0.05)
    centre = cell_centres(coarse)[8, 8]
    for offset in (0.0, 0.0139, -0.0139):
        top = primitives.local_top(coarse, height, centre + offset, RG2.finger[1])
        assert top == pytest.approx(0.05)
