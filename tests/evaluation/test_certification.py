"""Certificates: what counts as a scene that needs a push."""

import jax
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.assets import assets
from csac_jax.baselines import planner
from csac_jax.constants import Primitive
from csac_jax.evaluation import certification
from csac_jax.evaluation.certification import Lab
from csac_jax.scenes import certify, constructions
from csac_jax.world.scene_state import SceneState

pytestmark = pytest.mark.mjx

SUITE, SEED = constructions.SUITES["blocked"], 2
CFG = presets.TEN_BLOCKS.change(scene=SUITE, sim={"physics": "c"})
OPENED = 3.0  # friction that marks scenes after a good push


def _scene() -> SceneState:
    return constructions.TRAIN["bars"].make(jax.random.key(SEED))


class Toy:
    """A world without physics: a push to the left opens the scene, in which two yaws lift."""

    def __init__(self, lifts_before: bool = False, loses: bool = False):
        self.lifts_before, self.loses, self.tried = lifts_before, loses, 0

    def lab(self, rows: int = 16) -> Lab:
        return Lab(CFG, lambda scene: np.zeros((8, 8), np.float32), self.trial, rows)

    def trial(self, scenes, heights, actions):
        poses, kind = np.asarray(actions.pose), np.asarray(actions.primitive)
        self.tried += int(np.isfinite(poses).all(axis=1).sum())
        is_grasp = kind == Primitive.GRASP
        left = ~is_grasp & (np.cos(poses[:, 2]) < -0.9)
        opened = scenes.friction[:, 0] == OPENED
        wanted = is_grasp & (poses[:, 2] < 0.5) & (opened | self.lifts_before)
        friction = np.where(left[:, None], np.float32(OPENED), scenes.friction)
        return wanted, left & self.loses, scenes.replace(friction=friction)


@pytest.mark.parametrize("rows", [16, 2048])
def test_first_good_push_is_recorded(rows: int):
    """Claim: the certificate has the first push after which a tenth of the grasps lift and their
    share; the size of the batches does not matter to a scene that is kept."""
    certificate = certification.judge(Toy().lab(rows), _scene(), "bars", SEED)
    pushes = planner.sample_pushes(jax.random.key(SEED), CFG, _scene(), certification.PUSHES)
    assert certificate.push == np.flatnonzero(np.cos(pushes.pose[:, 2]) < -0.9)[0]
    assert certificate[:3] == ("bars", SEED, 0.0)
    assert 0.15 < certificate.after < 0.4  # two of eight yaws, of 100 grasps
    assert round(100 * certificate.after, 6) % 1 == 0


def test_pads_have_the_friction_of_these_scenes():
    """Claim: the grip of a certificate is the config's; scenes are handed on without it."""
    one, two = (
        certification.make_lab(CFG.change(sim={"pad_friction": (value, value)}))
        for value in (0.01, 1.0)
    )
    scene = _scene()
    alone = scene.replace(in_play=scene.in_play & (np.cumsum(scene.in_play) == 1))
    here, wide = alone.position[alone.in_play][0], alone.quaternion[alone.in_play][0]
    yaw = 2.0 * np.arctan2(wide[3], wide[0]) + 0.5 * np.pi  # across the bar
    grasp = np.float32([[here[0], here[1], yaw]])
    (slips, _, after), *_ = certification._batches(one, [(alone, grasp)])
    (holds, _, _), *_ = certification._batches(two, [(alone, grasp)])
    assert (slips[0], holds[0]) == (False, True)
    assert after.grip is None


def test_scene_that_is_easy_is_refused_at_once():
    """Claim: a scene is refused as soon as more than 1 % of its grasps are sure to lift."""
    toy = Toy(lifts_before=True)
    certificate = certification.judge(toy.lab(), _scene(), "bars", SEED)
    total = len(certification.grid(np.random.default_rng(0), _scene()))
    assert certificate.push == -1
    assert certificate.before > 0.01
    assert toy.tried < total / 4


def test_push_that_loses_a_block_does_not_count():
    """Claim: no push that loses a block certifies a scene; the scene is refused."""
    assert certification.judge(Toy(loses=True).lab(), _scene(), "bars", SEED).push == -1


def test_grid_covers_the_wanted_blocks():
    """Claim: grasps lie 12 mm apart at eight yaws, all over the blocks and nowhere else; with a
    target, over it and one step around."""
    scene, rng = _scene(), np.random.default_rng(0)
    poses = certification.grid(rng, scene)
    places = np.unique(poses[:, :2], axis=0)
    assert len(poses) == 8 * len(places)
    area = 4.0 * np.sum(scene.half_size[scene.in_play, 0] * scene.half_size[scene.in_play, 1])
    np.testing.assert_allclose(len(places) * 0.012**2, area, rtol=0.15)
    slot = int(np.flatnonzero(scene.in_play)[0])
    aimed = certification.grid(rng, scene.replace(target=np.int32(slot)))
    around = scene.half_size[slot, :2] + 0.012
    yaw = 2.0 * np.arctan2(scene.quaternion[slot, 3], scene.quaternion[slot, 0])
    away = aimed[:, :2] - scene.position[slot, :2]
    cos, sin = np.cos(yaw), np.sin(yaw)
    local = np.abs(away @ np.array([[cos, -sin], [sin, cos]]))
    assert np.all(local <= around + 1e-6)
    assert np.all(local.max(axis=0) > around - 0.012)


@pytest.mark.slow
def test_a_scene_that_ships_is_certified_again():
    """Claim: in C MuJoCo a scene of the package gets a certificate, twice the same, with the stored
    share before a push."""
    stored = certify.load(assets() / "certified" / "enclosed-train.npz")
    known = next(one for one in stored.kept if one.generator == "dock")
    scene_cfg = constructions.SUITES["enclosed"]
    lab = certification.make_lab(CFG.change(scene=scene_cfg, sim=constructions.SIM))
    one, two = (certification.judge(lab, stored.entries[known], *known[:2]) for _ in range(2))
    assert one == two
    assert one.push >= 0
    assert one.before <= 0.01 < 0.1 <= one.after
    assert one.before == pytest.approx(known.before, abs=0.005)
