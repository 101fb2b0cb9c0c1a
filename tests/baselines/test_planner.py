"""The planner that simulates: its trials, its choices, and networks that propose."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.baselines import planner, trials
from csac_jax.constants import Primitive
from csac_jax.env import Env, State
from csac_jax.evaluation import policies, rollout
from csac_jax.evaluation.policies import NetworkPolicy, PlannerPolicy, RandomPolicy
from csac_jax.robot.primitives import Action
from csac_jax.world import scene_state
from csac_jax.world.scene_state import SceneState
from tests.networks import random_params

pytestmark = pytest.mark.mjx

SIDE, CUBES, MIDDLE = 0.0505, 9, 4  # m, of a cube and its gap
CFG = presets.smoke().change(
    scene={"slots": ("box",) * CUBES, "min_blocks": CUBES}, sim={"physics": "c"}
)
TARGET = CFG.change(task={"kind": "target", "max_actions": 5})
FEW = planner.Budget(grasps=24, pushes=6, grasps_after=8)


def _square(target: int = scene_state.ANY) -> SceneState:
    """Three by three cubes that touch: no finger fits beside the one in the middle."""
    columns, rows = np.meshgrid([-SIDE, 0.0, SIDE], [-SIDE, 0.0, SIDE])
    places = np.column_stack([columns.ravel(), rows.ravel(), np.full(CUBES, 0.025)])
    scene = scene_state.parked(CFG.scene.slots).replace(
        position=places.astype(np.float32),
        half_size=np.full((CUBES, 3), 0.025, np.float32),
        in_play=np.ones(CUBES, bool),
        target=np.int32(target),
    )
    return jax.tree.map(jnp.asarray, scene)


def _env(cfg, target: int = scene_state.ANY) -> Env:
    scenes = jax.tree.map(lambda leaf: np.asarray(leaf)[None], _square(target))
    return Env(cfg, planner.make_physics(cfg), scenes)


@functools.cache
def _start(cfg, target: int = scene_state.ANY) -> State:
    return jax.jit(_env(cfg).reset_to)(_square(target))


@functools.cache
def _step(cfg):
    return jax.jit(_env(cfg).step)


@functools.cache
def _simulate(cfg):
    simulate = jax.jit(functools.partial(trials.simulate, cfg, planner.make_physics(cfg)))
    return lambda state, actions: simulate(state.scene, state.obs.height, actions)


def test_trials_are_steps_of_the_environment():
    """Claim: a trial has the effect of the environment's step, bit for bit; its blocks lifted, lost
    and wanted are the environment's."""
    state = _start(CFG)
    grasps = planner.sample_grasps(jax.random.key(1), state.scene, 16)
    pushes = planner.sample_pushes(jax.random.key(2), CFG, state.scene, 16)
    tried, pushed = (_simulate(CFG)(state, actions) for actions in (grasps, pushes))
    assert 0 < int(tried.wanted.any(axis=1).sum()) < 16
    for actions, effects in ((grasps, tried), (pushes, pushed)):
        for number in range(4):
            action, effect = jax.tree.map(lambda leaf, i=number: leaf[i], (actions, effects))
            after = _step(CFG)(state, action)
            jax.tree.map(np.testing.assert_array_equal, after.scene, effect.scene)
            assert int(after.info.cleared) == int(effect.lifted.sum())
            assert int(after.info.blocks_lost) == int(effect.lost.sum())


def test_planner_lifts_where_random_fails():
    """Claim: the planner's action lifts a block of a square where random grasps lift none."""
    state, lifts = _start(CFG), []
    many = FEW.replace(grasps=128)
    policy, act = PlannerPolicy(CFG, budget=many), RandomPolicy(CFG)
    for seed in range(2):
        action = policy(state, jax.random.key(seed))
        assert action.primitive == Primitive.GRASP
        assert float(_step(CFG)(state, action).reward) == 1.0
        lifts += [float(_step(CFG)(state, act(state, jax.random.key(seed))).reward)]
    assert np.sum(lifts) == 0


