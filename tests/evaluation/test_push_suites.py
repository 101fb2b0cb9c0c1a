"""Suites of scenes that need pushes, of hidden targets, of tight objects, and folders of cases."""

import functools
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax import grippers, presets
from csac_jax.agent import maps
from csac_jax.constants import Primitive
from csac_jax.env import Env
from csac_jax.errors import SceneError
from csac_jax.evaluation import policies, rollout, suites
from csac_jax.nets import networks
from csac_jax.objects import tables
from csac_jax.scenes import cases, certify, constructions, pool
from csac_jax.vision import observe
from csac_jax.world import model, object_slots
from csac_jax.world.scene_state import SceneState
from tests.networks import random_params
from tests.vision import mujoco_rays

pytestmark = pytest.mark.mjx

CFG = presets.smoke().change(sim={"physics": "c"})
TARGET = CFG.change(task={"kind": "target"})
EPISODES = 4
FINE = 0.001  # m between the rays of the reference


@functools.cache
def _parts(suite: str) -> dict[str, Env]:
    cfg = TARGET if suites.SUITES[suite].target else CFG
    return suites.prepare(cfg, suite, EPISODES, 0).parts


def _scene(env: Env, row: int) -> SceneState:
    return jax.tree.map(lambda leaf: np.asarray(leaf[row]), env.scenes)


@pytest.mark.parametrize("suite", ["blocked", "enclosed", "tray", "hidden"])
def test_suite_is_built_and_rolls_out(suite: str):
    """Claim: these suites hold the certified scenes of the constructions that test, run with any
    policy and end after two failed grasps in a row."""
    parts = _parts(suite)
    assert set(parts) <= (set(suites.SEEN) if suite == "hidden" else {suite})
    certified = certify.load(certify.shipped(suite))
    assert {constructions.TEST[one.generator].suite for one in certified.kept} == {suite}
    rows = sum(len(env.scenes.target) for env in parts.values())
    assert rows == len(certified.kept) if suite != "hidden" else 10 < rows <= len(certified.kept)
    for env in parts.values():
        assert env.cfg.scene == constructions.SUITES[suite]
        assert env.max_failures == 2
        assert env.cfg.sim.pad_friction == (0.8, 0.8)
        wanted = {"enclosed": ("target", 5), "hidden": ("target", 10)}.get(suite, ("clear", 15))
        assert env.cfg.task.kind == wanted[0]
        assert env.cfg.task.max_actions == max(wanted[1], 15 if suite == "tray" else 0)
    env = next(iter(parts.values()))
    episodes = rollout.rollout(env, policies.RandomPolicy(env.cfg), 2, seed=0)
    assert episodes.valid[:, 0].all()
    assert (episodes.valid.sum(axis=1) >= np.where(episodes.completed, 1, 2)).all()


