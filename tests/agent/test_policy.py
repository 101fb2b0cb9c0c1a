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
from csac_jax.config import CEMConfig
from csac_jax.constants import Primitive
from csac_jax.robot.primitives import Action
from csac_jax.runtime import compiler

KEYS = 20


@pytest.fixture(scope="module")
def parts(learner):
    """The learner of a config that differs in the policy only; its returns span 6."""
    return lambda cfg: dataclasses.replace(learner, cfg=cfg, bounds=(-2.0, 4.0))


@pytest.fixture(scope="module")
def best(cfg, parts):
    """Actions of DenseMaps for KEYS keys."""
    six = parts(cfg)
    run = jax.vmap(lambda key, state: policy.best_action(key, six, state, jnp.int32(0)), (0, None))
    return jax.jit(lambda state: run(jax.random.split(jax.random.key(0), KEYS), state))


def _explore(parts, state: DenseMaps, num: int, unchanged: int = 0) -> Action:
    """Actions to try for `num` keys."""
    act = lambda key: policy.act(key, parts, state, jnp.int32(unchanged), jnp.int32(0))  # noqa: E731
    return jax.jit(jax.vmap(act))(jax.random.split(jax.random.key(2), num))


def _state(frames, seed: int) -> DenseMaps:
    """Random maps of which a twentieth is valid."""
    rng, shape = np.random.default_rng(seed), frames.reachable.shape
    q = jnp.asarray(rng.uniform(-1.0, 1.0, shape), jnp.float32)
    valid = jnp.asarray(rng.uniform(size=shape) < 0.05) & frames.inside[None]
    return DenseMaps(q=q, logits=10.0 * q, valid=valid)


