"""The environment by itself: resets, ends of episodes, failed physics."""

import dataclasses
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.agent import rewards
from csac_jax.baselines import oracle
from csac_jax.config import Config, PhysicsKind, SceneConfig, SimConfig, TaskConfig
from csac_jax.constants import CHANGE_AREA, Outcome, Primitive
from csac_jax.env import AutoResetEnv, Env, State, make_env
from csac_jax.robot.primitives import Action
from csac_jax.sim import physics as simulation
from csac_jax.world import blocks, model, scene_state
from csac_jax.world.scene_state import SceneState

pytestmark = pytest.mark.mjx


class ShortTask(TaskConfig):
    """An episode is cut off after three actions without visible change."""

    max_steps_without_change: ClassVar[int] = 3


SCENE = SceneConfig(slots=("box", "box", "prism"), min_blocks=2, pool=16, settle_time=1.5)
CONFIG = Config(scene=SCENE, task=ShortTask(max_actions=6), sim=SimConfig(physics="c"))
FAILED = 3  # grasps before the actions of `_CASES`
SCENES = 8
BARE = (0.15, 0.15, 0.0)  # x, y and yaw of a place where nothing lies


class Lab(NamedTuple):
    """An environment and its compiled functions, each over SCENES scenes."""

    env: Env
    reset: Callable[[jax.Array], State]
    reset_to: Callable[[SceneState], State]
    step: Callable[[State, Action], State]
    oracle: Callable[[State], Action]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("pool")))
        return _compiled(make_env(CONFIG))


def _compiled(env: Env) -> Lab:
    def plan(state: State) -> Action:
        return oracle.grasp(CONFIG, state.scene, state.obs.height)

    return Lab(env, *(jax.jit(jax.vmap(run)) for run in (env.reset, env.reset_to, env.step, plan)))


def _in(physics: PhysicsKind, env: Env) -> Env:
    """The environment in another engine."""
    cfg = CONFIG.change(sim={"physics": physics})
    engine = simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    return dataclasses.replace(env, cfg=cfg, physics=engine)


def _cube(x: float, y: float, target: int = scene_state.ANY) -> SceneState:
    """A scene of one cube at (x, y) m; with a target, of a second one far off."""
    scene = jax.tree.map(jnp.asarray, scene_state.parked(CONFIG.scene.slots))
    places = jnp.array([[x, y, 0.025], [-0.15, 0.15, 0.025]])
    in_play = jnp.array([True, target != scene_state.ANY, False])
    position = jnp.where(in_play[:, None], scene.position.at[:2].set(places), scene.position)
    return scene.replace(position=position, in_play=in_play, target=jnp.int32(target))


@pytest.mark.slow
def test_scenes_stay_inside_however_turned(lab: Lab):
    """Claim: a scene that would leave the square turns by quarters, others by any yaw."""
    for seed, (x, quarters) in enumerate(((0.21, True), (0.15, False))):
        scene, keys = _cube(x, x), jax.random.split(jax.random.key(seed), 64)
        places = jax.vmap(lab.env.randomise_pose, (0, None))(keys, scene).position[:, 0, :2]
        assert np.abs(places).max() <= 0.5 * CONFIG.heightmap.extent
        whole = np.isclose(np.abs(places), x, atol=1e-5).all(axis=1)
        assert whole.all() if quarters else whole.mean() < 0.2


def _stack(*trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def _actions(*actions: tuple[Primitive, tuple[float, float, float]]) -> Action:
    kinds, poses = zip(*actions, strict=True)
    return Action(primitive=jnp.array(kinds, jnp.int32), pose=jnp.array(poses, jnp.float32))


def _at(tree, index: int):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], tree)


@pytest.fixture(scope="module")
def stepped(lab: Lab) -> State:
    """One step of the scenes of `_CASES`."""
    targets = [_TARGETS.get(name, scene_state.ANY) for name in _CASES]
    places, actions, unchanged, kinds, poses = zip(*_CASES.values(), strict=True)
    first = lab.reset_to(_stack(*(_cube(*p, t) for p, t in zip(places, targets, strict=True))))
    counts = {
        "actions": jnp.array(actions, jnp.int32),
        "steps_without_change": jnp.array(unchanged, jnp.int32),
        "failed_grasps": jnp.full(len(_CASES), FAILED, jnp.int32),
    }
    return lab.step(first.replace(**counts), _actions(*zip(kinds, poses, strict=True)))


