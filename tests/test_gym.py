"""The environment through Gymnasium, by Gymnasium's own checker and beside the environment."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

import csac_jax.gym  # noqa: E402  (registers)
from csac_jax import presets  # noqa: E402
from csac_jax.constants import Primitive  # noqa: E402

ID = "csac_jax/Clutter-v0"
CFG = presets.smoke().change(sim={"physics": "c"}, task={"max_actions": 2})
SCENES = 3

pytestmark = pytest.mark.mjx


@pytest.fixture(scope="module")
def single():
    with gymnasium.make(ID, config=CFG, render_mode="rgb_array") as env:
        yield env


@pytest.fixture(scope="module")
def batch():
    envs = gymnasium.make_vec(ID, num_envs=SCENES, config=CFG)
    yield envs
    envs.close()


def test_gymnasiums_checker_is_silent(single):
    """Claim: Gymnasium's checker warns of nothing: spaces, types, seeds, repeatability."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(single.unwrapped, skip_render_check=True)


def test_actions(single):
    """Claim: a dense action is primitive, yaw, row and column, the column fastest. Signs of a
    continuous one are primitives; x, y, yaw are shares of half the workspace and pi."""
    half = 0.5 * CFG.heightmap.extent
    for given, kind in (((-0.1, 1.0, -0.5, 0.5), Primitive.GRASP), ((0, 0, 1, -1), Primitive.PUSH)):
        action = single.unwrapped.interface.action(jnp.asarray(given, jnp.float32))
        assert action.primitive == kind
        np.testing.assert_allclose(action.pose, np.array(given[1:]) * [half, half, np.pi])
    interface = csac_jax.gym.Interface(single.unwrapped.interface.env, "dense")
    size = CFG.heightmap.size
    shape = len(Primitive), CFG.net.rotations, size, size
    assert interface.action_space.n == np.prod(shape)
    centres = (np.arange(size) - 0.5 * (size - 1)) * CFG.heightmap.extent / size
    for cell in ((0, 0, 0, 0), (1, 3, 5, 7), (0, 2, size - 1, 1)):
        action = interface.action(jnp.asarray(np.ravel_multi_index(cell, shape)))
        pose = centres[cell[3]], centres[cell[2]], 2.0 * np.pi * cell[1] / shape[1]
        assert action.primitive == cell[0]
        np.testing.assert_allclose(action.pose, pose, atol=1e-6)


def test_picture_shows_the_blocks(single):
    """Claim: a picture of the scene has the colours of its blocks, and changes with the scene."""
    single.reset(seed=1)
    first = single.render()
    single.reset(seed=2)
    assert first.shape == (480, 640, 3)
    assert first.dtype == np.uint8
    assert np.any(single.render() != first)
    assert (np.ptp(first.astype(int), axis=-1) > 60).mean() > 0.001  # the table and sky are grey


@pytest.mark.slow
def test_batch_is_many_single_ones(single, batch):
    """Claim: a batch steps as single environments do; an episode that ends is replaced in the same
    step, and `final_obs` has its last observation."""
    assert batch.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    seen, _ = batch.reset(seed=3)
    again, _ = batch.reset(seed=3)
    jax.tree.map(np.testing.assert_array_equal, seen, again)
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (2, SCENES, 4)).astype(np.float32)
    single.reset(seed=0)
    for number, given in enumerate(actions, 1):
        before = batch.state
        seen, reward, terminated, truncated, info = batch.step(given)
        assert batch.observation_space.contains(seen)
        done = terminated | truncated
        assert done.all() == (number == CFG.task.max_actions)
        for k in range(SCENES):
            single.unwrapped.state = jax.tree.map(lambda leaf, k=k: leaf[k], before)
            wanted = single.unwrapped.step(given[k])
            last = info["final_obs"][k] if done[k] else {name: seen[name][k] for name in seen}
            np.testing.assert_allclose(last["height"], wanted[0]["height"], atol=1e-6)
            assert (reward[k], terminated[k], truncated[k]) == wanted[1:4]
            assert {name: info[name][k] for name in wanted[4]} == wanted[4]
    assert all(np.any(info["final_obs"][k]["height"] != seen["height"][k]) for k in range(SCENES))
    assert np.all(batch.state.actions == 0)


def test_target_is_seen_where_there_is_one():
    """Claim: only the target task has a target in its observations."""
    for kind, extra in (("clear", set()), ("target", {"target"})):
        env = gymnasium.make(ID, config=CFG.change(task={"kind": kind}))
        assert set(env.observation_space.spaces) == {"colour", "height"} | extra


@pytest.mark.parametrize(
    ("argument", "value"), [("config", "quik"), ("actions", "both"), ("num_envs", 0)]
)
def test_bad_argument_is_named(argument: str, value: Any):
    """Claim: an unknown preset or kind of action, or no scene, is a ValueError that names it."""
    with pytest.raises(ValueError, match="unknown preset" if argument == "config" else argument):
        gymnasium.make_vec(ID, **{argument: value})


def test_reset_comes_first():
    """Claim: a step or a picture before the first reset says that a reset is needed."""
    single = gymnasium.make(ID, config=CFG, render_mode="rgb_array").unwrapped
    batch = gymnasium.make_vec(ID, num_envs=2, config=CFG)
    for call in (lambda: single.step(np.zeros(4)), single.render, lambda: batch.step(np.zeros(8))):
        with pytest.raises(gymnasium.error.ResetNeeded, match="call reset first"):
            call()


@pytest.mark.slow
@pytest.mark.optax
def test_stable_baselines_learns():
    """Claim: Stable-Baselines3's SAC learns: after 2,000 steps most actions take a cube, of random
    ones one in ten or fewer."""
    stable_baselines = pytest.importorskip("stable_baselines3")
    scene = {"slots": ("box",), "min_blocks": 1, "pool": 16, "drop_extent": (0.05, 0.05)}
    cfg = CFG.change(scene=scene, heightmap={"size": 40, "extent": 0.16}, task={"max_actions": 1})
    env = gymnasium.make(ID, config=cfg)
    rates = {"learning_rate": 1e-3, "learning_starts": 200, "batch_size": 64, "train_freq": 2}
    learner = stable_baselines.SAC(
        "MultiInputPolicy", env, gamma=0.0, ent_coef=0.02, buffer_size=2000, seed=0, **rates
    )
    rewards: list[float] = []

    def keep(given: dict[str, Any], _: dict[str, Any]) -> bool:
        rewards.append(float(given["rewards"][0]))
        return True  # go on

    learner.learn(2000, callback=keep)
    assert len(rewards) == 2000
    assert np.mean(rewards[:200]) < 0.1
    assert np.mean(rewards[-200:]) > 0.5