def _assert_best(frames, state: DenseMaps, action: Action) -> None:
    """Actions lie on valid cells and are worth the best of them."""
    check = jax.vmap(lambda p, pose: maps.read_valid(frames, state, p, pose))
    value, valid = check(action.primitive, action.pose)
    assert np.all(valid)
    assert np.all(value >= np.max(np.where(state.valid, state.q, -np.inf)) - 1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_greedy_avoids_what_is_bare(frames, best, seed):
    """Claim: the action is valid and worth the best cell, though invalid cells are worth more."""
    state = _state(frames, seed)
    state = state.replace(q=jnp.where(state.valid, state.q, 3.0))
    _assert_best(frames, state, best(state))


@pytest.mark.parametrize("primitive", Primitive)
def test_greedy_picks_the_better_primitive(frames, best, primitive):
    """Claim: the primitive whose best valid value is larger is chosen, near its best cell."""
    q = np.zeros(frames.reachable.shape, np.float32)
    valid = np.broadcast_to(frames.inside, q.shape).copy()
    other = 1 - primitive
    q[primitive, 3, 9, 6], q[other, 5, 8, 11] = 1.0, 0.8
    valid[other, 2, 9, 9], q[other, 2, 9, 9] = False, 2.0
    action = best(DenseMaps(jnp.asarray(q), jnp.asarray(10.0 * q), jnp.asarray(valid)))
    assert np.all(action.primitive == primitive)
    away = np.linalg.norm(action.pose[:, :2] - frames.xy[3, 9, 6][None], axis=1)
    assert np.all(away < 0.5 * frames.cell)


def test_best_pixel(cfg, frames, parts):
    """Claim: with `argmax` a primitive's pose is NumPy's largest valid cell, whatever the key."""
    own, state = parts(cfg.change(policy={"place": "argmax"})), _state(frames, 4)
    run = jax.jit(jax.vmap(lambda key: policy.greedy(key, own, state, jnp.int32(0))))
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
def test_retries_follow_boltzmann(cfg, frames, parts, failed):
    """Claim: after failed grasps a cell is drawn with exp(Q / T), T = failures x temperature;
    without a failure it is the best one."""
    grasps = algorithms.configure(cfg, "grasp_only")
    own = parts(grasps.change(policy={"place": "argmax", "retry_temperature": 0.25}))
    values, cells = (
        np.array([1.0, 0.8, 0.5, -0.2]),
        np.argwhere(frames.inside)[[5, 500, 1000, 1900]],
    )
    grasp, shape = (Primitive.GRASP, *cells.T), frames.reachable.shape
    q = jnp.zeros(shape).at[grasp].set(values)
    state = DenseMaps(q, 10.0 * q, jnp.zeros(shape, bool).at[grasp].set(True))

    def act(key: jax.Array) -> jax.Array:
        noisy = policy.after_failures(key, own, state, jnp.int32(failed))
        return policy.best_action(key, own, noisy, jnp.int32(0)).pose[:2]

    places = np.asarray(jax.jit(jax.vmap(act))(jax.random.split(jax.random.key(3), 4000)))
    off = np.linalg.norm(places[:, None] - frames.xy[tuple(cells.T)], axis=-1)
    assert off.min(axis=1).max() < 1e-6
    share = np.bincount(off.argmin(axis=1), minlength=4) / len(off)
    wanted = np.exp(values / 0.5) if failed else np.array([1.0, 0.0, 0.0, 0.0])
    assert_allclose(share, wanted / wanted.sum(), atol=0.03 if failed else 0.0)


def test_grasp_only_never_pushes(cfg, frames, parts):
    """Claim: grasp_only grasps while it explores too, where pushes are worth more."""
    own, state = parts(algorithms.configure(cfg, "grasp_only")), _state(frames, 6)
    state = state.replace(q=state.q.at[Primitive.PUSH].add(5.0))
    assert np.all(_explore(own, state, 200, unchanged=3).primitive == Primitive.GRASP)


def _peaked(key: jax.Array, frames) -> DenseMaps:
    """Draws one to five peaks of grasp values; the actor's logits are noise."""
    key_num, key_centre, key_height, key_width, key_logits = jax.random.split(key, 5)
    present = jnp.arange(5) < jax.random.randint(key_num, (), 1, 6)
    heights = jnp.where(present, jax.random.uniform(key_height, (5,), minval=0.3, maxval=1.0), 0.0)
    widths = jax.random.uniform(key_width, (5,), minval=0.12, maxval=0.3)
    centres = jax.random.uniform(key_centre, (5, 3), minval=-1.0)
    pose = jax.vmap(lambda i: maps.normalise(frames, maps.cell_pose(frames, i)))
    offset = box.wrap_yaw(pose(jnp.arange(frames.inside.size))[:, None] - centres[None])
    bells = jnp.exp(-0.5 * jnp.sum(offset**2, axis=-1) / widths[None] ** 2)  # [K h w, 5]
    grasp = jnp.max(heights[None] * bells, axis=-1).reshape(frames.inside.shape)
    q = jnp.stack([jnp.full_like(grasp, -1.0), grasp])
    logits = 5.0 * jax.random.normal(key_logits, q.shape)
    return DenseMaps(q, logits, jnp.broadcast_to(frames.inside, q.shape))


def test_search_finds_the_highest_of_several_peaks(cfg, frames, parts):
    """Claim: with the default settings, of 1,000 searches on maps of one to five peaks at least 98
    % reach the highest value within 1 %, whatever the actor proposes."""
    own = parts(cfg.change(cem=CEMConfig()))

    def reached(i: jax.Array) -> jax.Array:
        state = _peaked(jax.random.fold_in(jax.random.key(3), i), frames)
        key = jax.random.fold_in(jax.random.key(4), i)
        value = policy.greedy(key, own, state, jnp.int32(0)).values[Primitive.GRASP]
        best = jnp.max(jnp.where(frames.inside, state.q[Primitive.GRASP], -jnp.inf))
        return value >= 0.99 * best

    share = np.mean(jax.jit(jax.vmap(reached))(jnp.arange(1000)))
    assert share >= 0.98, share


@pytest.mark.slow
def test_search_is_the_same_compiled_sooner(cfg, frames, parts):
    """Claim: with the options of training on a CPU, 200 searches end where they do by XLA's own."""

    def search(i: jax.Array) -> jax.Array:
        keys = jax.random.split(jax.random.fold_in(jax.random.key(5), i))
        state, both = _peaked(keys[0], frames), cfg.change(cem=CEMConfig())
        return policy.greedy(keys[1], parts(both), state, jnp.int32(0)).values

    own = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
    sooner, by_default = (
        jax.jit(jax.vmap(search), compiler_options=options)(jnp.arange(200))
        for options in (compiler.SOONER, {name: own[name] for name in compiler.SOONER})
    )
    assert_allclose(sooner, by_default, rtol=0.0, atol=1e-5)
