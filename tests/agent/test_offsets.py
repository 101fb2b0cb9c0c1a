"""Q that goes on inside cells: continuous in the action, and highest between cells if need be."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.agent import actor_critic, maps, offsets, policy
from csac_jax.agent.actor_critic import ActorCritic
from csac_jax.agent.maps import DenseMaps, Frames
from csac_jax.config import OffsetNet
from csac_jax.constants import Primitive
from csac_jax.nets import dense
from csac_jax.sim.primitives import Action
from csac_jax.training import step
from tests.agent import toys

pytestmark = pytest.mark.optax
WIDTH = 0.05  # m, of the hill below


@pytest.fixture(scope="module")
def learner(cfg) -> ActorCritic:
    """A learner whose net has slopes and curvatures."""
    fields = {f.name: getattr(cfg.net, f.name) for f in dataclasses.fields(cfg.net)}
    net = OffsetNet(**fields | {"kind": "offset"})
    return actor_critic.make(cfg.change(net=net))


def _hill(frames: Frames, top: np.ndarray) -> DenseMaps:
    """Maps of Q = 1 - |xy - top|^2 / WIDTH^2 of any yaw: value, slopes and curvatures of cells."""
    away = frames.xy - top
    value = 1.0 - np.sum(away**2, axis=-1) / WIDTH**2
    yaw = frames.yaws[:, None, None]
    along_col = away[..., 0] * np.cos(yaw) + away[..., 1] * np.sin(yaw)
    along_row = away[..., 1] * np.cos(yaw) - away[..., 0] * np.sin(yaw)
    slopes = [-2.0 * frames.cell * along / WIDTH**2 for along in (along_row, along_col)]
    bend, zero = np.full_like(value, -((frames.cell / WIDTH) ** 2)), np.zeros_like(value)
    terms = np.stack([value, *slopes, zero, bend, bend, zero], axis=-1)
    q, full = (jnp.asarray(np.stack([leaf, leaf]), jnp.float32) for leaf in (value, terms))
    return DenseMaps(q, 10.0 * q, jnp.ones(q.shape, bool), full)


def _poses(num: int, seed: int) -> jax.Array:
    rng = np.random.default_rng(seed)
    low, high = np.array([[-0.15, -0.15, 0.0], [0.15, 0.15, 2.0 * np.pi]])
    return jnp.asarray(rng.uniform(low, high, (num, 3)), jnp.float32)


def _read(frames: Frames, state: DenseMaps, poses: jax.Array) -> np.ndarray:
    read = jax.jit(jax.vmap(lambda pose: maps.read_q(frames, state, jnp.int32(1), pose)))
    return np.asarray(read(poses))


def test_parabola_is_read_exactly(learner):
    """Claim: a function of second degree is what its own values, slopes and curvatures in the cells
    blend to, at any pose."""
    top = np.array([0.031, -0.047])
    poses = _poses(300, 0)
    found = _read(learner.frames, _hill(learner.frames, top), poses)
    wanted = 1.0 - np.sum((np.asarray(poses)[:, :2] - top) ** 2, axis=1) / WIDTH**2
    np.testing.assert_allclose(found, wanted, atol=2e-4)


def test_without_slopes_it_is_trilinear(learner):
    """Claim: where slopes and curvatures are 0, Q is the trilinear value of the maps."""
    state = _hill(learner.frames, np.zeros(2))
    flat = state.replace(terms=state.terms.at[..., 1:].set(0.0))
    poses = _poses(300, 1)
    found = _read(learner.frames, flat, poses)
    wanted = _read(learner.frames, flat.replace(terms=None), poses)
    np.testing.assert_allclose(found, wanted, atol=1e-4)


def test_q_is_continuous(learner):
    """Claim: with any slopes and curvatures Q has no jump: along lines through many cells and all
    yaws, steps of a thousandth of a cell change it by little."""
    frames, rng = learner.frames, np.random.default_rng(0)
    shape = (2, len(frames.yaws), frames.side, frames.side, dense.TERMS)
    terms = jnp.asarray(rng.normal(size=shape), jnp.float32)
    state = DenseMaps(terms[..., 0], terms[..., 0], jnp.ones(shape[:-1], bool), terms)
    share = jnp.linspace(0.0, 1.0, 20_001)[:, None]
    for start, end in zip(_poses(3, 2), _poses(3, 3).at[:, 2].add(7.0), strict=True):
        values = _read(frames, state, (1.0 - share) * start[None] + share * end[None])
        assert np.ptp(values) > 1.0
        assert np.abs(np.diff(values)).max() < 0.05


@pytest.mark.slow
def test_value_in_the_loss_is_that_of_the_maps(learner, randomised, observations):
    """Claim: what the critic's update learns at a pose is what the search reads there, whatever
    yaw and primitive."""
    num = 12
    state = randomised(actor_critic.init(jax.random.key(0), learner))
    obs, poses = observations(num, 1), _poses(num, 4)
    action = Action(jnp.arange(num, dtype=jnp.int32) % 2, poses)
    of_loss, _ = actor_critic._value(learner, state.online.critic, obs, action)
    dense_maps = actor_critic.dense_maps(learner, state.online, obs)
    read = jax.vmap(maps.read_q, (None, 0, 0, 0))
    found = read(learner.frames, dense_maps, action.primitive, poses)
    np.testing.assert_allclose(of_loss[0], found, rtol=1e-3, atol=1e-3)
    assert np.std(found) > 0.05


def test_of_two_critics_the_lower_counts(learner):
    """Claim: of two critics each cell has value, slopes and curvatures of the one that is lower
    there."""
    rng = np.random.default_rng(0)
    q = rng.normal(size=(2, 3, 4, dense.OUTPUTS * dense.TERMS)).astype(np.float32)
    found = np.asarray(offsets.lower(jnp.asarray(q), dense.OUTPUTS)).reshape(3, 4, -1, 3)
    split = q.reshape(2, 3, 4, dense.TERMS, dense.OUTPUTS)
    for index in np.ndindex(3, 4, dense.OUTPUTS):
        row, col, output = index
        lower = split[:, row, col, 0, output].argmin()
        np.testing.assert_array_equal(found[row, col, :, output], split[lower, row, col, :, output])


@pytest.mark.parametrize("start", ["both", "actor"])
def test_search_finds_the_top_between_cells(learner, start):
    """Claim: on a hill CEM comes within a tenth of a cell of its top, wherever that lies, from the
    actor's mean alone too; the best cell is further off, by more than 0.15 of a cell on average."""
    cfg = learner.cfg.change(cem={"start": start, "candidates": 64, "elites": 6, "rounds": 6})
    own = dataclasses.replace(learner, cfg=cfg)
    frames, searched, cells = own.frames, [], []

    @jax.jit
    def search(key: jax.Array, state: maps.DenseMaps) -> jax.Array:
        grasps = jax.tree.map(lambda leaf: leaf[Primitive.GRASP][None], state)
        return policy._cem(key, own, grasps).action

    for seed, top in enumerate(np.random.default_rng(0).uniform(-0.12, 0.12, (12, 2))):
        state = _hill(frames, top)
        found = maps.denormalise(frames, search(jax.random.key(seed), state))
        best = maps.best_cells(state.q[1], state.valid[1], 1)[0]
        searched.append(np.linalg.norm(found[:2] - top) / frames.cell)
        cells.append(np.linalg.norm(frames.xy.reshape(-1, 2)[best] - top) / frames.cell)
    assert np.max(searched) < 0.1
    assert np.mean(cells) > 0.15


