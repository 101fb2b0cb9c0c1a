"""From dense maps to an action."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax import algorithms
from csac_jax.agent import box, maps, policy
from csac_jax.agent.maps import DenseMaps
from csac_jax.config import CEMConfig, ExploreConfig
from csac_jax.constants import Primitive
from csac_jax.runtime import compiler
from csac_jax.sim.outcome import BARE

KEYS = 20


def _learner(learner, cfg):
    """The learner of a config that differs in the policy only; its returns span 6."""
    return dataclasses.replace(learner, cfg=cfg, bounds=(-2.0, 4.0))


@pytest.fixture(scope="module")
def best(cfg, learner):
    """Actions of DenseMaps for KEYS keys."""
    six = _learner(learner, cfg)
    run = jax.vmap(lambda key, state: policy.best_action(key, six, state, jnp.int32(0)), (0, None))
    return jax.jit(lambda state: run(jax.random.split(jax.random.key(0), KEYS), state))


def _state(frames, seed: int) -> DenseMaps:
    """Random maps of which a twentieth is valid."""
    rng = np.random.default_rng(seed)
    shape = (2, frames.yaws.size, frames.side, frames.side)
    q = jnp.asarray(rng.uniform(-1.0, 1.0, shape), jnp.float32)
    return DenseMaps(
        q=q,
        logits=10.0 * q,
        valid=jnp.asarray(rng.uniform(size=shape) < 0.05) & frames.inside[None],
    )


@pytest.mark.parametrize("seed", range(3))
def test_greedy_avoids_what_is_bare(frames, best, seed):
    """Claim: the action is on a valid cell, though invalid ones are worth more, and no worse than
    the best cell."""
    state = _state(frames, seed)
    state = state.replace(q=jnp.where(state.valid, state.q, 3.0))
    action = best(state)
    check = jax.vmap(lambda p, pose: maps.is_valid(frames, state.valid, p, pose))
    assert np.all(check(action.primitive, action.pose))
    value = jax.vmap(lambda p, pose: maps.read(frames, state.q, p, pose))(
        action.primitive, action.pose
    )
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
    state = DenseMaps(
        jnp.asarray(q, jnp.float32), jnp.asarray(10.0 * q, jnp.float32), jnp.asarray(valid, bool)
    )
    action = best(state)
    assert np.all(action.primitive == primitive)
    assert np.all(
        np.linalg.norm(action.pose[:, :2] - frames.xy[3, 9, 6][None], axis=1) < 0.5 * frames.cell
    )


def test_random_grasps_land_on_blocks(cfg, frames, observations):
    """Claim: a random grasp is above a block, and takes every yaw."""
    obs = jax.tree.map(lambda leaf: leaf[0], observations(1, 3))
    valid = maps.actionable_cells(frames, obs)
    keys = jax.random.split(jax.random.key(1), 400)
    action = jax.jit(jax.vmap(lambda key: policy.random_grasp(key, frames, valid)))(keys)
    assert np.all(action.primitive == Primitive.GRASP)
    height, size = np.asarray(obs.height), cfg.heightmap.size
    col, row = np.asarray(action.pose[:, :2] / cfg.heightmap.cell + 0.5 * (size - 1)).T
    for r, c in zip(
        row, col, strict=True
    ):  # a cell of the maps covers about 2 x 2 of the height map, turned
        rows, cols = slice(max(int(r) - 1, 0), int(r) + 3), slice(max(int(c) - 1, 0), int(c) + 3)
        assert height[rows, cols].max() > BARE
    yaws = (
        np.round(np.asarray(action.pose[:, 2]) / (2 * np.pi) * frames.yaws.size) % frames.yaws.size
    )
    assert set(yaws) == set(range(frames.yaws.size))
    assert np.mean(height > BARE) < 0.3  # it would be easy otherwise


@pytest.mark.slow
def test_without_exploration_it_acts_greedily(cfg, frames, learner):
    """Claim: with no noise, random primitive nor random place, what is tried is valid and worth the
    best value."""
    state = _state(frames, 7)
    calm = ExploreConfig(noise_std=0.0, epsilon_primitive=(0.0, 0.0), epsilon_place=(0.0, 0.0))
    own = cfg.change(explore=calm)
    act = jax.jit(
        jax.vmap(
            lambda key: policy.act(key, _learner(learner, own), state, jnp.int32(0), jnp.int32(0))
        )
    )
    action = act(jax.random.split(jax.random.key(2), KEYS))
    values = jax.vmap(lambda p, pose: maps.read(frames, state.q, p, pose))(
        action.primitive, action.pose
    )
    valid = jax.vmap(lambda p, pose: maps.is_valid(frames, state.valid, p, pose))(
        action.primitive, action.pose
    )
    assert np.all(valid)
    assert np.all(values >= np.max(np.where(state.valid, state.q, -np.inf)) - 1e-3)


def test_best_pixel(cfg, frames, learner):
    """Claim: with `argmax` a primitive's pose is that of NumPy's largest valid cell, exactly,
    whatever the key."""
    own, state = cfg.change(policy={"place": "argmax"}), _state(frames, 4)
    run = jax.jit(
        jax.vmap(lambda key: policy.greedy(key, _learner(learner, own), state, jnp.int32(0)))
    )
    choice = run(jax.random.split(jax.random.key(0), 3))
    masked = np.where(state.valid, state.q, -np.inf)
    for p in Primitive:
        cell = np.unravel_index(np.argmax(masked[p]), masked[p].shape)
        pose = jax.vmap(lambda u: maps.denormalise(frames, u))(choice.poses[:, p])
        assert_allclose(pose[:, :2], np.tile(frames.xy[cell], (3, 1)), atol=1e-6)
        assert_allclose(np.cos(pose[:, 2] - frames.yaws[cell[0]]), 1.0, atol=1e-6)
        assert_array_equal(choice.values[:, p], masked[p].max())


@pytest.mark.parametrize(
    ("rule", "values", "steps_without_change", "expected"),
    [
        ("argmax", (2.0, 1.0), 0, Primitive.PUSH),
        ("argmax", (1.0, 2.0), 5, Primitive.GRASP),
        ("rule", (2.0, 1.0), 0, Primitive.GRASP),
        ("rule", (1.0, 2.0), 1, Primitive.PUSH),
        ("rule", (1.0, 2.0), 7, Primitive.PUSH),
        ("grasp", (2.0, 1.0), 0, Primitive.GRASP),
        ("grasp", (2.0, 1.0), 3, Primitive.GRASP),
    ],
)
def test_choice_of_primitive(rule, values, steps_without_change, expected):
    """Claim: `argmax` takes the larger value; `rule` pushes after no change, else grasps; `grasp`
    always grasps."""
    choose = policy.PRIMITIVE_RULES[rule]
    got = choose(jnp.array(values), jnp.int32(steps_without_change))
    assert (got, got.dtype) == (expected, jnp.int32)


@pytest.mark.parametrize("failed", [0, 2])
def test_retries_follow_boltzmann(cfg, frames, learner, failed):
    """Claim: after failed grasps a cell is drawn with exp(Q / T), T = failures * `policy.retry`;
    without a failure it is the best one."""
    grasps = algorithms.configure(cfg, "grasp_only")
    own = grasps.change(policy={"place": "argmax", "retry": 0.25})
    values = np.array([1.0, 0.8, 0.5, -0.2])
    cells = np.argwhere(frames.inside)[[5, 500, 1000, 1900]]
    grasp = (Primitive.GRASP, *cells.T)
    shape = (2, *frames.inside.shape)
    q = jnp.zeros(shape).at[grasp].set(values)
    state = DenseMaps(q, 10.0 * q, jnp.zeros(shape, bool).at[grasp].set(True))
    parts = _learner(learner, own)

    def act(key: jax.Array) -> jax.Array:
        seen = policy.after_failures(key, parts, state, jnp.int32(failed))
        return policy.best_action(key, parts, seen, jnp.int32(0)).pose[:2]

    places = np.asarray(jax.jit(jax.vmap(act))(jax.random.split(jax.random.key(3), 4000)))
    off = np.linalg.norm(places[:, None] - frames.xy[tuple(cells.T)], axis=-1)
    assert off.min(axis=1).max() < 1e-6
    share = np.bincount(off.argmin(axis=1), minlength=4) / len(off)
    wanted = np.exp(values / 0.5) if failed else np.array([1.0, 0.0, 0.0, 0.0])
    assert_allclose(share, wanted / wanted.sum(), atol=0.03 if failed else 0.0)


@pytest.mark.parametrize("steps_without_change", [0, 1])
@pytest.mark.slow
def test_rule_reaches_the_action(cfg, frames, learner, steps_without_change):
    """Claim: what is done follows the rule with and without exploration, where values say the
    opposite."""
    own = cfg.change(policy={"primitive": "rule"}, explore={"epsilon_primitive": (0.0, 0.0)})
    state = _state(frames, 5)
    wrong = Primitive.GRASP if steps_without_change else Primitive.PUSH
    state = state.replace(q=state.q.at[wrong].add(5.0))
    key, count = jax.random.key(0), jnp.int32(steps_without_change)
    best = jax.jit(
        lambda steps_without_change: policy.best_action(
            key, _learner(learner, own), state, steps_without_change
        )
    )
    act = jax.jit(
        lambda steps_without_change: policy.act(
            key, _learner(learner, own), state, steps_without_change, jnp.int32(0)
        )
    )
    assert best(count).primitive == act(count).primitive == 1 - wrong


def test_grasp_only_never_pushes(cfg, frames, learner):
    """Claim: grasp_only grasps while it explores too, where pushes are worth more."""
    own, state = algorithms.configure(cfg, "grasp_only"), _state(frames, 6)
    state = state.replace(q=state.q.at[Primitive.PUSH].add(5.0))
    act = jax.jit(
        jax.vmap(
            lambda key: policy.act(key, _learner(learner, own), state, jnp.int32(3), jnp.int32(0))
        )
    )
    assert np.all(act(jax.random.split(jax.random.key(2), 200)).primitive == Primitive.GRASP)


def _peaked(key: jax.Array, frames) -> DenseMaps:
    """Maps of one to five peaks of different heights and widths for grasps; the actor's logits are
    noise."""
    key_num, key_centre, key_height, key_width, key_logits = jax.random.split(key, 5)
    present = jnp.arange(5) < jax.random.randint(key_num, (), 1, 6)
    heights = jnp.where(present, jax.random.uniform(key_height, (5,), minval=0.3, maxval=1.0), 0.0)
    widths = jax.random.uniform(key_width, (5,), minval=0.12, maxval=0.3)
    centres = jax.random.uniform(key_centre, (5, 3), minval=-1.0)
    cells = jax.vmap(lambda i: maps.normalise(frames, maps.cell_pose(frames, i)))(
        jnp.arange(frames.inside.size)
    )
    offset = box.wrap_yaw(cells[:, None] - centres[None])
    peaks = heights[None] * jnp.exp(
        -0.5 * jnp.sum(offset**2, axis=-1) / widths[None] ** 2
    )  # [K h w, 5]
    grasp = jnp.max(peaks, axis=-1).reshape(frames.inside.shape)
    q = jnp.stack([jnp.full_like(grasp, -1.0), grasp])
    return DenseMaps(
        q, 5.0 * jax.random.normal(key_logits, q.shape), jnp.broadcast_to(frames.inside, q.shape)
    )


@pytest.mark.parametrize(
    ("start", "least", "most"),
    [
        ("both", 0.98, 1.0),
        pytest.param("cells", 0.98, 1.0, marks=pytest.mark.slow),
        pytest.param("actor", 0.0, 0.1, marks=pytest.mark.slow),
    ],
)
def test_search_finds_the_highest_of_several_peaks(cfg, frames, learner, start, least, most):
    """Claim: with the default settings, of 1,000 searches on maps of one to five peaks at least 98
    % reach the highest value within 1 %, whatever the actor proposes; from an actor alone that
    knows nothing of it, hardly one does."""
    own = cfg.change(cem=CEMConfig(start=start))

    def reached(i: jax.Array) -> jax.Array:
        state = _peaked(jax.random.fold_in(jax.random.key(3), i), frames)
        choice = policy.greedy(
            jax.random.fold_in(jax.random.key(4), i), _learner(learner, own), state, jnp.int32(0)
        )
        best = jnp.max(jnp.where(frames.inside, state.q[Primitive.GRASP], -jnp.inf))
        return choice.values[Primitive.GRASP] >= 0.99 * best

    share = np.mean(jax.jit(jax.vmap(reached))(jnp.arange(1000)))
    assert least <= share <= most, share


@pytest.mark.slow
def test_search_is_the_same_compiled_sooner(cfg, frames, learner):
    """Claim: with the options that a training program is compiled with on a CPU, 200 searches end
    where they do by XLA's own."""

    def found(i: jax.Array) -> jax.Array:
        keys = jax.random.split(jax.random.fold_in(jax.random.key(5), i))
        state, both = _peaked(keys[0], frames), cfg.change(cem=CEMConfig(start="both"))
        return policy.greedy(keys[1], _learner(learner, both), state, jnp.int32(0)).values

    own = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
    sooner, by_default = (
        jax.jit(jax.vmap(found), compiler_options=options)(jnp.arange(200))
        for options in (compiler.SOONER, {name: own[name] for name in compiler.SOONER})
    )
    assert_allclose(sooner, by_default, rtol=0.0, atol=1e-5)


