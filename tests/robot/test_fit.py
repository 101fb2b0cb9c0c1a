"""The opening of a grasp and its middle, in closed form."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import grippers
from csac_jax.config import HeightmapConfig, SimConfig
from csac_jax.geometry import cell_centres
from csac_jax.grippers import Fingers
from csac_jax.robot import fit, primitives
from csac_jax.robot.fit import Fit
from csac_jax.robot.primitives import Action

MAPS = HeightmapConfig(), HeightmapConfig(size=224)  # cells of 7 and 2 mm
RG2, TIP = grippers.load("rg2"), 0.015  # m
OPEN = RG2.half.open
Box = tuple[float, float, float, float]  # centre x, y, sides along x, y, m


def _height(cfg: HeightmapConfig, *boxes: Box, top: float = 0.05) -> jax.Array:
    """Draws boxes [H, W] m."""
    height, centres = np.zeros((cfg.size, cfg.size), np.float32), np.asarray(cell_centres(cfg))
    for x, y, *sides in boxes:
        height[(np.abs(centres - [x, y]) < 0.5 * np.array(sides)).all(axis=-1)] = top
    return jnp.asarray(height)


@functools.cache
def _compiled(cfg: HeightmapConfig, gripper: str) -> Callable[[jax.Array, jax.Array], Fit]:
    hand = grippers.load(gripper)
    return jax.jit(lambda height, place: fit.fit(cfg, height, place, TIP, hand, hand.fingers))


def _fit(cfg: HeightmapConfig, height: jax.Array, *pose: float, gripper: str = "rg2") -> Fit:
    return _compiled(cfg, gripper)(height, jnp.array(pose or (0.0, 0.0, 0.0), jnp.float32))


def _walls(x: float, clear: float) -> list[Box]:
    """Places a wall on both sides of `x` m, with faces `clear` m from it."""
    return [(x + way * (clear + 0.05), 0.0, 0.1, 0.1) for way in (-1.0, 1.0)]


@pytest.mark.parametrize("cfg", MAPS)
@pytest.mark.parametrize("side", [0.042, 0.098])  # m, whole cells of both maps
@pytest.mark.parametrize("yaw", [0.0, np.pi])
def test_hand_moves_to_the_middle_of_a_cube(cfg: HeightmapConfig, side: float, yaw: float):
    """Claim: over a cube off the middle, whatever its neighbours, the hand moves to its middle and
    opens ROOM wider on both sides, within half a cell; at most fully."""
    x = 0.014
    height = _height(cfg, (x, 0.0, side, side), *_walls(x, 0.5 * side + 0.028))
    moved = _fit(cfg, height, 0.0, 0.0, yaw)
    assert moved.shift == pytest.approx(np.cos(yaw) * x, abs=0.5 * cfg.cell)
    assert moved.half == pytest.approx(min(0.5 * side + fit.ROOM, OPEN), abs=0.5 * cfg.cell)


@pytest.mark.parametrize("cfg", MAPS)
def test_cube_in_the_middle_counts(cfg: HeightmapConfig):
    """Claim: of two cubes between the fingers, the one in the middle is grasped; where the middle
    is bare, both are; a gap of a cell is none."""
    cubes = [(x, 0.0, 0.028, 0.028) for x in (0.0, 0.056)]
    one = _fit(cfg, _height(cfg, *cubes))
    assert one.shift == pytest.approx(0.0, abs=0.5 * cfg.cell)
    assert one.half == pytest.approx(0.014 + fit.ROOM, abs=0.5 * cfg.cell)
    both = _fit(cfg, _height(cfg, *cubes, *_walls(0.028, 0.07)), 0.028, 0.0, 0.0)
    assert both.shift == pytest.approx(0.0, abs=0.5 * cfg.cell)
    assert both.half == pytest.approx(0.042 + fit.ROOM, abs=0.5 * cfg.cell)
    bridged = _height(cfg, (0.0, 0.0, 0.028, 0.028), (0.028 + cfg.cell, 0.0, 0.028, 0.028))
    assert _fit(cfg, bridged).shift == pytest.approx(0.5 * (0.028 + cfg.cell), abs=0.5 * cfg.cell)


def test_fingers_come_down_on_free_ground():
    """Claim: beside a neighbour on which a finger would come down, the hand opens fully in place
    and encloses both; if those fingers would come down on another, it fits all the same."""
    cfg = MAPS[1]
    cube, near, far = (0.007, 0.0, 0.028, 0.1), (0.04, 0.0, 0.014, 0.1), (0.063, 0.0, 0.014, 0.1)
    np.testing.assert_allclose(_fit(cfg, _height(cfg, cube, near)), [0.0, OPEN], rtol=1e-6)
    wanted = 0.007, 0.014 + fit.ROOM
    np.testing.assert_allclose(
        _fit(cfg, _height(cfg, cube, near, far)), wanted, atol=0.5 * cfg.cell
    )


@pytest.mark.parametrize(
    ("clear", "room"), [(0.026, 0.01), (0.02, 0.006), (0.016, 0.003), (0.012, 0.01)]
)
def test_hand_opens_less_where_it_is_narrow(clear: float, room: float):
    """Claim: beside walls `clear` m from a cube the hand opens the widest of ROOM and LESS_ROOM
    that leaves its fingers of 12 mm free; where none does, ROOM."""
    cfg = MAPS[1]
    half = _fit(cfg, _height(cfg, (0.0, 0.0, 0.028, 0.028), *_walls(0.0, 0.014 + clear))).half
    assert half == pytest.approx(0.014 + room, abs=0.2 * cfg.cell)


@pytest.mark.parametrize("gripper", ["rg2", "2f85", "franka_hand"])
def test_nothing_and_too_wide_change_nothing(gripper: str):
    """Claim: over bare ground, over what is no higher than the tips and over what is wider than the
    hand, it opens fully where it is."""
    cfg = MAPS[0]
    low, wide = _height(cfg, (0.0, 0.0, 0.04, 0.04), top=0.01), _height(cfg, (0.02, 0.0, 0.2, 0.2))
    for height in (_height(cfg), low, wide):
        kept = _fit(cfg, height, 0.0, 0.0, 0.3, gripper=gripper)
        np.testing.assert_allclose(kept, [0.0, grippers.load(gripper).half.open], rtol=1e-6)


@pytest.mark.parametrize("gripper", ["2f85", "rg2", "varied"])
def test_one_rule_for_one_and_many(gripper: str):
    """Claim: jit and vmap decide as one grasp alone; openings lie within the hand's, also for
    fingers that vary, at the map's border, and on maps of noise."""
    cfg, hand = MAPS[0], grippers.load(gripper)
    rng = np.random.default_rng(0)
    height = rng.uniform(0.0, 0.05, (16, cfg.size, cfg.size)) * (rng.random((16, 1, 1)) < 0.8)
    height[::2] *= np.asarray(_height(cfg, (0.01, 0.0, 0.05, 0.3)))[None] > 0.0
    pose = rng.uniform(-0.224, 0.224, (16, 3))
    least, most = hand.varies or (hand.fingers, hand.fingers)
    fingers = Fingers(*(rng.uniform(low, high, 16) for low, high in zip(least, most, strict=True)))
    many = jax.tree.map(jnp.float32, (height, pose, np.full(16, TIP), fingers))

    def one(height: jax.Array, pose: jax.Array, tip: jax.Array, fingers: Fingers) -> Fit:
        return fit.fit(cfg, height, pose, tip, hand, fingers)

    found = jax.jit(jax.vmap(one))(*many)
    alone = [one(*jax.tree.map(lambda leaf, i=i: leaf[i], many)) for i in range(4)]
    np.testing.assert_allclose(np.stack(found)[:, :4], np.transpose(alone), atol=1e-6)
    assert (np.abs(found.shift) <= 0.5 * fingers.opening + cfg.cell).all()
    assert (found.half >= hand.half.closed).all()
    assert (found.half <= 0.5 * fingers.opening + 1e-6).all()


