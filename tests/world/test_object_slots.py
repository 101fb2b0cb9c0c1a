"""The objects of scenes, their places, and the fingerprint of a set of scenes."""

import contextlib
import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from csac_jax.config import Config
from csac_jax.errors import SceneError
from csac_jax.scenes import pool
from csac_jax.world import object_slots
from csac_jax.world.scene_state import SceneState

KINDS = ("object",) * 5
DROPS = {"min_blocks": 5, "drop_extent": (0.3, 0.3), "settle_time": 1.0}
CONFIG = Config().change(
    scene={"slots": KINDS, "objects": "procedural:0:42", **DROPS}, sim={"physics": "c"}
)


def _drop(seed: int, **changes: object) -> SceneState:
    cfg = dataclasses.replace(CONFIG.scene, **changes)
    return pool._drop(cfg, np.random.default_rng(seed), 5)


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(pool, "_ROUND", 8)


def test_every_scene_draws_its_own_objects():
    """Claim: the objects of a scene are of the split, distinct, and all of them come up; those of a
    library with fewer objects than slots come up as often."""
    seen = set()
    for scene in map(_drop, range(40)):
        assert len(set(scene.object_id.tolist())) == 5
        seen |= set(scene.object_id.tolist())
    objects = object_slots.library(CONFIG.scene).objects
    assert seen == set(range(len(objects)))
    assert not any(member.held_out for member in objects)
    half = object_slots.table(CONFIG.scene).half
    np.testing.assert_array_equal(scene.half_size, half[scene.object_id])
    few = _drop(0, objects="procedural:0:2", split="all")
    assert sorted(np.bincount(few.object_id)) == [2, 3]


@pytest.mark.usefixtures("cache")
def test_share_of_objects_side_by_side():
    """Claim: `scene.packed_fraction` of the scenes are objects side by side in the largest square,
    of which some are drawn again where there is no room; the others are dropped, as without."""
    wide = dataclasses.replace(CONFIG.scene, drop_extent=(0.1, 0.3), packed_fraction=0.5, pool=4)
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
        assert pool._stand(narrow, rng, 5, (0.0, 1.0)).in_play.all()
        with contextlib.suppress(SceneError):
            rooms.append(object_slots.packed(rng, narrow, pool._drop(narrow, rng, 5, (0.0, 1.0))))
    assert len(rooms) < 10
    smallest = dataclasses.replace(narrow, drop_extent=(0.05, 0.05))
    with pytest.raises(SceneError, match=r"no room for '.*' .* in a square of 0\.05 m"):
        pool._stand(smallest, rng, 5, (0.0, 1.0))


def test_packed_objects_stand_apart():
    """Claim: packed objects stand on the table as in their files, within the square, outlines GAP
    or more apart."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        scene = object_slots.packed(rng, CONFIG.scene, pool._drop(CONFIG.scene, rng, 5))
        outlines = []
        for slot in range(5):
            member = object_slots.library(CONFIG.scene).objects[scene.object_id[slot]]
            corners = np.concatenate([part.vertices for part in member.parts])
            turn = Rotation.from_quat(scene.quaternion[slot], scalar_first=True)
            assert not turn.as_rotvec()[:2].any()  # about z
            corners = turn.apply(corners) + scene.position[slot]
            assert abs(corners[:, 2].min()) < 1e-6
            assert np.abs(corners[:, :2]).max() <= 0.15 + 1e-6
            outline = corners[ConvexHull(corners[:, :2]).vertices, :2]
            for other in outlines:  # the origin's distance from the outlines' Minkowski difference
                difference = (outline[:, None] - other[None]).reshape(-1, 2)
                assert ConvexHull(difference).equations[:, 2].max() >= 0.99 * object_slots.GAP
            outlines.append(outline)


@pytest.mark.parametrize("how", ["dropped", "poured", "packed"])
def test_settled_objects_are_at_rest(cache: None, how: str):
    """Claim: dropped, poured and packed objects are at rest within the workspace, and come back
    from the cache as they were."""
    flags = {} if how == "dropped" else {how: True}
    scenes = pool.settled(CONFIG, 1, 2, **flags)
    assert np.linalg.norm(scenes.position[:, :, :2], axis=2).max() < 0.5 * CONFIG.heightmap.extent
    assert scenes.object_id.shape == (2, 5)
    if how == "packed":  # most stand where they were put
        high = object_slots.table(CONFIG.scene)
        low = (high.half - high.centre)[scenes.object_id][:, :, 2]
        assert np.median(np.abs(scenes.position[:, :, 2] - low)) < 1e-3
    again = pool.settled(CONFIG, 1, 2, **flags)
    jax.tree.map(np.testing.assert_array_equal, scenes, again)


def test_fingerprint_names_what_was_drawn():
    """Claim: poses do not count, since they are physics'; another object, density or number of
    scenes does. The scenes of a seed have this fingerprint on every machine."""

    def drawn(*seeds: int) -> SceneState:
        return jax.tree.map(lambda *leaves: np.stack(leaves), *map(_drop, seeds))

    scenes, digest = drawn(0), object_slots.fingerprint(CONFIG.scene, drawn(0))
    moved = scenes.replace(position=scenes.position + 1e-9)
    assert object_slots.fingerprint(CONFIG.scene, moved) == digest
    swapped = scenes.replace(object_id=scenes.object_id[:, ::-1])
    heavier = scenes.replace(density=np.nextafter(scenes.density, np.inf, dtype=np.float32))
    for other in (swapped, heavier, drawn(1), drawn(0, 0)):
        assert object_slots.fingerprint(CONFIG.scene, other) != digest
    assert object_slots.fingerprint(CONFIG.scene, drawn(0, 1, 2))[:16] == "faa06c8544b31104"
