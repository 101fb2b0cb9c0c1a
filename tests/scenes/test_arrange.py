"""Drawn arrangements against C MuJoCo: contacts, distances, and half a second of physics."""

import functools
from collections import Counter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax.config import MESH_KINDS, HeightmapConfig, SceneConfig, SimConfig
from csac_jax.errors import SceneError
from csac_jax.scenes import arrange, cases, packings
from csac_jax.world import blocks, model, scene_state
from csac_jax.world.scene_state import SceneState
from tests.world import placed

KEYS = 200  # of arrangements, the same at every level
EACH = 7  # keys of each family whose arrangements are simulated
COUNT = EACH * len(packings.FAMILIES)
LEVELS = (0.0, 0.5, 1.0)
PAIRS = ("arch", "arch", "prism", "prism", "cylinder", "cylinder")
MANY = SceneConfig(slots=("box",) * 6 + PAIRS, min_blocks=5)
BOXES = SceneConfig(slots=("box",) * 5, min_blocks=4, size_jitter=(0.25, 0.25))
# The usual square, and the smallest.
EXTENT = {MANY: HeightmapConfig().extent, BOXES: 2.0 * (arrange.RADIUS + 0.001)}
FAR = 0.08  # m, distances are measured up to here
STACKED = ("wall", "bridge", "tower")  # families with blocks on top of others
TOGETHER = 0.012  # m, blocks closer than this make a cluster; loose ones keep 15 mm


class Drawn(NamedTuple):
    """Arrangements, COUNT for each level in turn, measured in C MuJoCo. P = 3 COUNT."""

    cfg: SceneConfig
    every: SceneState  # leaves [3, KEYS, N, ...], NumPy
    families: np.ndarray  # [KEYS] str
    family: np.ndarray  # [P] str
    scenes: SceneState  # leaves [P, N, ...], NumPy
    reach: np.ndarray  # [P] m, largest |x| or |y| of a corner
    lowest: np.ndarray  # [P] m, of a corner
    overlap: np.ndarray  # [P] m, deepest contact
    distance: np.ndarray  # [P, N, N] m between blocks in play, FAR where farther or not in play
    moved: np.ndarray  # [P] m, farthest that a block has moved after half a second

    def at(self, level: float) -> slice:
        """Returns the scenes of this level."""
        first = LEVELS.index(level) * COUNT
        return slice(first, first + COUNT)


def _many(cfg: SceneConfig, extent: float, keys: jax.Array, levels: jax.Array) -> SceneState:
    draw = jax.vmap(lambda key, level: arrange.arrange(key, cfg, extent, level))
    return jax.device_get(jax.jit(draw)(keys, levels))


def _names(cfg: SceneConfig, keys: jax.Array) -> np.ndarray:
    """Returns the families that `arrange` draws with these keys."""
    names = np.array(list(packings.available(cfg.slots)))
    drawn = jax.vmap(lambda key: jax.random.split(key, 6)[1])(keys)
    number = jax.vmap(lambda key: jax.random.randint(key, (), 0, len(names)))
    return names[np.asarray(number(drawn))]


def _measured(world: model.World, scene: SceneState, fields: model.BlockFields) -> tuple:
    """Measures reach, lowest, overlap, distance and moved of one scene."""
    exact, data = placed.in_c(world, scene, fields, iterations=20)
    pairs = zip(world.block_geoms, world.parts.slot, strict=True)
    geoms = [(geom, slot) for geom, slot in pairs if scene.in_play[slot]]
    corners = np.concatenate([placed.corners(exact, data, geom) for geom, _ in geoms])
    deepest = max(0.0, -data.contact.dist.min()) if data.ncon else 0.0
    distance = _distances(exact, data, geoms, len(world.slots))
    mujoco.mj_step(exact, data, nstep=round(0.5 / exact.opt.timestep))
    moved = (data.qpos[world.block_qpos[:, :3]] - scene.position)[scene.in_play]
    farthest = np.linalg.norm(moved, axis=1).max()
    return np.abs(corners[:, :2]).max(), corners[:, 2].min(), deepest, distance, farthest


