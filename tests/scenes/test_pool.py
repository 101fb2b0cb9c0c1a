"""Settled scenes in C MuJoCo, and their cache."""

import math
import os
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from scipy import stats

from csac_jax import presets
from csac_jax.config import Config, SceneConfig, SimConfig
from csac_jax.env import MAX_FAILURES, make_env
from csac_jax.errors import SceneError, SettingsError
from csac_jax.scenes import arrange, certify, constructions, pool
from csac_jax.world import blocks, model, scene_state
from csac_jax.world.scene_state import SceneState, parking
from tests.world import placed

SCENE = SceneConfig(slots=("box", "arch", "prism", "half_cylinder"), min_blocks=3)
CONFIG = Config(scene=SCENE)
EXTENT = CONFIG.heightmap.extent
COUNT = 24  # of 3 blocks, and as many of 4


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> SceneState:
    """Settles COUNT scenes of each number of blocks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("pool")))
        return pool.settled(CONFIG, pool.TRAIN_STREAM, COUNT)


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Returns a cache of its own, with small rounds."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(pool, "_ROUND", 8)
    return tmp_path


@pytest.fixture
def small(cache: Path) -> Config:
    """Returns one block, so that settling takes no time."""
    return Config(scene=SceneConfig(slots=("box",), min_blocks=1))


def _assert_same(one: SceneState, two: SceneState) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, two)
    dtypes = [[leaf.dtype for leaf in jax.tree.leaves(each)] for each in (one, two)]
    assert dtypes[0] == dtypes[1]


def _assert_at_rest(world: model.World, scenes: SceneState) -> int:
    """Fails where blocks overlap or move; returns the number of contacts between blocks."""
    touching = 0
    for index in range(len(scenes.position)):
        exact, data = placed.in_c(world, jax.tree.map(lambda leaf, i=index: leaf[i], scenes))
        assert data.contact.dist.min() > -0.002, f"scene {index}"
        touching += np.sum(np.isin(data.contact.geom, world.block_geoms).all(axis=1))
        mujoco.mj_step(exact, data, nstep=round(0.5 / exact.opt.timestep))
        moved = np.linalg.norm(data.qpos[world.block_qpos[:, :3]] - scenes.position[index], axis=1)
        assert moved.max() < 0.5 * scene_state.STILL, f"scene {index}: {moved}"
    return touching


def _spy(monkeypatch: pytest.MonkeyPatch, module, name: str, note) -> None:
    """Calls `note` with the name and the arguments before a function."""
    original = getattr(module, name)
    monkeypatch.setattr(module, name, lambda *args: [note(name, *args), original(*args)][1])


def test_few_scenes_fall_that_are_not_needed(small: Config, monkeypatch: pytest.MonkeyPatch):
    """Claim: of a round as many scenes fall as are asked for, and at least one on each core; the
    scenes are the first of those of a larger pool. No two pools of a stream share a scene."""
    fallen: list[str] = []
    many = pool.settled(small, pool.TRAIN_STREAM, 6)
    _spy(monkeypatch, pool, "rest", lambda name, *_: fallen.append(name))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    few = pool.settled(small, pool.TRAIN_STREAM, 3)
    assert len(fallen) == 3
    _assert_same(few, jax.tree.map(lambda leaf: leaf[:3], many))
    assert len(pool.settled(small, pool.TRAIN_STREAM, 1).position) == 1
    assert len(fallen) == 3 + 2
    both = many.position, pool.settled(small, 1, 6).position
    assert len({scene.tobytes() for scenes in both for scene in scenes}) == 12


def test_settled_blocks_are_at_rest(scenes: SceneState):
    """Claim: half a second later no block of a settled scene is farther than its speed allows; none
    overlaps another or the table by 2 mm. Blocks in play lie within extent / 2 of the centre, above
    the table; the others are parked."""
    touching = _assert_at_rest(model.build(SCENE, SimConfig()), scenes)
    assert touching > 0  # some lie on others, else there was nothing to see
    play = scenes.in_play
    assert np.hypot(*scenes.position[play][:, :2].T).max() <= 0.5 * EXTENT
    assert scenes.position[play][:, 2].min() > 0.0
    np.testing.assert_array_equal(play.sum(axis=1), np.repeat([3, 4], COUNT))
    places = np.broadcast_to(parking(4), scenes.position.shape)
    np.testing.assert_array_equal(scenes.position[~play], places[~play])


def test_blocks_differ_within_their_ranges(scenes: SceneState):
    """Claim: a box slot draws each of its shapes, and sizes, densities and frictions spread over
    their ranges."""
    scale = scenes.half_size[:, 0, None] / blocks.half_size_choices("box")  # [P, 4, 3]
    shape = np.argmin(np.ptp(scale, axis=2), axis=1)  # the one that all three axes agree on
    assert set(shape) == {0, 1, 2, 3}
    nominal = [blocks.half_size_choices(kind)[0][2] for kind in SCENE.slots[1:]]
    for drawn, (low, high) in (
        (scenes.half_size[:, 1:, 2] / nominal, (0.9, 1.1)),
        (scenes.density, SCENE.density),
        (scenes.friction, SCENE.friction),
    ):
        assert low <= drawn.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < drawn.max() <= high


@pytest.mark.slow
def test_same_arguments_same_scenes(scenes: SceneState, monkeypatch, tmp_path: Path):
    """Claim: the same arguments give the same scenes, bit for bit, also from the cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _assert_same(scenes, pool.settled(CONFIG, pool.TRAIN_STREAM, COUNT))
    monkeypatch.setattr(pool, "_settle", None)  # must not be called
    _assert_same(scenes, pool.settled(CONFIG, pool.TRAIN_STREAM, COUNT))


