"""The paper's protocol, sec. 4.3: targets of one scene, one after the other."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from csac_jax import presets
from csac_jax.env import Env, State
from csac_jax.world import scene_state
from csac_jax.world.scene_state import SceneState

BLOCKS = 10


@pytest.fixture(scope="module")
def env() -> Env:
    """The environment of `paper_small` without physics, whose pool is one scene of a grid."""
    cfg = presets.paper_small().change(heightmap={"size": 16})
    assert cfg.task.kind == presets.paper().task.kind == "target"
    scene = jax.tree.map(jnp.asarray, scene_state.parked(cfg.scene.slots))
    along = 0.07 * (np.arange(BLOCKS) % 4 - 1.5), 0.07 * (np.arange(BLOCKS) // 4 - 1.0)
    position = np.stack([*along, np.full(BLOCKS, 0.03)], axis=1).astype(np.float32)
    scene = scene.replace(position=jnp.asarray(position), in_play=jnp.ones(BLOCKS, bool))
    pool: SceneState = jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene)
    return Env(cfg, None, pool)


def _got(state: State) -> State:
    """The state after the target was lifted off the table."""
    rest = jnp.arange(BLOCKS) != state.scene.target
    over, won = jnp.ones((), bool), jnp.ones((), jnp.float32)
    return state.replace(scene=scene_state.park(state.scene, rest), terminated=over, reward=won)


def test_targets_until_none_is_left(env: Env):
    """Claim: after each success another block of the same scene is named, every block once; where
    none is left comes another scene with all of them."""
    following = jax.jit(lambda key, state: env.auto_reset(key, _got(state)))
    state = jax.jit(env.reset)(jax.random.key(0))
    named = [int(state.scene.target)]
    for number in range(1, BLOCKS):
        state = following(jax.random.key(number), state)
        assert state.scene.in_play.sum() == BLOCKS - number
        assert state.scene.in_play[state.scene.target]
        assert (state.actions, state.terminated) == (0, False)
        named.append(int(state.scene.target))
    assert sorted(named) == list(range(BLOCKS))
    assert named != sorted(named)
    state = following(jax.random.key(99), state)
    assert state.scene.in_play.all()


def test_target_is_named_at_random(env: Env):
    """Claim: each block of a scene is as likely to be the first target as any other."""
    keys = jax.random.split(jax.random.key(1), 2000)
    scene = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), env.scenes)
    first = jax.jit(jax.vmap(lambda key: env.randomise_pose(key, scene).target))(keys)
    assert stats.chisquare(np.bincount(np.asarray(first), minlength=BLOCKS)).pvalue > 1e-3


def _asks_both(env: Env, **scene: Any) -> Env:
    return dataclasses.replace(env, cfg=env.cfg.change(task={"kind": "both"}, scene=scene))


def test_both_asks_for_all_or_for_one(env: Env):
    """Claim: in the task `both` half of the fresh scenes ask for one block, any with the same
    chance; the others ask for all, and show a mask of ones."""
    keys = jax.random.split(jax.random.key(2), 2000)
    scene = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), env.scenes)
    both = _asks_both(env)
    draw = jax.jit(jax.vmap(lambda key: both.randomise_pose(key, scene).target))
    targets = np.asarray(draw(keys))
    marked = targets[targets != scene_state.ANY]
    assert stats.binomtest(len(marked), len(targets)).pvalue > 1e-3
    assert stats.chisquare(np.bincount(marked, minlength=BLOCKS)).pvalue > 1e-3
    reset = jax.jit(both.reset)
    for number in range(10):
        state = reset(jax.random.key(number))
        assert state.obs.target.all() == (state.scene.target == scene_state.ANY)


@pytest.mark.parametrize(("own", "share"), [(scene_state.ANY, 1.0), (3, 0.5)])
def test_certified_scene_keeps_what_it_asks_for(env: Env, own: int, share: float):
    """Claim: in the task `both` a certified scene asks for its own target, or else for all, also
    among others in the pool; after a success it is replaced."""
    both = _asks_both(env, certified=("blocked",), certified_fraction=share)
    pool = env.scenes.replace(target=np.full(1, own, np.int32))
    pool = pool.replace(certified=np.ones(1, bool)) if share < 1.0 else pool
    both = dataclasses.replace(both, scenes=pool)
    states = jax.jit(jax.vmap(both.reset))(jax.random.split(jax.random.key(3), 50))
    assert (states.scene.target == own).all()
    state = _got(jax.tree.map(lambda leaf: leaf[0], states))
    assert jax.jit(both.auto_reset)(jax.random.key(4), state).scene.in_play.all()


def test_success_without_a_target_ends_the_scene(env: Env):
    """Claim: in the task `both` a scene goes on after the success of an episode with a target, and
    gets a new one; after one that asked for all it is replaced."""
    both = _asks_both(env)
    reset, following = jax.jit(both.reset), jax.jit(both.auto_reset)
    states = [_got(reset(jax.random.key(number))) for number in range(8)]
    assert {int(state.scene.target) == scene_state.ANY for state in states} == {True, False}
    for state in states:
        state = state.replace(scene=scene_state.park(state.scene, jnp.arange(BLOCKS) != 1))
        after = following(jax.random.key(4), state)
        left = BLOCKS if state.scene.target == scene_state.ANY else state.scene.in_play.sum()
        assert after.scene.in_play.sum() == left
        assert left == BLOCKS or after.scene.target != scene_state.ANY


def test_failure_replaces_the_scene(env: Env):
    """Claim: where the actions are spent, the next scene is another, with all its blocks."""
    state = _got(jax.jit(env.reset)(jax.random.key(0)))
    spent = state.replace(reward=jnp.zeros(()), terminated=jnp.zeros((), bool))
    assert jax.jit(env.auto_reset)(jax.random.key(1), spent).scene.in_play.all()