@pytest.mark.slow
def test_random_places_lie_anywhere_in_their_cells(learner):
    """Claim: a random pose fills its cell and its share of the yaws evenly, where Q varies inside
    cells; with any other net it is a cell's own pose."""
    frames = learner.frames
    valid = np.zeros((2, len(frames.yaws), frames.side, frames.side), bool)
    centre = 3, frames.side // 2, frames.side // 2
    valid[:, *centre] = True
    keys = jax.random.split(jax.random.key(0), 400)
    draw = jax.jit(jax.vmap(lambda key: policy.random_places(key, frames, jnp.asarray(valid))[1]))
    poses = np.asarray(jax.vmap(lambda u: maps.denormalise(frames, u))(draw(keys)))
    yaw, step = frames.yaws[3], 2.0 * np.pi / len(frames.yaws)
    away = poses[:, :2] - frames.xy[centre]
    turned = away @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    offset = np.column_stack([turned / frames.cell, (poses[:, 2] - yaw) / step])
    assert np.all(np.abs(offset) <= 0.501)
    np.testing.assert_allclose(offset.std(axis=0), 12.0**-0.5, atol=0.03)
    plain = dataclasses.replace(frames, networks=dataclasses.replace(frames.networks, terms=1))
    place = jax.jit(lambda key: policy.random_places(key, plain, jnp.asarray(valid))[1])
    np.testing.assert_allclose(
        maps.denormalise(frames, place(keys[0]))[:2], frames.xy[centre], atol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["offset", "small"])
def test_trained_policy_acts_between_cells(kind):
    """Claim: where a block can be lifted only where cells meet, CEM on the trained net with slopes
    leaves the best cell by more than half a cell in most states, in most of all for a higher Q, and
    lifts in many; on the trilinear one it never leaves for a higher Q, and lifts nothing."""
    cfg = toys.config("csac", actions=4800, max_actions=1)
    cfg = cfg.change(net={"kind": kind}, cem={"candidates": 32, "elites": 6, "rounds": 4})
    toy = toys.precise(cfg)
    program = step.make(cfg, env=toy)
    state, _ = step.compile_chunk(program, cfg.train.steps)(step.init(program))
    learner, num = actor_critic.make(cfg), 128
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(9), jnp.arange(num))
    first = jax.vmap(toy.reset)(keys)
    dense_maps = actor_critic.dense_maps(learner, state.learner.online, first.obs)
    best_action = jax.vmap(policy.best_action, (0, None, 0, 0))
    act = jax.jit(lambda *arguments: best_action(keys, learner, *arguments))
    action = act(dense_maps, first.steps_without_change)
    success = np.mean(jax.vmap(toy.step)(first, action).terminated)
    grasp = dense_maps.q[:, Primitive.GRASP], dense_maps.valid[:, Primitive.GRASP]
    best = jax.vmap(lambda q, valid: maps.best_cells(q, valid, 1)[0])(*grasp)
    away = action.pose[:, :2] - learner.frames.xy.reshape(-1, 2)[best]
    moved = np.linalg.norm(away, axis=1) > 0.5 * learner.frames.cell
    read = jax.jit(jax.vmap(functools.partial(maps.read_q, learner.frames)))
    found = read(dense_maps, action.primitive, action.pose)
    gain = found - jnp.max(jnp.where(grasp[1], grasp[0], -jnp.inf), axis=(1, 2, 3))
    better = np.mean(moved & (gain > 0.02))  # less is a tie: outcomes are 0.25 apart
    if kind == "offset":
        assert np.mean(moved) > 0.6
        assert better > 0.5
        assert success > 0.2
    else:
        assert better == 0.0
        assert success == 0.0