_CASES = {  # the cube's place, actions and steps without change so far, the action
    "last chance": ((0.0, 0.0), 5, 2, Primitive.GRASP, (0.01, 0.0, 0.0)),
    "cap": ((0.0, 0.0), 5, 0, Primitive.GRASP, BARE),
    "steps_without_change": ((0.0, 0.0), 2, 2, Primitive.GRASP, BARE),
    "on": ((0.0, 0.0), 0, 1, Primitive.PUSH, BARE),
    "moved": ((0.06, 0.0), 0, 2, Primitive.PUSH, (0.0, 0.0, 0.0)),
    "out": ((0.19, 0.0), 0, 0, Primitive.PUSH, (0.13, 0.0, 0.0)),
    "got": ((0.0, 0.0), 0, 0, Primitive.GRASP, (0.0, 0.0, 0.0)),
    "wrong": ((0.0, 0.0), 0, 0, Primitive.GRASP, (0.0, 0.0, 0.0)),
}
_TARGETS = {"got": 0, "wrong": 1}  # slots


@pytest.fixture
def state_of(stepped: State) -> Callable[[str], State]:
    return lambda name: _at(stepped, list(_CASES).index(name))


_RESULTS = {  # terminated, truncated, reward, cleared, lost, outcome, counts as in State
    "last chance": (True, False, 1.0, 1, 0, Outcome.LIFTED, 6, 0, 0),  # no truncation at the cap
    "cap": (False, True, 0.0, 0, 0, Outcome.NOTHING, 6, 1, FAILED + 1),
    "steps_without_change": (False, True, 0.0, 0, 0, Outcome.NOTHING, 3, 3, FAILED + 1),
    "on": (False, False, 0.0, 0, 0, Outcome.NOTHING, 1, 2, FAILED),
    "moved": (False, False, 0.0, 0, 0, Outcome.NOTHING, 1, 0, FAILED),  # a visible change
    "out": (True, False, 0.0, 0, 1, Outcome.NOTHING, 1, 0, FAILED),
    "got": (True, False, 1.0, 1, 0, Outcome.LIFTED, 1, 0, 0),  # though another block is left
    "wrong": (False, False, 0.0, 1, 0, Outcome.TOUCHED, 1, 0, 0),  # another than the target
}


@pytest.mark.parametrize("name", _RESULTS)
def test_rewards_ends_and_counts(state_of, name: str):
    """Claim: a wanted block is worth 1; no wanted block left terminates; caps truncate; actions
    without visible change and failed grasps in a row are counted."""
    state = state_of(name)
    info = state.info.cleared, state.info.blocks_lost, state.info.outcome
    counts = state.actions, state.steps_without_change, state.failed_grasps
    assert (state.terminated, state.truncated, state.reward, *info, *counts) == _RESULTS[name]
    assert state.done == (state.terminated or state.truncated)
    assert state.info.outcome_by_gap == state.info.outcome  # the camera sees which block is gone


def test_lifted_and_lost_blocks_leave(state_of):
    """Claim: blocks lifted or pushed out are out of play and of sight; a lift says how far off the
    pose was; a push moves a block by more than CHANGE_AREA."""
    assert abs(state_of("last chance").info.distance - 0.01) < 1e-6
    assert state_of("last chance").obs.height.max() < 0.001
    np.testing.assert_array_equal(state_of("got").scene.in_play, [False, True, False])
    out, wrong = state_of("out"), state_of("wrong")
    np.testing.assert_array_equal(out.scene.position, scene_state.parking(3))
    assert out.obs.height.max() < 0.001
    assert wrong.obs.target.any()
    np.testing.assert_array_equal(wrong.obs.target, wrong.obs.height > 0.001)  # the target is left
    assert state_of("moved").info.moved > CHANGE_AREA
    assert 0.05 < state_of("moved").scene.position[0, 0] - 0.06 < 0.1