def _distances(exact: mujoco.MjModel, data: mujoco.MjData, geoms: list, num: int) -> np.ndarray:
    distance = np.full((num, num), FAR)
    for i, (one, slot) in enumerate(geoms):
        for two, other in geoms[:i]:
            if slot != other:
                gap = mujoco.mj_geomDistance(exact, data, one, two, FAR, None)
                distance[slot, other] = distance[other, slot] = min(distance[slot, other], gap)
    return distance


def _examined(cfg: SceneConfig, scenes: SceneState) -> tuple:
    """Measures each scene, leaves [P, ...]."""
    world = model.build(cfg, SimConfig())
    fields = jax.device_get(jax.jit(jax.vmap(functools.partial(model.scene_fields, world)))(scenes))
    rows = (
        _measured(world, *jax.tree.map(lambda leaf, i=i: leaf[i], (scenes, fields)))
        for i in range(len(scenes.target))
    )
    return tuple(np.stack(column) for column in zip(*rows, strict=True))


@pytest.fixture(scope="module", params=["many", pytest.param("boxes", marks=pytest.mark.slow)])
def drawn(request: pytest.FixtureRequest) -> Drawn:
    """Draws arrangements of many kinds in the usual square; of five boxes in the smallest."""
    cfg = MANY if request.param == "many" else BOXES
    keys = jax.random.split(jax.random.key(0), KEYS)
    pairs = jnp.tile(keys, len(LEVELS)), jnp.repeat(jnp.float32(LEVELS), KEYS)
    drawn = _many(cfg, EXTENT[cfg], *pairs)
    every = jax.tree.map(lambda leaf: leaf.reshape(len(LEVELS), KEYS, *leaf.shape[1:]), drawn)
    names = _names(cfg, keys)
    first = np.concatenate([np.flatnonzero(names == name)[:EACH] for name in packings.FAMILIES])
    scenes = jax.tree.map(lambda leaf: np.concatenate(leaf[:, first]), every)
    family = np.tile(names[first], len(LEVELS))
    return Drawn(cfg, every, names, family, scenes, *_examined(cfg, scenes))


def test_every_family_settles(drawn: Drawn):
    """Claim: in every family no two blocks overlap deeper than 1 mm, all lie on the table inside
    the square, and none moves by 5 mm in half a second. The others are parked."""
    assert Counter(drawn.family) == dict.fromkeys(packings.FAMILIES, EACH * len(LEVELS))
    assert drawn.overlap.max() < 0.001
    assert drawn.lowest.min() > -0.001
    assert 0.48 * EXTENT[drawn.cfg] < drawn.reach.max() <= 0.5 * EXTENT[drawn.cfg]
    assert drawn.moved.max() < 0.005
    out = ~drawn.scenes.in_play
    places = np.broadcast_to(scene_state.parking(out.shape[1]), drawn.scenes.position.shape)
    np.testing.assert_array_equal(drawn.scenes.position[out], places[out])


def test_level_packs_more_and_closer(drawn: Drawn):
    """Claim: the level closes the gaps from at most 40 mm to 1 mm, and adds blocks where there are
    more."""
    nearest = drawn.distance[np.arange(len(drawn.reach)), drawn.scenes.target].min(axis=1)
    nearest[np.isin(drawn.family, STACKED)] = np.nan  # their blocks touch at every level
    for level, low, high in ((0.0, 0.019, 0.042), (0.5, 0.009, 0.022), (1.0, 0.0, 0.004)):
        assert low < np.nanmedian(nearest[drawn.at(level)]) < high, level
    number = [drawn.scenes.in_play[drawn.at(level)].sum(axis=1).mean() for level in LEVELS]
    assert drawn.cfg is BOXES or number[0] + 0.2 < number[1] < number[2] - 0.2, number


def test_target_has_neighbours_on_two_sides(drawn: Drawn):
    """Claim: the target is in play, and two other blocks at least are within 55 mm of it. With room
    in the square, `min_blocks` are in play."""
    rows = np.arange(len(drawn.reach))
    assert drawn.scenes.in_play[rows, drawn.scenes.target].all()
    assert ((drawn.distance[rows, drawn.scenes.target] < 0.055).sum(axis=1) >= 2).all()
    assert (drawn.scenes.in_play.sum(axis=1) >= drawn.cfg.min_blocks).mean() > 0.99