@pytest.mark.parametrize("gripper", ["rg2", "franka_hand"])
def test_maps_agree_with_each_grasp(gripper: str):
    """Claim: the maps of all cells have the width and the middle that a grasp at each cell finds,
    and heights beside it as of the boxes drawn."""
    cfg, hand = HeightmapConfig(size=112), grippers.load(gripper)
    boxes = [(-0.102, 0.1, 0.028, 0.04), (0.08, -0.1, 0.04, 0.1), (0.132, -0.1, 0.04, 0.1)]
    height = _height(cfg, *boxes)
    seen = jax.jit(lambda height: fit.everywhere(cfg.cell, height, 0.03, TIP, hand, hand.fingers))
    half, shift, side, landing = np.moveaxis(np.asarray(seen(height[None])[0]), -1, 0)
    for x, y, length, _ in boxes:
        row, col = (int(at // cfg.cell) + cfg.size // 2 for at in (y, x))
        at = cfg.cell * (np.array([col, row]) + 0.5 - 0.5 * cfg.size)
        found = _fit(cfg, height, *at, 0.0, gripper=gripper)
        assert half[row, col] == pytest.approx(0.5 * length, abs=0.5 * cfg.cell)
        assert shift[row, col] == pytest.approx(abs(x - at[0]), abs=0.5 * cfg.cell)
        assert side[row, col] == pytest.approx(0.05 - 0.02, abs=1e-6)  # 30 mm below the top
        close = abs(y + 0.1) < 0.01  # two of them stand 12 mm from one another
        assert landing[row, col] == pytest.approx(0.03 if close else 0.0, abs=1e-6)
        if not close:
            assert found.half == pytest.approx(half[row, col] + fit.ROOM, abs=0.5 * cfg.cell)
    assert not half[:16].any()  # bare table
    turned = seen(height[None, ::-1, ::-1])[0, ::-1, ::-1]
    np.testing.assert_array_equal(turned, np.stack([half, shift, side, landing], axis=-1))


@pytest.mark.parametrize("opening", ["full", "fit"])
def test_plan_follows_the_setting(opening: str):
    """Claim: with `fit` a grasp comes down about the cube; with `full` as decided, fully open. A
    push is the same with both."""
    cfg = MAPS[0]
    sim = SimConfig(opening=opening)
    height = _height(cfg, (0.014, 0.0, 0.042, 0.042), *_walls(0.014, 0.05))
    plan = jax.jit(functools.partial(primitives.plan, sim, cfg))
    grasp = plan(height, Action.grasp(0.0, 0.0, 0.0))
    x, half = (0.014, 0.021 + fit.ROOM) if opening == "fit" else (0.0, OPEN)
    descent = np.asarray(grasp.control[: sim.grasp_phases[0]])
    np.testing.assert_allclose(descent[:, 0], x, atol=0.5 * cfg.cell)
    np.testing.assert_allclose(descent[:, 4], half, atol=0.5 * cfg.cell)
    np.testing.assert_array_equal(grasp.start[jnp.array([0, 1, 4])], descent[0, [0, 1, 4]])
    push = plan(height, Action.push(0.0, 0.0, 0.0))
    full = primitives.plan(SimConfig(opening="full"), cfg, height, Action.push(0.0, 0.0, 0.0))
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-6), push, full)