def test_planner_pushes_towards_a_grasp():
    """Claim: where no grasp lifts the target, the planner takes the push after which the most
    grasps do, and one that changes nothing is not it."""
    state, physics = _start(TARGET, MIDDLE), planner.make_physics(TARGET)
    grasps = planner.sample_grasps(jax.random.key(5), state.scene, FEW.grasps)
    tried = _simulate(TARGET)(state, grasps)
    assert not np.any(tried.wanted)
    pushes = planner.sample_pushes(jax.random.key(0), TARGET, state.scene, FEW.pushes)
    in_the_air = Action.push(0.2, 0.2, 0.0)
    pushes = jax.tree.map(lambda leaf, air: leaf.at[0].set(air), pushes, in_the_air)

    @jax.jit
    def chosen(key: jax.Array):
        rest = TARGET, physics, state.scene, state.obs.height
        pushed = trials.simulate(*rest, pushes)
        last = jax.random.split(jax.random.clone(key), 3)[2]
        counts = planner.lifting_after(last, TARGET, physics, pushed, FEW.grasps_after)
        return planner.plan(key, *rest, FEW, (grasps, pushes)), counts, pushed

    action, counts, pushed = chosen(jax.random.key(2))
    assert action.primitive == Primitive.PUSH
    assert counts[0] == 0 < counts.max()
    counts = np.where(pushed.lost.any(axis=1), -1, counts)
    best = np.flatnonzero(counts == counts.max())
    first = best[np.argmin(pushed.motion[best])]
    np.testing.assert_array_equal(action.pose, pushes.pose[first])


def test_key_decides():
    """Claim: the same key gives the same action, in one scene and among several; another key
    another."""
    state, policy = _start(CFG), PlannerPolicy(CFG, budget=FEW)
    one, again, other = (policy(state, jax.random.key(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.pose, again.pose)
    assert np.any(one.pose != other.pose)
    states = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    both = jax.jit(jax.vmap(policy))(states, jax.vmap(jax.random.key)(jnp.arange(2)))
    np.testing.assert_array_equal(both.pose, [one.pose, other.pose])


@pytest.fixture(scope="module")
def learned() -> NetworkPolicy:
    """Networks that no training gives."""
    return NetworkPolicy(CFG, random_params(CFG))


def test_proposals_are_distinct(learned: NetworkPolicy):
    """Claim: a network's proposals are its best valid cells, none beside a better one; the first is
    the best of all."""
    grasps, pushes = jax.jit(lambda state: learned.proposals(state, 8))(_start(CFG))
    debug = learned.debug(_start(CFG), jax.random.key(0))
    for actions, kind in ((grasps, Primitive.GRASP), (pushes, Primitive.PUSH)):
        assert np.all(actions.primitive == kind)
        pose = np.asarray(actions.pose)
        apart = np.linalg.norm(pose[:, None, :2] - pose[None, :, :2], axis=-1) >= 0.02
        cosine = np.cos(pose[:, None, 2] - pose[None, :, 2])
        turned = (np.abs(cosine) if kind == Primitive.GRASP else cosine) <= np.cos(0.7) + 1e-6
        assert np.all(apart | turned | np.eye(8, dtype=bool))
        cell = np.floor((pose[0, 1::-1] / CFG.heightmap.extent + 0.5) * CFG.heightmap.size)
        row, column = cell.astype(int)
        near = debug.q[kind, row - 1 : row + 2, column - 1 : column + 2]
        np.testing.assert_allclose(near.max(), debug.q[kind].max(), rtol=0.2)


def test_physics_picks_a_proposal(learned: NetworkPolicy):
    """Claim: `learned+planner` takes a proposal of the networks that lifts, or else a push of
    theirs; it counts as learned and keeps its networks in another world."""
    policy = PlannerPolicy(CFG, learned, FEW)
    assert policies.is_learned(policy)
    assert not policies.is_learned(PlannerPolicy(CFG))
    policy = policies.in_world(policy, CFG.change(task={"max_actions": 7}))
    assert policy.proposer.cfg == policy.cfg
    state = _start(CFG)
    action = policy(state, jax.random.key(0))
    grasps, pushes = jax.jit(lambda state: learned.proposals(state, policies.PROPOSALS))(state)
    chosen = grasps if action.primitive == Primitive.GRASP else pushes
    assert np.any(np.all(np.isclose(chosen.pose, action.pose, atol=1e-5), axis=1))
    lifts = _step(CFG)(state, action).reward
    assert lifts == 1.0 or action.primitive == Primitive.PUSH


@pytest.mark.slow
def test_planner_gets_an_enclosed_target():
    """Claim: the planner gets the middle cube of a square within five actions, always."""
    episodes = rollout.rollout(_env(TARGET, MIDDLE), PlannerPolicy(TARGET, budget=FEW), 4, 0)
    assert np.all(episodes.completed)
    assert np.any(episodes.valid & (episodes.primitive == Primitive.PUSH))