def _assert_fills(values: np.ndarray, low: float, high: float) -> None:
    """Fails unless values keep to a range and fill it."""
    slack, end = 1e-5 * high, 0.05 * (high - low)
    assert low - slack <= values.min() < low + end
    assert high - end < values.max() <= high + slack


def test_what_is_drawn_spreads_over_its_range(drawn: Drawn):
    """Claim: box slots draw every shape, sizes, densities and frictions keep to their ranges and
    fill them. Mesh blocks of one kind share their size in a scene, as the physics asks."""
    cfg, scenes = drawn.cfg, jax.tree.map(np.concatenate, drawn.every)
    box = np.array(cfg.slots) == "box"
    scale = scenes.half_size[:, box, None] / blocks.half_size_choices("box")  # [P, boxes, 4, 3]
    spread = np.ptp(scale, axis=3)
    shape = np.argmin(spread, axis=2)
    assert spread.min(axis=2).max() < 1e-5  # a shape of the set, as a whole larger or smaller
    assert np.bincount(shape.ravel(), minlength=4).min() > 0.1 * shape.size
    nominal = np.array([blocks.half_size_choices(kind)[0][2] for kind in cfg.slots])
    sizes = np.take_along_axis(scale.mean(axis=3), shape[..., None], axis=2).ravel()
    others = (scenes.half_size[..., 2] / nominal)[:, ~box].ravel()
    jitter = cfg.size_jitter[0]
    _assert_fills(np.concatenate([sizes, others]), 1.0 - jitter, 1.0 + jitter)
    _assert_fills(scenes.density, *cfg.density)
    _assert_fills(scenes.friction, *cfg.friction)
    alike = max(np.bincount(row).max() for row in scenes.colour)
    assert alike == np.ceil(len(cfg.slots) / len(blocks.COLOURS))
    for kind in MESH_KINDS:
        height = scenes.half_size[:, np.array(cfg.slots) == kind, 2]
        assert height.size == 0 or np.ptp(height, axis=1).max() == 0.0


def _clusters(slots: tuple, distance: np.ndarray) -> list[Counter]:
    """Counts the kinds in every cluster of blocks closer than TOGETHER to one another."""
    near = distance < TOGETHER
    reached = np.eye(len(slots), dtype=bool)
    for _ in slots:
        reached = reached | (reached @ near)
    rows = (np.flatnonzero(row) for row in np.unique(reached, axis=0) if row.sum() > 1)
    return [Counter(slots[i] for i in row) for row in rows]


def test_shipped_cases_are_held_out(drawn: Drawn):
    """Claim: what a shipped case packs together is packed together in no drawn arrangement, not
    even the kinds."""
    slots = MANY.slots
    if drawn.cfg.slots != slots:
        pytest.skip("five boxes cannot make a shipped case")
    held_out = []
    for case in map(cases.load, map(cases.shipped, cases.names())):
        alone = jax.tree.map(lambda leaf: np.asarray(leaf)[None], case.scene)
        _, _, _, (row,), _ = _examined(SceneConfig(slots=case.slots, min_blocks=1), alone)
        held_out.append(max(_clusters(case.slots, row), key=Counter.total))
    assert sorted(cluster.total() for cluster in held_out) == [2, 3, 4, 5]
    clusters = [cluster for row in drawn.distance for cluster in _clusters(slots, row)]
    assert sum(cluster.total() >= 3 for cluster in clusters) > COUNT
    assert not [cluster for cluster in clusters if cluster in held_out]
    assert max(cluster["arch"] for cluster in clusters) == 1


def test_settings_that_allow_none_are_an_error():
    """Claim: slots that allow no family, or a square that is too small, name the field."""
    for slots in (("box",), ("box", "box"), ("prism", "prism", "arch"), ("arch", "arch", "box")):
        with pytest.raises(SceneError, match=r"scene\.slots: too few for an arrangement"):
            packings.available(slots)
    with pytest.raises(ValueError, match=r"heightmap\.extent: .* at least 0\.412 m"):
        arrange.arrange(jax.random.key(0), MANY, 0.4, jnp.float32(0.5))
