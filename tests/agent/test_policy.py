"""From dense maps to an action."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.agent import maps, policy
from csac_jax.agent.maps import DenseMaps
from csac_jax.config import ExploreConfig
from csac_jax.sim.outcome import BARE
from csac_jax.sim.primitives import Primitive

PENALTY = 6.0
KEYS = 20


@pytest.fixture(scope="module")
def best(cfg, frames):
    """Actions of DenseMaps for KEYS keys."""
    run = jax.vmap(lambda key, state: policy.best_action(key, cfg, frames, state, PENALTY, jnp.int32(0)), (0, None))
    return jax.jit(lambda state: run(jax.random.split(jax.random.key(0), KEYS), state))


def _state(frames, seed: int) -> DenseMaps:
    """Random maps of which a twentieth is valid."""
    rng = np.random.default_rng(seed)
    shape = (2, frames.yaws.size, frames.side, frames.side)
    q = jnp.asarray(rng.uniform(-1.0, 1.0, shape), jnp.float32)
    return DenseMaps(q=q, logits=10.0 * q, valid=jnp.asarray(rng.uniform(size=shape) < 0.05) & frames.inside[None])


@pytest.mark.parametrize("seed", range(3))
def test_greedy_avoids_what_is_bare(frames, best, seed):
    """Claim: the action is on a valid cell, though invalid ones are worth more, and no worse than the best cell."""
    state = _state(frames, seed)
    state = state.replace(q=jnp.where(state.valid, state.q, 3.0))
    action = best(state)
    check = jax.vmap(lambda p, pose: maps.is_valid(frames, state.valid, p, pose))
    assert np.all(check(action.primitive, action.pose))
    value = jax.vmap(lambda p, pose: maps.read(frames, state.q, p, pose))(action.primitive, action.pose)
    assert np.all(value >= np.max(np.where(state.valid, state.q, -np.inf)) - 1e-3)


@pytest.mark.parametrize("primitive", Primitive)
def test_greedy_picks_the_better_primitive(frames, best, primitive):
    """Claim: the primitive whose best valid value is larger is chosen, near its best cell."""
    q, valid = np.zeros((2, 2, frames.yaws.size, frames.side, frames.side))
    valid[:] = frames.inside
    other = 1 - primitive
    q[primitive, 3, 9, 6] = 1.0
    q[other, 5, 8, 11] = 0.8
    valid[other, 2, 9, 9], q[other, 2, 9, 9] = 0.0, 2.0
    state = DenseMaps(jnp.asarray(q, jnp.float32), jnp.asarray(10.0 * q, jnp.float32), jnp.asarray(valid, bool))
    action = best(state)
    assert np.all(action.primitive == primitive)
    assert np.all(np.linalg.norm(action.pose[:, :2] - frames.xy[3, 9, 6][None], axis=1) < 0.5 * frames.cell)


def test_random_grasps_land_on_blocks(cfg, frames, observations):
    """Claim: a random grasp is above a block, and takes every yaw."""
    obs = jax.tree.map(lambda leaf: leaf[0], observations(1, 3))
    valid = maps.actionable(frames, obs)
    keys = jax.random.split(jax.random.key(1), 400)
    action = jax.jit(jax.vmap(lambda key: policy.random_grasp(key, frames, valid)))(keys)
    assert np.all(action.primitive == Primitive.GRASP)
    height, size = np.asarray(obs.height), cfg.heightmap.size
    col, row = np.asarray(action.pose[:, :2] / cfg.heightmap.cell + 0.5 * (size - 1)).T
    for r, c in zip(row, col, strict=True):  # a cell of the maps covers about 2 x 2 of the height map, turned
        rows, cols = slice(max(int(r) - 1, 0), int(r) + 3), slice(max(int(c) - 1, 0), int(c) + 3)
        assert height[rows, cols].max() > BARE
    yaws = np.round(np.asarray(action.pose[:, 2]) / (2 * np.pi) * frames.yaws.size) % frames.yaws.size
    assert set(yaws) == set(range(frames.yaws.size))
    assert np.mean(height > BARE) < 0.3  # it would be easy otherwise


def test_without_exploration_it_acts_greedily(cfg, frames):
    """Claim: with no noise, random primitive nor random place, what is tried is valid and worth the best value."""
    state = _state(frames, 7)
    calm = ExploreConfig(noise_std=0.0, primitive_start=0.0, primitive_end=0.0, place_start=0.0, place_end=0.0)
    own = dataclasses.replace(cfg, explore=calm)
    act = jax.jit(jax.vmap(lambda key: policy.act(key, own, frames, state, PENALTY, jnp.int32(0), jnp.int32(0))))
    action = act(jax.random.split(jax.random.key(2), KEYS))
    values = jax.vmap(lambda p, pose: maps.read(frames, state.q, p, pose))(action.primitive, action.pose)
    valid = jax.vmap(lambda p, pose: maps.is_valid(frames, state.valid, p, pose))(action.primitive, action.pose)
    assert np.all(valid)
    assert np.all(values >= np.max(np.where(state.valid, state.q, -np.inf)) - 1e-3)