def test_random_places_reach_all_that_is_valid(frames):
    """Claim: where every cell is valid, random places of both primitives reach the whole
    workspace."""
    valid = jnp.broadcast_to(frames.inside, (2, *frames.inside.shape))
    u = jax.jit(jax.vmap(lambda key: policy.random_places(key, frames, valid)))(
        jax.random.split(jax.random.key(0), 400)
    )
    assert np.all(np.abs(u[..., :2]).max(axis=0) > 0.9)


@pytest.mark.slow
def test_candidates_are_those_of_the_search(cfg, frames, learner):
    """Claim: with one round, the greedy pose of each primitive is one of `candidates` for the same
    key."""
    one = cfg.change(cem={"rounds": 1, "start": "actor"})
    state, key = _state(frames, 0), jax.random.key(3)
    tried = jax.jit(lambda key: policy.candidates(key, _learner(learner, one), state))(key)
    assert tried.shape == (2, cfg.cem.candidates, 3)
    greedy = jax.jit(
        lambda key: policy.greedy(key, _learner(learner, one), state, jnp.int32(0)).poses
    )
    for primitive, u in zip(Primitive, greedy(key), strict=True):
        pose = maps.denormalise(frames, u)
        assert (
            np.min(np.abs(np.asarray(tried[primitive]) - np.asarray(pose)[None]).max(axis=1)) < 1e-5
        )


def test_without_a_search_there_is_one_candidate(cfg, frames, learner):
    """Claim: VPG's only candidate is the best pixel."""
    vpg = algorithms.configure(cfg, "vpg")
    state, key = _state(frames, 0), jax.random.key(3)
    tried = policy.candidates(key, _learner(learner, vpg), state)
    action = policy.best_action(key, _learner(learner, vpg), state, jnp.int32(0))
    assert tried.shape == (2, 1, 3)
    assert_allclose(tried[action.primitive, 0], action.pose, atol=1e-5)