def test_scenes_are_made_on_the_cpu(cache: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: what is stored was computed on the CPU, also where JAX's own device is a GPU: dropped
    scenes and arranged ones."""
    devices: list[tuple] = []
    for module, name in ((model, "scene_fields"), (arrange, "arrangements")):
        note = lambda name, *_: devices.append((name, jax.config.jax_default_device))  # noqa: E731
        _spy(monkeypatch, module, name, note)
    cfg = SceneConfig(slots=("box",) * 3, min_blocks=3, packed_fraction=0.5)
    pool.scenes(Config(scene=cfg), 5, 4)
    host = jax.devices("cpu")[0]
    assert {*devices} == {("scene_fields", host), ("arrangements", host)}


def test_arrangements_are_kept(cache: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: packed scenes, too, are made once; another stream, number or code has its own."""
    cfg = presets.get("fast").change(scene={"packed_fraction": 1.0, "pool": 6})
    made = pool.scenes(cfg, 0)
    monkeypatch.setattr(pool.arrange, "arrangements", None)  # whatever calls it fails
    _assert_same(made, pool.scenes(cfg, 0))
    for stream, count in ((1, 6), (0, 5)):
        with pytest.raises(TypeError):
            pool.scenes(cfg, stream, count)
    changed = cache / "packings.py"
    changed.write_text("")
    monkeypatch.setattr(pool.packings, "__file__", str(changed))
    with pytest.raises(TypeError):
        pool.scenes(cfg, 0)


def test_damaged_pool_is_settled_anew(small: Config, cache: Path, monkeypatch):
    """Claim: scenes of a damaged file of the cache are settled again, and where it cannot be
    written; a whole one is used, of the cache or the package. Nothing half-written stays. Other
    damage is injected in `tests/faults`."""
    good = pool.settled(small, 0, 4)
    (path,) = cache.rglob("*.npz")
    assert list(path.parent.iterdir()) == [path]
    (cache / "file").touch()
    with monkeypatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache / "file"))
        _assert_same(good, pool.settled(small, 0, 4))
    path.write_bytes(path.read_bytes()[:-100])
    assert pool._read(path) is None
    _assert_same(good, pool.settled(small, 0, 4))
    assert pool._read(path) is not None
    monkeypatch.setattr(pool, "shipped", lambda: path.parent)
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache / "other"))
    monkeypatch.setattr(pool, "_settle", None)  # must not be called
    _assert_same(good, pool.settled(small, 0, 4))


