"""Constructions: scenes in which something has to be pushed first."""

import functools
from typing import NamedTuple

import jax
import mujoco
import numpy as np
import pytest

from csac_jax.config import HeightmapConfig, SimConfig
from csac_jax.scenes import constructions
from csac_jax.world import model, scene_state, tray
from csac_jax.world.scene_state import SceneState
from tests.world import placed

EVERY = {**constructions.TRAIN, **constructions.TEST}
SCENES = 6  # of each construction
EXTENT = HeightmapConfig.extent
REST = 0.002  # m, that a block may move or overlap another

pytestmark = pytest.mark.mjx


class Measured(NamedTuple):
    """Scenes of one construction, in C MuJoCo. P = SCENES."""

    scenes: list[SceneState]
    overlap: float  # m, deepest contact
    moved: float  # m, farthest in 1 s
    reach: float  # m, largest |x| or |y| of a corner
    lowest: float  # m, of a corner


@functools.cache
def _world(suite: str) -> model.World:
    return model.build(constructions.SUITES[suite], SimConfig(physics="c"))


@functools.cache
def _fields(suite: str):
    return jax.jit(functools.partial(model.scene_fields, _world(suite)))


def _scenes(name: str) -> list[SceneState]:
    keys = [jax.random.fold_in(jax.random.key(0), number) for number in range(SCENES)]
    return [EVERY[name].make(key) for key in keys]


@pytest.fixture(scope="module", params=list(EVERY))
def measured(request: pytest.FixtureRequest) -> Measured:
    """Draws and measures scenes of each construction."""
    suite, scenes = EVERY[request.param].suite, _scenes(request.param)
    world, rows = _world(suite), []
    for scene in scenes:
        fields = jax.device_get(_fields(suite)(scene))
        exact, data = placed.in_c(world, scene, fields, iterations=20)
        pairs = zip(world.block_geoms, world.parts.slot, strict=True)
        geoms = [geom for geom, slot in pairs if scene.in_play[slot]]
        corners = np.concatenate([placed.corners(exact, data, geom) for geom in geoms])
        deepest = np.max(-data.contact.dist, initial=0.0)
        mujoco.mj_step(exact, data, nstep=round(1.0 / exact.opt.timestep))
        moved = (data.qpos[world.block_qpos[:, :3]] - scene.position)[scene.in_play]
        farthest = np.linalg.norm(moved, axis=1).max()
        rows.append((deepest, farthest, np.abs(corners[:, :2]).max(), -corners[:, 2].min()))
    overlap, moved, reach, below = np.max(rows, axis=0)
    return Measured(scenes, overlap, moved, reach, -below)


def test_construction_rests(measured: Measured):
    """Claim: no block overlaps another, the table or a wall by more than 2 mm, moves more than
    2 mm in a second or lies outside the workspace; others are parked."""
    assert measured.overlap < REST
    assert measured.moved < REST
    assert measured.lowest > -REST
    assert measured.reach <= 0.5 * EXTENT
    for scene in measured.scenes:
        assert scene.in_play.sum() >= 2
        out = ~scene.in_play
        np.testing.assert_array_equal(scene.position[out], scene_state.parking(len(out))[out])


@pytest.mark.parametrize("name", EVERY)
def test_key_decides_all_that_varies(name: str):
    """Claim: the same key gives the same scene, another key another one; suites share slots."""
    scenes, again = _scenes(name), _scenes(name)
    jax.tree.map(np.testing.assert_array_equal, scenes, again)
    cfg = constructions.SUITES[EVERY[name].suite]
    for field in ("position", "half_size", "density", "friction", "colour"):
        assert len({getattr(scene, field).tobytes() for scene in scenes}) == SCENES, field
        assert all(len(getattr(scene, field)) == len(cfg.slots) for scene in scenes)
    for scene in scenes:
        marked = scene.target != scene_state.ANY
        assert marked == (EVERY[name].suite in constructions.WITH_TARGET)
        assert not marked or scene.in_play[scene.target]
        assert cfg.density[0] <= scene.density.min() <= scene.density.max() <= cfg.density[1]


def test_test_shares_nothing_with_training():
    """Claim: at least eight constructions train, six others test, of every suite one at least."""
    train, test = constructions.TRAIN, constructions.TEST
    assert len(train) >= 8
    assert len(test) >= 6
    assert not set(train) & set(test)
    for group in (train, test):
        assert {one.suite for one in group.values()} == set(constructions.SUITES)
    places = [one.make.args[1] for one in EVERY.values()]
    assert len(set(places)) == len(places)


@pytest.mark.parametrize("name", [n for n, one in EVERY.items() if one.suite == "tray"])
def test_blocks_lie_at_the_walls(name: str):
    """Claim: every block of a tray touches a wall or a block that does."""
    (centre, half), walls = tray.walls(constructions.TRAY), 0
    world = _world("tray")
    for scene in _scenes(name):
        exact, _ = placed.in_c(world, scene, jax.device_get(_fields("tray")(scene)))
        near = np.abs(scene.position[scene.in_play, :2]).max(axis=1)
        size = exact.geom_size[[exact.geom(f"wall{i}").id for i in range(tray.NUMBER)]]
        np.testing.assert_allclose(size, half)
        assert near.max() + 0.02 < centre[:, :2].max()
        walls += np.sum(near > 0.5 * constructions.TRAY - 0.05)
    assert walls >= SCENES
