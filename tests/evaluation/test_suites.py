"""The scenes that policies are measured on."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.agent import actor_critic
from csac_jax.config import Config, SensorConfig
from csac_jax.evaluation import policies, suites
from csac_jax.scenes import cases, pool
from csac_jax.world import scene_state

pytestmark = pytest.mark.mjx

CFG = presets.smoke().change(sim={"physics": "c"})
TARGET = CFG.change(task={"kind": "target"})
EPISODES = 5


def _varied(cfg: Config, name: str):
    env = suites.prepare(cfg, "cases", EPISODES, 0).parts[name]
    scene = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), env.scenes)
    keys = jax.random.split(jax.random.key(0), 40)
    return scene, jax.device_get(jax.vmap(env.randomise_pose, (0, None))(keys, scene))


def _blank(cfg: Config, in_play: bool = False):
    """A pool of one scene that is empty, or whose blocks are all in play where they are parked."""
    blank = jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene_state.parked(cfg.scene.slots))
    return blank.replace(in_play=np.full_like(blank.in_play, in_play))


def test_cases_are_the_shipped_files():
    """Claim: the suite `cases` has one part per shipped case, which holds its blocks and nothing
    else."""
    parts = suites.prepare(CFG, "cases", EPISODES, 0).parts
    assert tuple(parts) == cases.names()
    for name, env in parts.items():
        wanted = cases.load(cases.shipped(name), CFG.heightmap.extent)
        scene = jax.tree.map(lambda leaf: leaf[0], env.scenes)
        blocks = json.loads(cases.shipped(name).read_text())["blocks"]
        places = [block["position"] for block in blocks]
        order = [int(np.argmin(np.linalg.norm(scene.position - place, axis=1))) for place in places]
        assert sorted(order) == np.flatnonzero(scene.in_play).tolist()
        assert [env.cfg.scene.slots[slot] for slot in order] == list(wanted.slots)
        for field in ("position", "quaternion", "half_size", "colour"):
            ours, theirs = getattr(scene, field)[order], getattr(wanted.scene, field)
            np.testing.assert_array_equal(ours, theirs)
        assert order[int(wanted.scene.target)] == scene.target
        assert env.cfg.sim.contacts >= 64


def test_worlds_of_training_become_one():
    """Claim: a policy of many hands and grips is measured with the RG2 and its own grip; one of a
    single world keeps it, and so does `in_distribution`."""
    grip = {"pad_friction": (0.5, 1.2), "grip_force": (20.0, 70.0)}
    many = CFG.change(sim={"gripper": "varied", **grip}, scene={"certified": ("blocked",)})
    assert suites.standard(many, "random10") == CFG
    assert suites.standard(many, suites.IN_DISTRIBUTION) == many
    single = {"gripper": "2f85", "pad_friction": (0.8, 0.8)}
    one = CFG.change(sim=single, heightmap={"view": "oblique"}, sensor={"kind": "d415"})
    assert suites.standard(one, "random10") == one


@pytest.mark.parametrize("suite", ["random10", "packed"])
def test_suite_is_the_same_for_every_policy(suite: str):
    """Claim: scenes that are dropped or drawn do not depend on what a policy was trained with."""
    alike = {"size_jitter": (0.0, 0.0), "density": (600.0, 600.0), "packed_fraction": 0.5}
    cfgs = CFG, CFG.change(scene=alike)
    (one,), (other,) = (suites.prepare(cfg, suite, 2, 0).parts.values() for cfg in cfgs)
    jax.tree.map(np.testing.assert_array_equal, one.scenes, other.scenes)
    assert len(np.unique(one.scenes.density)) > 2


def test_cases_are_turned_as_a_whole():
    """Claim: an episode begins with the case turned by any yaw, all blocks alike, so that no two
    episodes are the same and all stay inside."""
    scene, turned = _varied(CFG, "row")
    lies = np.asarray(scene.in_play)
    before, after = np.asarray(scene.position)[lies], turned.position[:, lies]
    turns = after[..., :2] @ [1, 1j] / (before[:, :2] @ [1, 1j])  # [episodes, blocks]
    np.testing.assert_allclose(turns, np.broadcast_to(turns[:, :1], turns.shape), atol=1e-3)
    yaws = np.mod(np.angle(turns[:, 0]), 2.0 * np.pi)
    assert len(np.unique(yaws.round(3))) > 35
    assert np.histogram(yaws, bins=4, range=(0, 2.0 * np.pi))[0].min() >= 3  # 10 expected
    assert np.abs(after[..., :2]).max() <= 0.5 * CFG.heightmap.extent


def test_target_is_the_cases_own():
    """Claim: the target task asks for the block that the file marks, the clearing task for any."""
    scene, turned = _varied(TARGET, "hole")
    assert (turned.target == scene.target).all()
    assert scene.target != scene_state.ANY
    assert (_varied(CFG, "hole")[1].target == scene_state.ANY).all()


@pytest.mark.slow
def test_packed_scenes_follow_the_seed():
    """Claim: the suite `packed` is the same for the same seed, another for another, and harder
    towards its end."""
    first, again, other = (
        suites.prepare(CFG, "packed", 30, seed).parts["packed"].scenes for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first.position, again.position)
    assert len({scene.tobytes() for scene in (*first.position, *other.position)}) == 60
    in_play = first.in_play.sum(axis=1)
    assert in_play[20:].mean() > in_play[:10].mean()


def test_suites_ask_policies_of_both_tasks_for_theirs(tmp_path: Path):
    """Claim: a policy that was trained in both tasks gets the task of the suite: a target where the
    suite or the user's case marks one, else all blocks. Its networks see the mask in either."""
    both = CFG.change(task={"kind": "both"})
    path = tmp_path / "mine.json"
    path.write_text(cases.shipped("hole").read_text())
    for suite, kind in (("cases", "clear"), ("enclosed", "target"), (str(path), "target")):
        prepared = suites.prepare(both, suite, EPISODES, 0)
        env = next(iter(prepared.parts.values()))
        assert env.cfg.task.kind == kind
        networks = policies.in_world(policies.NetworkPolicy(both, None), env.cfg)
        assert networks.cfg == env.cfg.change(task={"kind": "both"})
        assert actor_critic.make(networks.cfg).frames.shows_target
        planner = policies.PlannerPolicy(both, policies.NetworkPolicy(both, None))
        assert policies.in_world(planner, env.cfg).proposer.cfg == networks.cfg
    assert suites.prepare(both, "in_distribution", EPISODES, 0).cfg.task.kind == "clear"


