"""The scenes that policies are measured on."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.config import Config, TaskConfig
from csac_jax.scene import cases, layout
from csac_jax.train import suites

pytestmark = pytest.mark.mjx

SMOKE = presets.smoke()
CFG = dataclasses.replace(SMOKE, sim=dataclasses.replace(SMOKE.sim, physics="c"))
TARGET = dataclasses.replace(CFG, task=TaskConfig(kind="target"))
EPISODES = 5


def _varied(cfg: Config, name: str, count: int = 40):
    env = suites.environments(cfg, "cases", EPISODES, 0)[name]
    scene = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), env.scenes)
    return scene, jax.device_get(jax.vmap(env.vary, (0, None))(jax.random.split(jax.random.key(0), count), scene))


def test_cases_are_the_shipped_files():
    """Claim: the suite `cases` has one part per shipped case, which holds its blocks and nothing else."""
    parts = suites.environments(CFG, "cases", EPISODES, 0)
    assert tuple(parts) == cases.names()
    for name, env in parts.items():
        content = json.loads(cases.shipped(name).read_text())
        places = [block["position"] for block in content["blocks"]]
        np.testing.assert_allclose(env.scenes.position[0], places, atol=1e-6)
        assert env.scenes.in_play.all()
        assert env.cfg.sim.contacts >= 64


def test_cases_are_turned_by_quarters():
    """Claim: an episode begins with the case turned by 0, 90, 180 or 270 degrees, so that it stays inside."""
    scene, turned = _varied(CFG, "row")
    before = np.asarray(scene.position)
    angle = np.arctan2(turned.position[..., 1], turned.position[..., 0]) - np.arctan2(before[:, 1], before[:, 0])
    quarters = np.mod(angle / (0.5 * np.pi) + 0.5, 4.0) - 0.5
    np.testing.assert_allclose(quarters, quarters.round(), atol=1e-3)
    np.testing.assert_allclose(quarters.T, np.broadcast_to(quarters[:, 0], quarters.T.shape), atol=1e-3)
    assert set(quarters[:, 0].round()) == {0.0, 1.0, 2.0, 3.0}


def test_target_is_the_cases_own():
    """Claim: the target task asks for the block that the file marks, the clearing task for any."""
    scene, turned = _varied(TARGET, "hole")
    assert (turned.target == scene.target).all()
    assert scene.target != layout.ANY
    assert (_varied(CFG, "hole")[1].target == layout.ANY).all()


@pytest.mark.slow
def test_generated_scenes_follow_the_seed():
    """Claim: the suite `generated` is the same for the same seed, another for another, and harder towards its end."""
    first, again, other = (suites.environments(CFG, "generated", 30, seed)["generated"].scenes for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.position, again.position)
    assert len({scene.tobytes() for scene in (*first.position, *other.position)}) == 60
    in_play = first.in_play.sum(axis=1)
    assert in_play[20:].mean() > in_play[:10].mean()


def test_users_case_file(tmp_path: Path):
    """Claim: a case file of the user's is a suite by itself."""
    path = tmp_path / "mine.json"
    block = {"shape": "cube", "colour": "red", "position": [0.0, 0.1, 0.025], "quaternion": [1, 0, 0, 0]}
    path.write_text(json.dumps({"name": "mine", "blocks": [block]}))
    (env,) = suites.environments(CFG, str(path), EPISODES, 0).values()
    assert env.cfg.scene.slots == ("box",)
    with pytest.raises(ValueError, match="target"):
        suites.environments(TARGET, str(path), EPISODES, 0)


def test_unknown_suite():
    """Claim: a suite that is none is refused with the names of those that there are."""
    with pytest.raises(ValueError, match=r"'hard'.*random10, cases, generated"):
        suites.environments(CFG, "hard", EPISODES, 0)
