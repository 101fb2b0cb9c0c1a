"""The tray: walls that hold blocks, in every place that knows of them."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.agent import maps
from csac_jax.config import TRAY_WALL, SceneConfig
from csac_jax.constants import Primitive
from csac_jax.env import Env, State
from csac_jax.nets import networks
from csac_jax.robot.primitives import Action
from csac_jax.scenes import pool
from csac_jax.sim import physics as simulation
from csac_jax.vision import observe
from csac_jax.world import model, scene_state, tray
from tests.vision import mujoco_rays
from tests.world import placed

pytestmark = pytest.mark.mjx

SIDE = 0.28
SCENE = SceneConfig(slots=("box", "cylinder"), min_blocks=1, tray=SIDE)
CFG = presets.smoke().change(scene=SCENE, sim={"physics": "c", "grasp_phases": (60, 50, 80)})
HALF = (0.03, 0.02, 0.02)  # m, of the box


def _scene(x: float, y: float) -> scene_state.SceneState:
    """One box of sides 6 x 4 x 4 cm on the floor."""
    scene = scene_state.parked(SCENE.slots)
    position, half_size, in_play = (
        leaf.copy() for leaf in (scene.position, scene.half_size, scene.in_play)
    )
    position[0], half_size[0], in_play[0] = (x, y, HALF[2]), HALF, True
    return scene.replace(position=position, half_size=half_size, in_play=in_play)


@functools.cache
def _world() -> model.World:
    return model.build(CFG.scene, CFG.sim)


def test_walls_are_those_of_the_model():
    """Claim: the walls enclose a square of that inner side, 1 cm thick and 5 cm high, closed at the
    corners; they meet hand and blocks."""
    exact, data = placed.in_c(_world(), _scene(0.0, 0.0))
    ids = [exact.geom(f"wall{number}").id for number in range(tray.NUMBER)]
    corners = np.concatenate([placed.corners(exact, data, geom) for geom in ids])
    assert np.abs(corners[:, :2]).max() == pytest.approx(0.5 * SIDE + TRAY_WALL[0], abs=1e-6)
    assert (corners[:, 2].min(), corners[:, 2].max()) == pytest.approx((0.0, TRAY_WALL[1]))
    around = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    for angle in around:
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        hit = np.zeros(1, np.int32)
        far = mujoco.mj_ray(exact, data, [0, 0, 0.045], way, None, 1, -1, hit, None)
        assert hit[0] in ids
        assert np.abs(far * way[:2]).max() == pytest.approx(0.5 * SIDE, abs=1e-6)
    hand, block = _world().hand_geoms, _world().block_geoms
    for geom in (*hand, *block):
        meets = exact.geom_contype[geom] & exact.geom_conaffinity[ids]
        assert (meets | (exact.geom_contype[ids] & exact.geom_conaffinity[geom])).all()


def _after(env: Env, scene: scene_state.SceneState, action: Action) -> State:
    return jax.jit(lambda scene, action: env.step(env.reset_to(scene), action))(scene, action)


def test_walls_hold_a_block():
    """Claim: a block that is pushed at a wall stops there; without walls it goes on, and beyond the
    walls it counts as lost."""
    push = Action.push(0.5 * SIDE - 0.155, 0.0, 0.0)
    scene = _scene(0.5 * SIDE - 0.05, 0.0)
    ends = {}
    for side in (SIDE, 0.0):
        cfg = CFG.change(scene={"tray": side})
        world = model.build(cfg.scene, cfg.sim)
        env = Env(cfg, simulation.make(world, cfg.sim), scene)
        state = _after(env, scene, push)
        ends[side] = float(state.scene.position[0, 0]), int(state.info.blocks_lost)
    assert 0.5 * SIDE - 0.03 < ends[SIDE][0] < 0.5 * SIDE - 0.0235
    assert ends[SIDE][1] == 0
    assert ends[0.0][0] > 0.5 * SIDE - 0.0205
    env = Env(CFG, simulation.make(_world(), CFG.sim), scene)
    beyond = _scene(0.5 * SIDE + 0.05, 0.0)
    state = _after(env, beyond, Action.grasp(0.0, 0.0, 0.0))
    assert int(state.info.blocks_lost) == 1


@pytest.mark.parametrize("view", ["ortho", "oblique"])
def test_walls_are_seen(view: str):
    """Claim: height and colour of the walls in the map are those that MuJoCo's rays meet."""
    cfg, scene = CFG.change(heightmap={"size": 128, "view": view}), _scene(0.05, 0.02)
    with mujoco_rays.nominal_meshes():
        world = model.build(cfg.scene, cfg.sim)
    exact, data = mujoco_rays.placed(world, scene)
    seen = jax.device_get(jax.jit(lambda scene: observe.observe(cfg, scene))(scene))
    place = (np.arange(128) - 63.5) * cfg.heightmap.cell
    x, y = (axis.ravel() for axis in np.meshgrid(place, place))
    origins = np.stack([x, y, np.full_like(x, 0.4)], axis=1)
    rays = mujoco_rays.cast(exact, data, origins, np.tile([0.0, 0.0, -1.0], (len(x), 1)))
    height = (0.4 - rays.distance).reshape(128, 128)
    walls = np.isin(rays.geom, [exact.geom(f"wall{i}").id for i in range(4)]).reshape(128, 128)
    wide = 4.0 * SIDE * TRAY_WALL[0] + 4.0 * TRAY_WALL[0] ** 2
    assert walls.sum() * cfg.heightmap.cell**2 == pytest.approx(wide, rel=0.25)
    if view == "ortho":
        np.testing.assert_allclose(seen.height, height, atol=1e-5)
        shade = seen.colour[walls] / tray.COLOUR
        assert np.ptp(shade) < 1e-3  # tops: all lit alike
        return
    near = walls & (place[None] < -0.1)  # the camera's side: seen from above, nothing before it
    assert np.mean(np.abs(seen.height[near] - height[near]) < 0.005) > 0.8
    table = seen.height[~walls & (np.abs(height) < 1e-6)]
    assert np.mean(table < 0.005) > 0.8