def test_hopeless_configuration_is_one_line(cache: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: a configuration whose blocks never come to rest ends with one line that names what to
    change."""
    monkeypatch.setattr(SceneConfig, "drop_height", 1.0)  # they land after 0.45 s
    falling = SceneConfig(slots=("box",), min_blocks=1, settle_time=0.5)
    with pytest.raises(SceneError, match=r"scene\.settle_time") as error:
        pool.settled(Config(scene=falling), 0, 4)
    assert "\n" not in str(error.value)


def test_blocks_are_dropped_close_together_or_far_apart():
    """Claim: each scene has a square of its own in which its blocks are dropped, its side uniform
    in the range."""
    cfg = SceneConfig(slots=("box",) * 8, min_blocks=8, drop_extent=(0.1, 0.4))
    rng = np.random.default_rng(0)
    reach = np.array([np.abs(pool._drop(cfg, rng, 8).position[:, :2]).max() for _ in range(400)])
    # The largest of 16 uniform numbers in 0 .. half is 16/17 of half in the mean.
    assert stats.kstest(reach * 17 / 16, stats.uniform(0.05, 0.15).cdf).statistic < 0.12
    assert reach.max() <= 0.2


KINDS = ("box", "arch", "prism") * 4
PILE = SceneConfig(slots=KINDS, min_blocks=12, drop_extent=(0.1, 0.1), settle_time=1.0)


@pytest.mark.slow
def test_poured_piles(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Claim: poured blocks are all in play, inside the workspace, at rest, higher than one layer;
    scenes differ, and the same stream gives the same ones."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    scenes = pool.settled(Config(scene=PILE), 1, 3, poured=True)
    assert scenes.in_play.shape == (3, 12)
    assert scenes.in_play.all()
    assert (np.linalg.norm(scenes.position[..., :2], axis=-1) <= 0.5 * EXTENT).all()
    assert (scenes.position[..., 2].max(axis=1) > 0.06).all()
    assert len({scene.tobytes() for scene in scenes.position}) == 3
    _assert_at_rest(model.build(PILE, SimConfig()), scenes)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    again = pool.settled(Config(scene=PILE), 1, 3, poured=True)
    np.testing.assert_array_equal(again.position, scenes.position)


def test_poured_blocks_that_leave_are_dropped_anew():
    """Claim: where a block of nearly every scene falls outside the workspace, pouring still gives
    the scene."""
    cfg = SceneConfig(slots=("box",) * 4, min_blocks=4, drop_extent=(0.448, 0.448), settle_time=1.0)
    world, rng = model.build(cfg, SimConfig()), np.random.default_rng(0)
    for _ in range(6):
        scene = pool._drop(cfg, rng, 4)
        fields = placed.fields_of(world, scene)
        poured = pool.pour(world, Config(scene=cfg), scene, fields)
        assert poured is not None
        assert (np.linalg.norm(poured.position[:, :2], axis=1) <= 0.5 * EXTENT).all()


def test_shipped_scenes_are_what_settling_gives(cache: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: the scenes that `quick` and `fast` train in are shipped, and settling gives the same;
    of another processor, whose last bits differ, nearly all are alike to 2 mm. Where this fails,
    run `python -m experiments.pools`."""
    monkeypatch.setattr(pool, "_ROUND", 24)
    cfg = presets.quick()
    settled = pool.settled(cfg, pool.TRAIN_STREAM, 20)  # the first of those 1,024
    monkeypatch.setattr(pool, "_settle", None)  # must not be called
    monkeypatch.setattr(pool.arrange, "arrangements", None)
    assert len(pool.scenes(presets.fast(), pool.TRAIN_STREAM).position) == 4096
    shipped = pool.scenes(cfg, pool.TRAIN_STREAM)
    assert len(shipped.position) == cfg.scene.pool
    fits = np.abs(settled.position - shipped.position[:20]).max(axis=(1, 2)) < 0.002
    assert fits.mean() > 0.8
    for name in ("half_size", "density", "friction", "colour"):
        ours, theirs = (getattr(each, name)[:20][fits] for each in (settled, shipped))
        np.testing.assert_array_equal(ours, theirs)


def test_certified_scenes_are_the_pool():
    """Claim: with `scene.certified` the pool is every certified scene for training, its blocks in
    slots of their kind, its target among them; the task goes on in another scene."""
    scene = {"slots": ("cylinder", "arch", *("box",) * 6), "certified": ("enclosed",)}
    cfg = presets.get("pushes").change(scene=scene, sim={"physics": "c"})
    drawn = pool.scenes(cfg, pool.TRAIN_STREAM, 1)
    stored = certify.load(certify.shipped("enclosed-train")).scenes
    np.testing.assert_array_equal(drawn.in_play.sum(axis=1), stored.in_play.sum(axis=1))
    rows = np.arange(len(stored.target))
    for leaf in ("position", "half_size", "friction"):
        one, two = (getattr(s, leaf)[rows, s.target] for s in (drawn, stored))
        np.testing.assert_array_equal(one, two)
    kinds = np.array(cfg.scene.slots)
    from_kinds = np.array(constructions.SUITES["enclosed"].slots)
    assert list(kinds[drawn.target]) == list(from_kinds[stored.target])
    assert make_env(cfg).max_failures == MAX_FAILURES


def test_certified_scenes_are_a_share_of_the_pool(cache: Path):
    """Claim: with `scene.certified_fraction` certified scenes are that share of the pool, each as
    often as any other, and known by a flag; the rest is what the pool would be without them. Only
    training has them."""
    certified = {"certified": ("enclosed", "blocked"), "certified_fraction": 0.99}
    slots = {"slots": ("box",) * 5 + ("arch",) * 2, "min_blocks": 7}
    cfg = presets.get("pushes").change(scene=slots | certified, sim={"physics": "c"})
    mixed = pool.scenes(cfg, pool.TRAIN_STREAM, 1000)
    np.testing.assert_array_equal(mixed.certified, np.arange(1000) >= 10)
    rest = pool.scenes(cfg.change(scene={"certified": ()}), pool.TRAIN_STREAM, 10)
    stored = pool.scenes(cfg.change(scene={"certified_fraction": 1.0}), pool.TRAIN_STREAM)
    assert rest.certified is stored.certified is None
    np.testing.assert_array_equal(mixed.position[:10], rest.position)
    rows = [scene.tobytes() for scene in mixed.position[10:]]
    numbers = [rows.count(scene.tobytes()) for scene in stored.position]
    each = 990 / len(numbers)
    assert (min(numbers), max(numbers), sum(numbers)) == (math.floor(each), math.ceil(each), 990)
    assert set(mixed.target[mixed.certified] == scene_state.ANY) == {True, False}
    assert not pool.scenes(cfg, 1, 5).certified.any()


def test_blocks_and_objects_share_a_pool(cache: Path):
    """Claim: among slots of blocks and of objects, dropped scenes hold both; packed and certified
    ones are those of the blocks alone, and their objects are parked."""
    slots = ("object", "box", "box", "arch", "object", *("box",) * 4)
    mixed = {"slots": slots, "min_blocks": 9, "objects": "procedural:0:12"}
    shares = {"certified": ("enclosed",), "certified_fraction": 0.25, "packed_fraction": 0.5}
    scene = mixed | shares | {"drop_extent": (0.2, 0.3)}
    cfg = presets.get("pushes").change(scene=scene, sim={"physics": "c"})
    scenes = pool.scenes(cfg, pool.TRAIN_STREAM, 8)
    is_block = ~blocks.is_object(slots)
    np.testing.assert_array_equal(scenes.in_play[:, ~is_block].all(axis=1), np.arange(8) < 3)
    assert not scenes.in_play[3:, ~is_block].any()
    assert len(np.unique(scenes.object_id[:3, ~is_block])) > 3
    alone = {"slots": tuple(np.array(slots)[is_block]), "min_blocks": 7, "objects": ""}
    packed = pool.scenes(cfg.change(scene=alone | {"certified": (), "packed_fraction": 1.0}), 0, 3)
    for ours, theirs in zip(range(3, 6), range(3), strict=True):
        places = [s.position[i][s.in_play[i]] for s, i in ((scenes, ours), (packed, theirs))]
        np.testing.assert_array_equal(*(np.sort(place, axis=0) for place in places))
        marked = (s.position[i][s.target[i]] for s, i in ((scenes, ours), (packed, theirs)))
        np.testing.assert_array_equal(*marked)


@pytest.mark.parametrize(
    ("scene", "line"),
    [
        ({"slots": ("box",) * 3}, r"scene\.slots: enclosed needs [45] of kind box"),
        ({"tray": 0.3}, r"scene\.tray: scenes of enclosed need 0$"),
        ({"certified": ("tray",)}, r"scene\.tray: scenes of tray need 0\.3$"),
    ],
)
def test_certified_scenes_that_do_not_fit(scene: dict, line: str):
    """Claim: slots or a tray that certified scenes do not fit are a one-line error."""
    cfg = presets.get("pushes").change(scene=scene | {"drop_extent": (0.1, 0.2)})
    with pytest.raises(SettingsError, match=line):
        pool.scenes(cfg, pool.TRAIN_STREAM)