def test_auto_reset_replaces_finished_scenes_alone(lab: Lab, stepped: State):
    """Claim: where an episode is done, a fresh one is next and the output keeps reward, end and
    terminal observation. It can be scanned."""

    class Replay(Env):
        """Whatever the action, the next state is the one given."""

        def step(self, state: State, action: Action) -> State:
            return state

    auto = AutoResetEnv(Replay(lab.env.cfg, lab.env.physics, lab.env.scenes))

    def keys() -> jax.Array:
        return jax.random.split(jax.random.key(1), SCENES)

    actions = Action.push(*jnp.zeros((3, SCENES)))
    state, after = jax.jit(jax.vmap(auto.step))(keys(), stepped, actions)
    jax.tree.map(np.testing.assert_array_equal, after, stepped)
    fresh = jax.jit(jax.vmap(lab.env.auto_reset))(keys(), stepped)
    done = np.asarray(stepped.done)
    assert done.any()
    assert not done.all()
    for index in range(SCENES):
        expected = _at(fresh if done[index] else stepped, index)
        assert _leaves(_at(state, index)) == _leaves(expected)
    assert not state.done.any()
    one, action = jax.tree.map(lambda leaf: leaf[0], (stepped, actions))
    scan = jax.jit(lambda s: jax.lax.scan(lambda s, key: auto.step(key, s, action), s, keys()))
    _, ends = scan(one)
    np.testing.assert_array_equal(ends.done, np.arange(SCENES) == 0)


def test_failures_end_an_episode(lab: Lab):
    """Claim: with `max_failures` that many failed grasps in a row truncate an episode; of a pool
    with certified and other scenes, in certified ones alone. A scene that is not of the pool is
    none."""
    alone = dataclasses.replace(lab.env, max_failures=2)
    scene = {"certified": ("blocked",), "certified_fraction": 0.5}
    mixed = dataclasses.replace(alone, cfg=CONFIG.change(scene=scene))
    for env, certified, failed, stops in (
        *((alone, None, failed, failed == 1) for failed in (0, 1)),
        *((mixed, flag, 1, bool(flag)) for flag in (None, False, True)),
    ):
        flag = None if certified is None else jnp.asarray(certified)
        state = env.reset_to(_cube(0.0, 0.0).replace(certified=flag))
        state = state.replace(failed_grasps=jnp.int32(failed))
        after = jax.jit(env.step)(state, Action.grasp(*BARE))
        assert (bool(after.truncated), bool(after.terminated)) == (stops, False)


def test_oracle_clears_scenes(lab: Lab):
    """Claim: grasp by grasp a scene empties, each lift is worth 1, the last one terminates."""
    state = lab.reset(jax.random.split(jax.random.key(3), SCENES))
    blocks, taken = np.asarray(state.scene.in_play.sum(axis=1)), np.zeros(SCENES, int)
    cleared = np.zeros(SCENES, bool)
    for _ in range(5):
        before = np.asarray(state.scene.in_play.sum(axis=1))
        state = lab.step(state, lab.oracle(state))
        after = np.asarray(state.scene.in_play.sum(axis=1))
        info = jax.tree.map(np.asarray, state.info)
        np.testing.assert_array_equal(before - after, info.cleared + info.blocks_lost)
        np.testing.assert_array_equal(state.reward, (info.cleared > 0).astype(np.float32))
        np.testing.assert_array_equal(state.terminated, after == 0)
        assert not np.any(state.terminated & state.truncated)
        np.testing.assert_array_equal(state.scene.velocity[~np.asarray(state.scene.in_play)], 0.0)
        taken = taken + np.where(cleared, 0, info.cleared)
        cleared = cleared | np.asarray(state.terminated)
    assert cleared.mean() > 0.7
    np.testing.assert_array_equal(taken[cleared], blocks[cleared])


def _graspable(height: np.ndarray) -> float:
    """phi_g of a fixed critic: 1 if something stands with nothing 36 to 64 mm to either side."""
    cell = CONFIG.heightmap.cell
    occupied = height > 0.02
    for axis in (0, 1):
        room = np.ones_like(occupied)
        for cells in range(int(np.ceil(0.036 / cell)), int(0.064 / cell) + 1):
            for sign in (-1, 1):
                room &= ~np.roll(occupied, sign * cells, axis=axis)
        if np.any(room & occupied):
            return 1.0
    return 0.0


def _raft(gap: float) -> SceneState:
    """Two cuboids side by side along x, 100 mm square."""
    scene = _cube(0.0, 0.0, 1)
    half = scene.half_size.at[:2].set(jnp.array(blocks.SHAPES["cuboid"].half_size))
    y = 0.5 * gap + 0.025
    position = scene.position.at[:2].set(jnp.array([[0.0, y, 0.025], [0.0, -y, 0.025]]))
    return scene.replace(half_size=half, position=position, target=jnp.int32(scene_state.ANY))