@pytest.mark.parametrize(("suite", "blocks", "most"), [("random10", 10, 25), ("random30", 30, 75)])
def test_dropped_suites(monkeypatch: pytest.MonkeyPatch, suite: str, blocks: int, most: int):
    """Claim: random10 and random30 hold ten and thirty blocks of all kinds, contacts and actions
    enough for them, and scenes of a stream that is not the training's; none is arranged, whatever
    the training's are."""
    asked = []

    def settled(cfg, stream, count, poured=False):
        asked.append((cfg.scene.slots, cfg.scene.min_blocks, stream, count, poured))
        return _blank(cfg)

    monkeypatch.setattr(pool, "settled", settled)
    packed = CFG.change(scene={"packed_fraction": 0.5})
    (env,) = suites.prepare(packed, suite, EPISODES, 0).parts.values()
    ((slots, least, stream, count, poured),) = asked
    assert (len(slots), least, count, poured) == (blocks, blocks, EPISODES, suite == "random30")
    assert set(slots) == {"box", "arch", "prism", "half_cylinder", "cylinder"}
    assert stream != pool.TRAIN_STREAM
    assert env.cfg.task.max_actions == most
    assert env.cfg.sim.contacts >= 8 * blocks
    long = CFG.change(task={"max_actions": 90})
    assert suites.prepare(long, suite, EPISODES, 0).parts[suite].cfg.task.max_actions == 90


def test_target_suite(monkeypatch: pytest.MonkeyPatch):
    """Claim: the suite `target` is the cases and random10, one marked block each, within 5 actions;
    a policy that was trained to clear the table is refused, one that reads the blocks' poses is
    not."""
    monkeypatch.setattr(pool, "settled", lambda cfg, *_, **__: _blank(cfg, in_play=True))
    for cfg, learned in ((TARGET, True), (CFG, False)):
        parts = suites.prepare(cfg, "target", EPISODES, 0, learned=learned).parts
        assert tuple(parts) == (*cases.names(), "random10")
        for env in parts.values():
            assert (env.cfg.task.kind, env.cfg.task.max_actions) == ("target", 5)
            scene = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), env.scenes)
            varied = env.randomise_pose(jax.random.key(0), scene)
            assert scene.in_play[varied.target]
    with pytest.raises(ValueError, match=r"^suite: target needs a policy trained"):
        suites.prepare(CFG, "target", EPISODES, 0)


def test_camera_suite(monkeypatch: pytest.MonkeyPatch):
    """Claim: the suite `camera` is the scenes of random10 through ever worse cameras: straight
    down, from the side, with noise, 5 mm off, in other colours; a sensor that is named stays."""
    monkeypatch.setattr(pool, "settled", lambda cfg, *_, **__: _blank(cfg))
    noisy = CFG.change(heightmap={"view": "oblique"}, sensor={"kind": "azure_kinect"})
    for cfg, kind in ((CFG, "d415"), (noisy, "azure_kinect")):
        parts = suites.prepare(cfg, "camera", EPISODES, 0).parts
        seen = [(env.cfg.heightmap.view, env.cfg.sensor) for env in parts.values()]
        noise = SensorConfig(kind=kind)
        assert seen == [
            ("ortho", SensorConfig()),
            ("oblique", SensorConfig()),
            ("oblique", noise),
            ("oblique", dataclasses.replace(noise, pose_noise=(0.005, 0.0))),
            ("oblique", dataclasses.replace(noise, colour=0.2, light=0.2)),
        ]
        assert len({id(env.scenes) for env in parts.values()}) == 1


def test_suite_of_ones_own(monkeypatch: pytest.MonkeyPatch):
    """Claim: a registered suite is built from config, episodes and a stream that training does not
    have; a name cannot be taken twice, neither can an old one."""
    monkeypatch.setattr(suites, "SUITES", dict(suites.SUITES))
    asked = []
    suites.register("mine", lambda *at: {"part": asked.append(at)})
    assert suites.prepare(CFG, "mine", EPISODES, 3).parts == {"part": None}
    assert asked == [(CFG, EPISODES, 4)]
    for name in ("mine", "cases", "own"):
        with pytest.raises(ValueError, match=f"there is a suite '{name}' already"):
            suites.register(name, lambda *_: {})


def test_old_name_of_a_suite(monkeypatch: pytest.MonkeyPatch):
    """Claim: `own`, as older commands and records say, is the suite `in_distribution`."""
    monkeypatch.setattr(suites.environment, "make_env", lambda cfg, stream, count: (stream, count))
    wanted = {"in_distribution": (1, EPISODES)}
    for name in ("own", "in_distribution"):
        assert suites.prepare(CFG, name, EPISODES, 0).parts == wanted