def _share_in_c(world: model.World, scene: SceneState) -> float:
    """Returns the share of the target's cells from above that MuJoCo's rays meet."""
    exact, data = mujoco_rays.placed(world, scene)
    (geom,) = world.block_geoms[world.parts.slot == scene.target]
    reach = np.linalg.norm(scene.half_size[scene.target, :2])
    ticks = np.arange(-reach, reach, FINE)
    x, y = (axis.ravel() for axis in np.meshgrid(ticks, ticks))
    origins = np.stack([x, y, np.full_like(x, 0.4)], axis=1)
    origins[:, :2] += scene.position[scene.target, :2]
    down = np.tile([0.0, 0.0, -1.0], (len(x), 1))
    seen = mujoco_rays.cast(exact, data, origins, down).geom == geom
    exact.geom_group[:] = 0
    exact.geom_group[geom] = 1
    groups, hit = np.array([0, 1, 0, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
    alone = [mujoco.mj_ray(exact, data, o, down[0], groups, 1, -1, hit, None) for o in origins]
    return float(seen.sum() / np.sum(np.array(alone) >= 0.0))


def test_hidden_shows_what_its_parts_say():
    """Claim: of the target of each scene MuJoCo's rays from above see the share that the part
    names, and the mask shows as much: none where the target is hidden. Cells may miss a sliver."""
    parts = _parts("hidden")
    with mujoco_rays.nominal_meshes():
        world = model.build(next(iter(parts.values())).cfg.scene, CFG.sim)
    fine = next(iter(parts.values())).cfg.change(heightmap={"size": 128})
    look = jax.jit(functools.partial(observe.observe, fine))
    for name, env in parts.items():
        share_seen = jax.jit(functools.partial(observe.seen_share, env.cfg.scene))
        low, high = {"seen_50_100": (0.5, 1.0), "seen_1_50": (0.01, 0.5), "seen_0": (0, 0)}[name]
        for row in range(min(len(env.scenes.target), 4)):
            scene = _scene(env, row)
            share = _share_in_c(world, scene)
            assert low - 0.02 <= share <= high + 0.02, name
            assert float(share_seen(scene)) == pytest.approx(share, abs=0.05)
            mask = np.asarray(look(scene).target)
            assert mask.any() == (name != "seen_0") or 0.0 < share < 0.05


def test_every_policy_searches_for_a_hidden_target():
    """Claim: while nothing of the target is seen, its mask is empty and any block may be grasped;
    every policy acts above a block, and rewards stay finite."""
    env = _parts("hidden")["seen_0"]
    state = env.reset_to(jax.tree.map(jnp.asarray, _scene(env, 0)))
    assert not np.asarray(state.obs.target).any()
    frames = maps.frames(env.cfg, networks.make(env.cfg.net))
    valid = np.asarray(maps.actionable_cells(frames, state.obs))
    every = state.obs.replace(target=jnp.ones_like(state.obs.target))
    np.testing.assert_array_equal(valid, np.asarray(maps.actionable_cells(frames, every)))
    assert valid[Primitive.GRASP].any()
    acting = {
        "random": policies.RandomPolicy(env.cfg),
        "oracle": policies.OraclePolicy(env.cfg),
        "geometric": policies.GeometricPolicy(env.cfg),
        "learned": policies.NetworkPolicy(env.cfg, random_params(env.cfg)),
    }
    step, key = jax.jit(env.step), jax.random.key(3)
    for name, policy in acting.items():
        seen = state
        if name == "learned":
            seen = Env(policy.cfg, env.physics, env.scenes).reset_to(state.scene)
        action = policy(seen, jax.random.clone(key))
        assert np.isfinite(np.asarray(action.pose)).all(), name
        there = np.abs(np.asarray(action.pose[:2]) - np.asarray(state.scene.position)[:, :2])
        assert there[np.asarray(state.scene.in_play)].max(axis=1).min() < 0.11, name
        after = step(state, action)
        assert np.isfinite(np.asarray(after.reward)), name
        assert not bool(after.info.physics_diverged), name


def test_tight_objects_hardly_fit(monkeypatch: pytest.MonkeyPatch):
    """Claim: the middle sides of the objects of `tight` are 0.6 to 0.95 of the opening of each of
    its two hands, 110 and 80 mm; none that fits is a one-line error."""
    drawn = {}

    def settled(cfg, stream, count, poured, sides):
        scene = pool._drop(cfg.scene, np.random.default_rng(stream), 5, sides)
        drawn[grippers.load(cfg.sim.gripper).opening[1]] = cfg.scene, scene
        return scene

    monkeypatch.setattr(pool, "settled", settled)
    library = "procedural:0:60"
    assert [*suites.prepare(CFG, "tight", 2, objects=library).parts] == ["110_mm", "80_mm"]
    for opening, (scene, state) in drawn.items():
        half = tables.from_library(object_slots.library(scene)).half[state.object_id]
        share = 2.0 * np.sort(half, axis=1)[:, 1] / opening
        assert ((share >= 0.6) & (share <= 0.95)).all()
    assert sorted(drawn) == [0.08, 0.11]
    few = suites.SceneConfig(slots=("object",), min_blocks=1, objects=library)
    with pytest.raises(SceneError, match=r"^none of \d+ objects has a middle side of 0\.9 to 1 m"):
        pool._drop(few, np.random.default_rng(0), 1, (0.9, 1.0))


def test_folder_of_cases(tmp_path: Path):
    """Claim: a folder of case files is a suite, one part for each file; an empty one is refused."""
    for name in ("row", "hole"):
        shutil.copy(cases.shipped(name), tmp_path / f"my_{name}.json")
    (tmp_path / "notes.txt").write_text("no case")
    parts = suites.prepare(CFG, str(tmp_path), EPISODES, 0).parts
    assert [*parts] == ["my_hole", "my_row"]
    for name, env in parts.items():
        wanted = cases.load(cases.shipped(name[3:]), CFG.heightmap.extent)
        assert env.cfg.scene.slots == wanted.slots
        np.testing.assert_array_equal(_scene(env, 0).position, wanted.scene.position)
    (tmp_path / "my_row.json").write_text("{")
    with pytest.raises(ValueError, match=r"my_row\.json: "):
        suites.prepare(CFG, str(tmp_path), EPISODES, 0)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty holds no case file, NAME\.json$"):
        suites.check(str(tmp_path / "empty"))