def test_both_levels_of_a_push_are_reached(lab: Lab):
    """Claim: physics reaches both levels of a push (CSAC eq. 16): +1 breaks a packing up, -1 misses
    it or moves what could be grasped before."""
    raft, alone = _raft(0.0006), _cube(0.0, 0.0)
    cases = [(raft, (-0.12, 0.025, 0.0)), (raft, BARE), (alone, (-0.07, 0.0, 0.0)), (alone, BARE)]
    scenes, places = zip(*(cases * 2), strict=True)
    before = lab.reset_to(_stack(*scenes))
    after = lab.step(before, _actions(*((Primitive.PUSH, place) for place in places)))
    assert not after.info.physics_diverged.any()
    heights = np.asarray(before.obs.height[:4]), np.asarray(after.obs.height[:4])
    phi = [np.array([_graspable(row) for row in rows]) for rows in heights]
    np.testing.assert_array_equal(phi[0], [0.0, 0.0, 1.0, 1.0])
    cfg = CONFIG.reward
    zero, push = jnp.zeros(()), jnp.int32(Primitive.PUSH)
    level, reward = [], []
    for low, high, moved in zip(*phi, after.info.moved[:4], strict=True):
        phis, nothing = (jnp.float32(low), jnp.float32(high)), jnp.int32(Outcome.NOTHING)
        result = rewards.ActionResult(push, nothing, zero, *phis, moved > CHANGE_AREA, jnp.int32(0))
        level.append(float(rewards.push_effect(cfg, rewards.gains_value(cfg, *phis))))
        reward.append(float(rewards.reward(cfg, result)))
    assert level == [1.0, -1.0, -1.0, -1.0]
    assert reward == [0.5, -0.5, -0.5, -0.5]  # Gamma = 0.5, eq. 13
    changed = np.asarray(after.info.moved[:4]) > CHANGE_AREA
    np.testing.assert_array_equal(changed, [True, False, True, False])


def _leaves(state: State) -> list[bytes]:
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state)]


def _spoil(state: State, action: Action, where: str, value: float, sick: int) -> tuple:
    """State and action with `value` in the last entry of one leaf of scene `sick`."""

    def written(tree, leaf: str):
        old = np.array(getattr(tree, leaf))
        with np.errstate(invalid="ignore"):
            old[sick : sick + 1].flat[-1] = np.asarray(value).astype(old.dtype)
        return dataclasses.replace(tree, **{leaf: jnp.asarray(old)})

    part, leaf = where.split(".")
    if part == "action":
        return state, written(action, leaf)
    return dataclasses.replace(state, **{part: written(getattr(state, part), leaf)}), action


_ENTRIES = ("position", "quaternion", "velocity", "half_size", "density", "friction", "colour")
_SPOILT = [
    *(("action.pose", value) for value in (np.nan, np.inf)),
    *((f"scene.{leaf}", (np.nan, np.inf, 1e6)[i % 3]) for i, leaf in enumerate(_ENTRIES)),
    *((f"scene.{leaf}", (np.nan, np.inf, 1e6)[(i + 1) % 3]) for i, leaf in enumerate(_ENTRIES[:6])),
    ("scene.target", 1e6),
    ("obs.height", np.nan),
    ("obs.height", 1e6),
    ("obs.colour", np.inf),
]


@pytest.mark.parametrize("physics", ["c", pytest.param("mjx", marks=pytest.mark.slow)])
def test_failed_physics_stays_in_its_scene(lab: Lab, physics: PhysicsKind):
    """Claim: NaN, infinity or 1e6 in a scene truncates it as diverged, the others are the same, bit
    for bit. An invalid scene is replaced by an empty one; a valid one stays as it was."""
    lab = lab if physics == "c" else _compiled(_in(physics, lab.env))
    state = lab.reset(jax.random.split(jax.random.key(4), SCENES))
    action = lab.oracle(state)
    good = lab.step(state, action)
    assert not good.info.physics_diverged.any()
    for first in range(0, len(_SPOILT), SCENES - 2):
        sick = dict(enumerate(_SPOILT[first : first + SCENES - 2], 2))
        given = (state, action)
        for index, (where, value) in sick.items():
            given = _spoil(*given, where, value, index)
        bad = lab.step(*given)
        np.testing.assert_array_equal(bad.info.physics_diverged, [i in sick for i in range(SCENES)])
        for index in range(SCENES):
            same = _leaves(_at(good, index)) == _leaves(_at(bad, index))
            assert same == (index not in sick), sick.get(index)
        for index, (where, _) in sick.items():
            _assert_replaced(_at(bad, index), _at(state.scene, index), where)


