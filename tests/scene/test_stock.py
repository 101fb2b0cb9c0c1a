"""Which objects scenes hold, how they are placed, and the fingerprint of a set of scenes."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from csac_jax.config import Config
from csac_jax.errors import SceneError
from csac_jax.scene import layout, pool, stock
from csac_jax.scene.layout import Scene

KINDS = ("object",) * 5
CONFIG = Config().change(
    scene={
        "slots": KINDS,
        "min_blocks": 5,
        "objects": "made:0:42",
        "drop_extent": (0.3, 0.3),
        "settle_time": 1.0,
    },
    sim={"physics": "c"},
)


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(pool, "_ROUND", 8)


def test_every_scene_draws_its_own_objects():
    """Claim: the objects of a scene are of the split, distinct, and all of them come up."""
    seen = set()
    for seed in range(40):
        scene = pool._drop(CONFIG.scene, np.random.default_rng(seed), 5)
        assert len(set(scene.object_id.tolist())) == 5
        seen |= set(scene.object_id.tolist())
    objects = stock.library(CONFIG.scene).objects
    assert seen == set(range(len(objects)))
    assert not any(one.held_out for one in objects)
    known = stock.table(CONFIG.scene)
    np.testing.assert_array_equal(scene.half_size, known.half[scene.object_id])


def test_few_objects_are_drawn_more_than_once():
    """Claim: where a library has fewer objects than a scene slots, each comes up as often."""
    few = dataclasses.replace(CONFIG.scene, objects="made:0:2", split="all")
    scene = pool._drop(few, np.random.default_rng(0), 5)
    assert sorted(np.bincount(scene.object_id)) == [2, 3]


@pytest.mark.usefixtures("cache")
def test_share_of_objects_side_by_side():
    """Claim: `scene.arranged` of the scenes are objects side by side in the largest square, of
    which some are drawn again where there is no room; the others are dropped, as without."""
    wide = dataclasses.replace(CONFIG.scene, drop_extent=(0.1, 0.3), arranged=0.5, pool=4)
    mixed = pool.scenes(CONFIG.change(scene=wide), 0)
    apart = pool.settled(CONFIG, 0, 2, packed=True)
    np.testing.assert_array_equal(mixed.position[2:], apart.position)
    dropped = pool.settled(CONFIG.change(scene={"drop_extent": (0.1, 0.3)}), 0, 2)
    np.testing.assert_array_equal(mixed.position[:2], dropped.position)


def test_objects_for_which_there_is_no_room_are_drawn_again():
    """Claim: of scenes too narrow for some draws, all stand; one too narrow for any is refused."""
    narrow = dataclasses.replace(CONFIG.scene, drop_extent=(0.21, 0.21))
    rooms = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        assert pool._stand(narrow, rng, 5).in_play.all()
        try:
            stock.packed(rng, narrow, pool._drop(narrow, rng, 5))
            rooms.append(True)
        except SceneError:
            rooms.append(False)
    assert not all(rooms)
    with pytest.raises(SceneError, match="no room"):
        pool._stand(dataclasses.replace(narrow, drop_extent=(0.05, 0.05)), rng, 5)


def test_packed_objects_stand_apart():
    """Claim: packed objects stand on the table as in their files, within the square, outlines GAP
    or more apart."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        scene = stock.packed(rng, CONFIG.scene, pool._drop(CONFIG.scene, rng, 5))
        placed = []
        for slot in range(5):
            one = stock.library(CONFIG.scene).objects[scene.object_id[slot]]
            corners = np.concatenate([part.vertices for part in one.parts])
            yaw = 2.0 * np.arctan2(scene.quaternion[slot, 3], scene.quaternion[slot, 0])
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            corners[:, :2] = corners[:, :2] @ turn.T
            corners += scene.position[slot]
            assert abs(corners[:, 2].min()) < 1e-6
            assert np.abs(corners[:, :2]).max() <= 0.15 + 1e-6
            outline = corners[ConvexHull(corners[:, :2]).vertices, :2]
            for other in placed:  # the origin's distance from the outlines' Minkowski difference
                difference = (outline[:, None] - other[None]).reshape(-1, 2)
                assert ConvexHull(difference).equations[:, 2].max() >= 0.99 * stock.GAP
            placed.append(outline)


def test_packing_without_room_is_refused():
    """Claim: a square too small for the objects is an error in words."""
    small, rng = dataclasses.replace(CONFIG.scene, drop_extent=(0.1, 0.1)), np.random.default_rng(0)
    with pytest.raises(SceneError, match=r"no room for '.*' beside . objects in a square of 0.1 m"):
        stock.packed(rng, small, pool._drop(small, rng, 5))


@pytest.mark.parametrize("how", ["dropped", "poured", "packed"])
def test_settled_objects_are_at_rest(cache: None, how: str):
    """Claim: dropped, poured and packed objects are at rest within the workspace, and come back
    from the cache as they were."""
    flags = {} if how == "dropped" else {how: True}
    scenes = pool.settled(CONFIG, 1, 2, **flags)
    assert np.linalg.norm(scenes.position[:, :, :2], axis=2).max() < 0.5 * CONFIG.heightmap.extent
    assert scenes.object_id.shape == (2, 5)
    if how == "packed":  # most stand where they were put
        high = stock.table(CONFIG.scene)
        low = (high.half - high.centre)[scenes.object_id][:, :, 2]
        assert np.median(np.abs(scenes.position[:, :, 2] - low)) < 1e-3
    again = pool.settled(CONFIG, 1, 2, **flags)
    jax.tree.map(np.testing.assert_array_equal, scenes, again)


def test_fingerprint_names_what_was_drawn():
    """Claim: poses do not count, since they are physics'; another object, density or number of
    scenes does."""

    def drawn(seed: int) -> Scene:
        one = pool._drop(CONFIG.scene, np.random.default_rng(seed), 5)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[None], one)

    scenes, own = drawn(0), stock.fingerprint(CONFIG.scene, drawn(0))
    moved = scenes.replace(position=scenes.position + 1e-9)
    assert stock.fingerprint(CONFIG.scene, moved) == own
    swapped = scenes.replace(object_id=scenes.object_id[:, ::-1])
    heavier = scenes.replace(density=np.nextafter(scenes.density, np.inf, dtype=np.float32))
    for other in (swapped, heavier, drawn(1)):
        assert stock.fingerprint(CONFIG.scene, other) != own


def test_fingerprint_is_the_same_on_every_machine():
    """Claim: the scenes of a seed have this fingerprint, here and elsewhere."""
    drawn = [pool._drop(CONFIG.scene, np.random.default_rng(seed), 5) for seed in range(3)]
    scenes = jax.tree.map(lambda *leaves: np.stack(leaves), *drawn)
    assert stock.fingerprint(CONFIG.scene, scenes)[:16] == "faa06c8544b31104"


def test_parked_slots_have_a_number():
    """Claim: a parked slot of an object has the number of one; scenes of blocks have no numbers."""
    assert layout.parked(KINDS).object_id.tolist() == [0] * 5
    assert layout.parked(("box",)).object_id is None