@pytest.mark.parametrize("view", ["ortho", "oblique"])
def test_bare_walls_are_no_places_to_act(view: str):
    """Claim: no action begins on a wall or outside; cells of a block at the wall stay."""
    cfg = CFG.change(heightmap={"size": 64, "view": view})
    frames = maps.frames(cfg, networks.make(cfg.net))

    @jax.jit
    def actionable(scene: scene_state.SceneState) -> jax.Array:
        return maps.actionable_cells(frames, observe.observe(cfg, scene))

    def cells(scene: scene_state.SceneState) -> np.ndarray:
        return np.asarray(actionable(scene))

    empty = scene_state.parked(SCENE.slots)
    assert not cells(empty)[Primitive.GRASP].any()
    assert not cells(empty)[Primitive.PUSH].any()
    valid = cells(_scene(0.5 * SIDE - HALF[0], 0.0))
    outside = np.abs(frames.xy).max(axis=-1) > 0.5 * SIDE
    assert not valid[:, outside].any()
    x, y = frames.xy[..., 0], frames.xy[..., 1]
    on_block = (np.abs(x - 0.5 * SIDE + HALF[0]) < HALF[0] - 0.012) & (np.abs(y) < HALF[1] - 0.008)
    assert valid[Primitive.GRASP][on_block].mean() > 0.9
    assert valid[Primitive.PUSH][on_block].mean() > 0.9


def test_scenes_settle_inside_the_tray(tmp_path, monkeypatch: pytest.MonkeyPatch):
    """Claim: dropped blocks come to rest in the tray, and an episode turns it by quarters only."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(pool, "_ROUND", 8)
    cfg = CFG.change(scene={"drop_extent": (0.28, 0.28)})
    scenes = pool.settled(cfg, 3, 6)
    there = scenes.position[scenes.in_play]
    assert len(there) == 6 * (1 + 2)
    assert np.abs(there[:, :2]).max() <= 0.5 * SIDE
    env = Env(cfg, simulation.make(_world(), cfg.sim), scenes)
    first = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), scenes)
    keys = jax.random.split(jax.random.key(0), 16)
    turned = jax.device_get(jax.jit(jax.vmap(env.randomise_pose, (0, None)))(keys, first))
    xy = turned.position[:, first.in_play, :2].reshape(-1, 2)
    place = np.asarray(first.position[first.in_play, :2])
    np.testing.assert_allclose(
        np.sort(np.abs(xy), axis=1), np.tile(np.sort(np.abs(place)), (16, 1)), atol=1e-5
    )
    assert len(np.unique(xy.round(4), axis=0)) == 4
    assert env.any_yaw