def _assert_replaced(diverged: State, before: SceneState, where: str) -> None:
    ends = (diverged.truncated, diverged.terminated, diverged.reward)
    assert ends == (True, False, 0.0), where
    assert (diverged.info.cleared, diverged.info.blocks_lost) == (0, 0), where
    for leaf in jax.tree.leaves((diverged.scene, diverged.obs)):
        assert np.isfinite(leaf).all(), where
    expected = before if where == "action.pose" else scene_state.parked(CONFIG.scene.slots)
    jax.tree.map(np.testing.assert_array_equal, diverged.scene, expected)


def test_resets_differ(lab: Lab):
    """Claim: every reset gives another scene, none of them the pool's first as it lies."""
    states = [lab.reset(jax.random.split(jax.random.key(seed), SCENES)) for seed in range(8)]
    positions = np.concatenate([state.scene.position for state in states])
    assert len({position.tobytes() for position in positions}) == len(positions)
    play = np.concatenate([state.scene.in_play for state in states])
    pool, rows = lab.env.scenes, list(zip(positions, play, strict=True))

    def heights(position: np.ndarray, valid: np.ndarray) -> tuple:
        return tuple(np.where(valid, position[:, 2], -1.0))

    def yaw(position: np.ndarray, valid: np.ndarray) -> float:
        return np.arctan2(*position[valid][0, 1::-1])

    known = [heights(*row) for row in zip(pool.position, pool.in_play, strict=True)]
    drawn = [known.index(heights(*row)) for row in rows]
    assert len(set(drawn)) >= 20  # of 32, in 48 draws
    raw = [yaw(pool.position[i], pool.in_play[i]) for i in drawn]
    turned = np.mod(np.array([yaw(*row) for row in rows]) - raw, 2 * np.pi)
    # Any yaw: 12 expected in each quarter.
    assert np.histogram(turned, bins=4, range=(0, 2 * np.pi))[0].min() >= 4


def test_observations_lie_within_their_spec(lab: Lab, stepped: State):
    """Claim: what reset and step show has the shapes, dtypes and bounds of `observation_spec`. A
    spec contains neither what lies beyond its bounds nor NaN."""
    spec = lab.env.observation_spec
    for state in (lab.reset(jax.random.split(jax.random.key(6), SCENES)), stepped):
        assert jax.tree.structure(spec) == jax.tree.structure(state.obs)
        for leaf, values in zip(*map(jax.tree.leaves, (spec, state.obs)), strict=True):
            assert (values.shape, values.dtype) == ((SCENES, *leaf.shape), leaf.dtype)
            assert jax.vmap(leaf.contains)(values).all()
    for leaf in (lab.env.action_spec.pose, spec.height):
        for bound, change in ((leaf.minimum, -0.1), (leaf.maximum, 0.1), (leaf.maximum, np.nan)):
            values = jnp.broadcast_to(jnp.asarray(bound, leaf.dtype), leaf.shape)
            assert leaf.contains(values)
            assert not leaf.contains(values + change)


def test_actions_of_the_spec_are_accepted(lab: Lab):
    """Claim: random actions in the shapes, dtypes and bounds of `action_spec` can be taken."""
    spec, state = lab.env.action_spec, lab.reset(jax.random.split(jax.random.key(7), SCENES))
    rng = np.random.default_rng(0)

    def draw(leaf) -> jax.Array:
        values = rng.uniform(leaf.minimum, leaf.maximum, (SCENES, *leaf.shape))
        return jnp.asarray(values.round() if leaf.dtype == np.int32 else values, leaf.dtype)

    action = jax.tree.map(draw, spec)
    assert set(np.asarray(action.primitive)) == set(Primitive)
    assert not lab.step(state, action).info.physics_diverged.any()


def test_actions_are_built_from_numbers_or_arrays():
    """Claim: `Action.grasp` and `Action.push` build [] or batched actions, also in jit and vmap."""
    one = Action.grasp(0.02, -0.05, 0.3)
    assert (one.primitive, one.primitive.dtype) == (Primitive.GRASP, jnp.int32)
    np.testing.assert_array_equal(one.pose, np.float32([0.02, -0.05, 0.3]), strict=True)
    xs = jnp.array([0.0, 0.1, 0.2])
    batch = jax.jit(jax.vmap(lambda x, yaw: Action.push(x, 0.1, yaw)))(xs, xs[::-1])
    wanted = np.stack([xs, np.full(3, np.float32(0.1)), xs[::-1]], 1)
    for many in (Action.push(xs, 0.1, xs[::-1]), batch):
        np.testing.assert_array_equal(many.primitive, np.full(3, Primitive.PUSH))
        np.testing.assert_array_equal(many.pose, wanted)
