"""The environment by itself: resets, ends of episodes, failed physics."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.agent import rewards
from csac_jax.config import Config, SceneConfig, TaskConfig
from csac_jax.constants import CHANGE_AREA, Outcome, Primitive
from csac_jax.env import AutoResetEnv, Env, State, make_env
from csac_jax.errors import SceneError
from csac_jax.scene import arrange, blocks, layout, model, pool
from csac_jax.scene.layout import Scene
from csac_jax.sim import backend, oracle, physics as simulation
from csac_jax.sim.primitives import Action

pytestmark = pytest.mark.mjx


class ShortTask(TaskConfig):
    """An episode is cut off after three actions without visible change."""

    max_steps_without_change: ClassVar[int] = 3


CONFIG = Config(
    scene=SceneConfig(slots=("box", "box", "prism"), min_blocks=2, pool=16, settle_time=1.5),
    task=ShortTask(max_actions=6),
)
FAILED = 3  # grasps before the actions of `_CASES`
SCENES = 8
BARE = (0.15, 0.15, 0.0)  # x, y and yaw of a place where nothing lies


class Lab(NamedTuple):
    """An environment and its compiled functions, each over SCENES scenes."""

    env: Env
    reset: Callable[[jax.Array], State]
    reset_to: Callable[[Scene], State]
    step: Callable[[State, Action], State]
    oracle: Callable[[State], Action]
    into_step: State  # shapes and dtypes that go into step,
    out_of_step: State  # and that come out of it


def _types(tree: State) -> State:
    return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype, leaf.weak_type), tree)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("pool")))
        env = make_env(CONFIG)
    keys = jax.random.split(jax.random.key(0), SCENES)

    def plan_from_state(state: State) -> Action:
        return oracle.grasp(CONFIG, state.scene, state.obs.height)

    traced_reset = jax.jit(jax.vmap(env.reset)).trace(keys)
    reset = traced_reset.lower().compile()
    state = reset(keys)
    plan = jax.jit(jax.vmap(plan_from_state)).lower(state).compile()
    reset_to = jax.jit(jax.vmap(env.reset_to)).lower(state.scene).compile()
    step = jax.jit(jax.vmap(env.step)).trace(state, plan(state))
    into, out = (
        jax.tree.unflatten(jax.tree.structure(state), traced.jaxpr.out_avals)
        for traced in (traced_reset, step)
    )
    return Lab(env, reset, reset_to, step.lower().compile(), plan, _types(into), _types(out))


def _cube(x: float, y: float, target: int = layout.ANY) -> Scene:
    """A scene of one cube at (x, y) m; with a target, of a second one far off."""
    scene = jax.tree.map(jnp.asarray, layout.parked(CONFIG.scene.slots))
    places = jnp.array([[x, y, 0.025], [-0.15, 0.15, 0.025]])
    in_play = jnp.array([True, target != layout.ANY, False])
    position = jnp.where(in_play[:, None], scene.position.at[:2].set(places), scene.position)
    return scene.replace(position=position, in_play=in_play, target=jnp.int32(target))


@pytest.mark.slow
def test_share_of_arranged_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: `scene.arranged` of a pool's scenes are packed arrangements, the rest dropped."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    scene = dataclasses.replace(CONFIG.scene, slots=("box",) * 3, min_blocks=3, pool=8)
    dropped, mixed = (
        make_env(
            dataclasses.replace(CONFIG, scene=dataclasses.replace(scene, arranged=share, pool=pool))
        ).scenes
        for share, pool in ((0.0, 6), (0.25, 8))
    )
    np.testing.assert_array_equal(mixed.position[:6], dropped.position)
    packed = arrange.arrangements(scene, CONFIG.heightmap.extent, 0, 2)
    np.testing.assert_array_equal(mixed.position[6:], packed.position)
    assert mixed.in_play.all()


def test_arrangement_without_blocks_for_it():
    """Claim: blocks that allow no arrangement are one line that names the slots."""
    two = SceneConfig(slots=("box", "prism"), min_blocks=2)
    with pytest.raises(SceneError, match=r"scene\.slots: too few for an arrangement"):
        arrange.arrangements(two, CONFIG.heightmap.extent, 0, 2)


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
    first = lab.reset_to(
        _stack(
            *(_cube(*place, _TARGETS.get(name, layout.ANY)) for name, (place, *_) in _CASES.items())
        )
    )
    actions, steps_without_change = (
        jnp.array([case[i] for case in _CASES.values()], jnp.int32) for i in (1, 2)
    )
    action = _actions(*((kind, pose) for *_, kind, pose in _CASES.values()))
    counts = {
        "actions": actions,
        "steps_without_change": steps_without_change,
        "failed_grasps": jnp.full(len(_CASES), FAILED, jnp.int32),
    }
    return lab.step(dataclasses.replace(first, **counts), action)


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


def test_last_block_terminates(state_of):
    """Claim: taking the last block terminates, is worth 1, and does not truncate at the cap."""
    state = state_of("last chance")
    assert (state.terminated, state.truncated, state.done) == (True, False, True)
    assert (state.reward, state.info.cleared, state.info.blocks_lost) == (1.0, 1, 0)
    assert state.info.outcome == state.info.outcome_by_gap == Outcome.LIFTED
    assert abs(state.info.distance - 0.01) < 1e-6  # the place aimed at lay 1 cm off the cube
    assert state.obs.height.max() < 0.001


def test_target_ends_the_episode(state_of):
    """Claim: in the target task the episode ends with the target, though a block is left."""
    state = state_of("got")
    assert (state.terminated, state.reward, state.info.outcome) == (True, 1.0, Outcome.LIFTED)
    np.testing.assert_array_equal(state.scene.in_play, [False, True, False])


def test_wrong_block_is_no_success(state_of):
    """Claim: lifting another block takes it away, counts as `touched`, is worth nothing."""
    state = state_of("wrong")
    assert (state.done, state.reward, state.info.cleared, state.info.outcome) == (
        False,
        0.0,
        1,
        Outcome.TOUCHED,
    )
    # no disagreement: the camera sees which block is gone
    assert state.info.outcome_by_gap == Outcome.TOUCHED
    assert state.obs.target.any()
    # the target alone is left
    np.testing.assert_array_equal(state.obs.target, state.obs.height > 0.001)


def test_auto_reset_replaces_finished_scenes_alone(lab: Lab, stepped: State):
    """Claim: AutoResetEnv goes on where an episode does; where one is done, a fresh one is next and
    the output keeps reward, end and terminal observation. It can be scanned."""

    class Replay(Env):
        """Whatever the action, the next state is the one given."""

        def step(self, state: State, action: Action) -> State:
            return state

    auto = AutoResetEnv(Replay(lab.env.cfg, lab.env.physics, lab.env.scenes))

    def keys() -> jax.Array:
        return jax.random.split(jax.random.key(1), SCENES)

    state, after = jax.jit(jax.vmap(auto.step))(keys(), stepped, _action_of(stepped))
    jax.tree.map(np.testing.assert_array_equal, after, stepped)
    fresh = jax.jit(jax.vmap(lab.env.auto_reset))(keys(), stepped)
    done = np.asarray(stepped.done)
    assert done.any()
    assert not done.all()
    for index in range(SCENES):
        expected = _at(fresh if done[index] else stepped, index)
        assert _leaves(_at(state, index)) == _leaves(expected)
    assert not state.done.any()
    one = jax.tree.map(lambda leaf: leaf[0], stepped)
    action = jax.tree.map(lambda leaf: leaf[0], _action_of(stepped))
    scan = jax.jit(lambda s: jax.lax.scan(lambda s, key: auto.step(key, s, action), s, keys()))
    _, ends = scan(one)
    np.testing.assert_array_equal(ends.done, np.arange(SCENES) == 0)


def _action_of(state: State) -> Action:
    zero = jnp.zeros(state.actions.shape)
    return Action.push(zero, zero, zero)


def test_next_target_in_the_same_scene(lab: Lab, stepped: State):
    """Claim: after a target comes another in the same scene, after other ends a fresh scene."""
    env = dataclasses.replace(
        lab.env, cfg=dataclasses.replace(CONFIG, task=TaskConfig(kind="target"))
    )
    fresh = jax.jit(jax.vmap(env.auto_reset))(jax.random.split(jax.random.key(0), SCENES), stepped)
    for name, stays in (("got", True), ("wrong", False), ("last chance", False)):
        new, old = (_at(state, list(_CASES).index(name)) for state in (fresh, stepped))
        assert np.array_equal(new.scene.position, old.scene.position) == stays, name
        assert new.scene.in_play[new.scene.target], name
        assert (new.done, new.reward, new.actions) == (False, 0.0, 0)
        assert new.obs.target.any()
        assert not new.obs.target.all()


def test_failed_grasps_are_counted(state_of):
    """Claim: failed grasps in a row are counted, a lift ends the row, pushes leave it."""
    after = {name: int(state_of(name).failed_grasps) for name in _CASES}
    pushes = dict.fromkeys(("on", "moved", "out"), FAILED)
    failures = dict.fromkeys(("cap", "steps_without_change"), FAILED + 1)
    assert after == pushes | failures | dict.fromkeys(("last chance", "got", "wrong"), 0)


def test_failures_end_an_episode(lab: Lab):
    """Claim: with `max_failures` that many failed grasps in a row truncate an episode."""
    cfg = CONFIG.change(sim={"physics": "c"})  # which compiles sooner
    physics = simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    env = dataclasses.replace(lab.env, cfg=cfg, physics=physics, max_failures=2)
    state, step = env.reset_to(_cube(0.0, 0.0)), jax.jit(env.step)
    for failed, stops in ((0, False), (1, True)):
        after = step(state.replace(failed_grasps=jnp.int32(failed)), Action.grasp(*BARE))
        assert (bool(after.truncated), bool(after.terminated)) == (stops, False)


def test_action_cap_truncates(state_of):
    """Claim: an episode is cut off after max_actions actions; that does not terminate it."""
    state = state_of("cap")
    assert (state.terminated, state.truncated, state.reward) == (False, True, 0.0)
    assert (state.actions, state.steps_without_change, state.info.outcome) == (
        6,
        1,
        Outcome.NOTHING,
    )


def test_no_change_cap_truncates(state_of):
    """Claim: max_steps_without_change actions without visible change truncate."""
    state = state_of("steps_without_change")
    assert (state.terminated, state.truncated, state.actions, state.steps_without_change) == (
        False,
        True,
        3,
        3,
    )


def test_episode_goes_on(state_of):
    """Claim: below both caps the episode continues, and unchanged steps are counted."""
    state = state_of("on")
    assert (state.done, state.actions, state.steps_without_change) == (False, 1, 2)


def test_visible_change_ends_the_count_without_change(state_of):
    """Claim: an action that moves more than CHANGE_AREA resets the count."""
    state = state_of("moved")
    assert state.info.moved > CHANGE_AREA
    assert (state.done, state.steps_without_change, state.reward) == (False, 0, 0.0)
    assert 0.05 < state.scene.position[0, 0] - 0.06 < 0.1


def test_block_pushed_out_leaves(state_of):
    """Claim: a block pushed out counts as lost, not as cleared, and is out of sight."""
    state = state_of("out")
    assert (state.info.blocks_lost, state.info.cleared, state.reward) == (1, 0, 0.0)
    np.testing.assert_array_equal(state.scene.position, layout.parking(3))
    assert not state.scene.in_play.any()
    assert state.obs.height.max() < 0.001


def test_oracle_clears_scenes(lab: Lab):
    """Claim: grasp by grasp a scene empties, each lift is worth 1, the last one terminates."""
    state = lab.reset(jax.random.split(jax.random.key(3), SCENES))
    blocks, taken = np.asarray(state.scene.in_play.sum(axis=1)), np.zeros(SCENES, int)
    cleared = np.zeros(SCENES, bool)
    for _ in range(5):
        before = np.asarray(state.scene.in_play.sum(axis=1))
        state = lab.step(state, lab.oracle(state))
        after, info = (
            np.asarray(state.scene.in_play.sum(axis=1)),
            jax.tree.map(np.asarray, state.info),
        )
        np.testing.assert_array_equal(before - after, info.cleared + info.blocks_lost)
        np.testing.assert_array_equal(state.reward, (info.cleared > 0).astype(np.float32))
        np.testing.assert_array_equal(state.terminated, after == 0)
        assert not np.any(state.terminated & state.truncated)
        np.testing.assert_array_equal(state.scene.velocity[~np.asarray(state.scene.in_play)], 0.0)
        taken, cleared = (
            taken + np.where(cleared, 0, info.cleared),
            cleared | np.asarray(state.terminated),
        )
    assert cleared.mean() > 0.7
    np.testing.assert_array_equal(taken[cleared], blocks[cleared])


def _graspable(height: np.ndarray) -> float:
    """phi_g of a fixed critic: 1 if somewhere something stands with room for a finger on either
    side, else 0.

    Room: nothing 36 to 64 mm to either side, along x or along y.
    """
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


def _raft(gap: float) -> Scene:
    """Two cuboids side by side along x, 100 mm square."""
    scene = _cube(0.0, 0.0, 1)
    half = scene.half_size.at[:2].set(jnp.array(blocks.SHAPES["cuboid"].half_size))
    position = scene.position.at[:2].set(
        jnp.array([[0.0, 0.5 * gap + 0.025, 0.025], [0.0, -0.5 * gap - 0.025, 0.025]])
    )
    return scene.replace(half_size=half, position=position, target=jnp.int32(layout.ANY))


def test_both_levels_of_a_push_are_reached(lab: Lab):
    """Claim: physics reaches both levels of a push (CSAC eq. 16): what breaks a packing up is worth
    +1; what misses it, or moves what could be grasped before, -1."""
    raft, alone = _raft(0.0006), _cube(0.0, 0.0)
    cases = [(raft, (-0.12, 0.025, 0.0)), (raft, BARE), (alone, (-0.07, 0.0, 0.0)), (alone, BARE)]
    scenes, places = zip(*(cases * 2), strict=True)
    before = lab.reset_to(_stack(*scenes))
    after = lab.step(before, _actions(*((Primitive.PUSH, place) for place in places)))
    assert not after.info.physics_diverged.any()
    phi = [
        np.array([_graspable(np.asarray(row)) for row in state.obs.height[:4]])
        for state in (before, after)
    ]
    np.testing.assert_array_equal(phi[0], [0.0, 0.0, 1.0, 1.0])
    cfg = CONFIG.reward
    zero, push = jnp.zeros(()), jnp.int32(Primitive.PUSH)
    level, reward = [], []
    for low, high, moved in zip(*phi, after.info.moved[:4], strict=True):
        phis, nothing = (jnp.float32(low), jnp.float32(high)), jnp.int32(Outcome.NOTHING)
        result = rewards.ActionResult(push, nothing, zero, *phis, moved > CHANGE_AREA, jnp.int32(0))
        level.append(float(rewards.push_effect(cfg, result)))
        reward.append(float(rewards.reward(cfg, result)))
    assert level == [1.0, -1.0, -1.0, -1.0]
    assert reward == [0.5, -0.5, -0.5, -0.5]  # Gamma = 0.5, eq. 13
    np.testing.assert_array_equal(
        np.asarray(after.info.moved[:4]) > CHANGE_AREA, [True, False, True, False]
    )


def _leaves(state: State) -> list[bytes]:
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state)]


def _spoil(
    state: State, action: Action, where: str, value: float, sick: int
) -> tuple[State, Action]:
    """State and action with `value` in the last entry of one leaf of scene `sick`."""

    def written(tree, leaf: str):
        old = np.array(getattr(tree, leaf))
        with np.errstate(invalid="ignore"):
            old[sick].flat[-1] = np.asarray(value).astype(old.dtype)
        return dataclasses.replace(tree, **{leaf: jnp.asarray(old)})

    part, leaf = where.split(".")
    if part == "action":
        return state, written(action, leaf)
    return dataclasses.replace(state, **{part: written(getattr(state, part), leaf)}), action


_ENTRIES = ("position", "quaternion", "velocity", "half_size", "density", "friction", "colour")
_SPOILT = [
    ("action.pose", np.nan),
    *((f"scene.{leaf}", (np.nan, np.inf, 1e6)[i % 3]) for i, leaf in enumerate(_ENTRIES)),
    *((f"scene.{leaf}", (np.nan, np.inf, 1e6)[(i + 1) % 3]) for i, leaf in enumerate(_ENTRIES[:6])),
    ("obs.height", np.nan),
    ("obs.height", 1e6),
    ("obs.colour", np.inf),
]


def test_failed_physics_stays_in_its_scene(lab: Lab):
    """Claim: NaN, infinity or 1e6 in a scene marks that scene as diverged and truncates it; the
    others' results are the same, bit for bit. What cannot be a scene is replaced by an empty
    one; a sound one stays as it was."""
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


def _assert_replaced(diverged: State, before: Scene, where: str) -> None:
    ends = (diverged.truncated, diverged.terminated, diverged.reward)
    assert ends == (True, False, 0.0), where
    assert (diverged.info.cleared, diverged.info.blocks_lost) == (0, 0), where
    for leaf in jax.tree.leaves((diverged.scene, diverged.obs)):
        assert np.isfinite(leaf).all(), where
    expected = before if where == "action.pose" else layout.parked(CONFIG.scene.slots)
    jax.tree.map(np.testing.assert_array_equal, diverged.scene, expected)


def test_pose_that_is_no_number_fails_in_c(lab: Lab):
    """Claim: NaN in an action is failed physics in C, too, in its scene alone."""
    cfg = CONFIG.change(sim={"physics": "c"})
    physics = simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    env = dataclasses.replace(lab.env, cfg=cfg, physics=physics)
    scenes = _stack(*[_cube(0.0, 0.0)] * 3)
    poses = (0.0, 0.0, 0.0), (np.nan, 0.0, 0.0), (0.0, 0.0, np.inf)
    actions = _actions(*[(Primitive.GRASP, pose) for pose in poses])
    first_step = jax.vmap(lambda scene, action: env.step(env.reset_to(scene), action))
    after = jax.jit(first_step)(scenes, actions)
    assert after.info.physics_diverged.tolist() == [False, True, True]
    assert after.info.cleared.tolist() == [1, 0, 0]
    for index in (1, 2):
        _assert_replaced(_at(after, index), _at(scenes, index), "action.pose")


def test_target_that_is_no_slot_counts_as_divergence(lab: Lab):
    """Claim: a target beyond the slots is failed physics, not a cleared table."""
    scene = _stack(*[_cube(0.0, 0.0)] * SCENES)
    wild = dataclasses.replace(
        scene, target=jnp.array([-1, 3, 1_000_000, -2, -(2**31), 0, -1, -1], jnp.int32)
    )
    action = _actions(*[(Primitive.PUSH, BARE)] * SCENES)
    state = lab.step(dataclasses.replace(lab.reset_to(scene), scene=wild), action)
    expected = np.array([False, True, True, True, True, False, False, False])
    np.testing.assert_array_equal(state.info.physics_diverged, expected)
    np.testing.assert_array_equal(state.truncated, expected)
    assert not state.terminated.any()


def test_step_is_a_fixed_point_of_types(lab: Lab):
    """Claim: step keeps shapes, dtypes and weak types: it can be scanned."""
    assert lab.into_step == lab.out_of_step
    assert not any(
        weak
        for _, _, weak in jax.tree.leaves(
            lab.into_step, is_leaf=lambda leaf: isinstance(leaf, tuple)
        )
    )


def test_resets_differ(lab: Lab):
    """Claim: every reset gives another scene, none of them the pool's first as it lies."""
    states = [lab.reset(jax.random.split(jax.random.key(seed), SCENES)) for seed in range(8)]
    positions = np.concatenate([state.scene.position for state in states])
    assert len({position.tobytes() for position in positions}) == len(positions)
    play = np.concatenate([state.scene.in_play for state in states])
    heights = [
        tuple(np.where(valid, p[:, 2], -1.0)) for p, valid in zip(positions, play, strict=True)
    ]
    pool = lab.env.scenes
    drawn = [
        next(
            i
            for i in range(len(pool.position))
            if tuple(np.where(pool.in_play[i], pool.position[i, :, 2], -1)) == h
        )
        for h in heights
    ]
    assert len(set(drawn)) >= 20  # of 32, in 48 draws
    yaws = [
        np.arctan2(*(p[v][0, :2] @ [[0, 1], [1, 0]])) for p, v in zip(positions, play, strict=True)
    ]
    raw = [
        np.arctan2(*(pool.position[i][pool.in_play[i]][0, :2] @ [[0, 1], [1, 0]])) for i in drawn
    ]
    turned = np.mod(np.array(yaws) - raw, 2 * np.pi)
    # any yaw: 12 expected in each quarter
    assert np.histogram(turned, bins=4, range=(0, 2 * np.pi))[0].min() >= 4


def test_same_key_same_scene(lab: Lab):
    """Claim: a reset is a function of its key, and its state has no history."""
    keys = jax.random.key_data(jax.random.split(jax.random.key(5), SCENES))
    first, second = (lab.reset(jax.random.wrap_key_data(keys)) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, second)
    assert not np.any(first.actions)
    assert not np.any(first.done)
    assert np.asarray(first.obs.height).max(axis=(1, 2)).min() > 0.02


def test_observations_lie_within_their_spec(lab: Lab, stepped: State):
    """Claim: what reset and step show has the shapes, dtypes and bounds of `observation_spec`."""
    spec = lab.env.observation_spec
    for state in (lab.reset(jax.random.split(jax.random.key(6), SCENES)), stepped):
        assert jax.tree.structure(spec) == jax.tree.structure(state.obs)
        for leaf, values in zip(*map(jax.tree.leaves, (spec, state.obs)), strict=True):
            assert (values.shape, values.dtype) == ((SCENES, *leaf.shape), leaf.dtype)
            assert jax.vmap(leaf.contains)(values).all()


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


@pytest.mark.parametrize(("change", "inside"), [(0.0, True), (0.1, False), (np.nan, False)])
def test_spec_tells_what_is_out_of_bounds(lab: Lab, change: float, inside: bool):
    """Claim: a spec contains its bounds, and neither what lies beyond them nor NaN."""
    for spec in (lab.env.action_spec.pose, lab.env.observation_spec.height):
        for bound, sign in ((spec.minimum, -1.0), (spec.maximum, 1.0)):
            values = jnp.broadcast_to(jnp.asarray(bound, spec.dtype), spec.shape) + sign * change
            assert spec.contains(values) == inside


def test_actions_are_built_from_numbers_or_arrays():
    """Claim: `Action.grasp` and `Action.push` build [] or batched actions, also in jit and vmap."""
    one = Action.grasp(0.02, -0.05, 0.3)
    assert (one.primitive.dtype, one.primitive, one.pose.dtype) == (
        jnp.int32,
        Primitive.GRASP,
        jnp.float32,
    )
    np.testing.assert_array_equal(one.pose, np.float32([0.02, -0.05, 0.3]))
    xs = jnp.array([0.0, 0.1, 0.2])
    pushes = (
        Action.push(xs, 0.1, xs[::-1]),
        jax.jit(jax.vmap(lambda x, yaw: Action.push(x, 0.1, yaw)))(xs, xs[::-1]),
    )
    for many in pushes:
        np.testing.assert_array_equal(many.primitive, np.full(3, Primitive.PUSH))
        np.testing.assert_array_equal(
            many.pose, np.stack([xs, np.full(3, np.float32(0.1)), xs[::-1]], 1)
        )


def test_make_env_chooses_physics(monkeypatch: pytest.MonkeyPatch):
    """Claim: `make_env` resolves physics `auto`: its config names the physics that it runs."""
    monkeypatch.setattr(pool, "scenes", lambda *_: None)
    sim = dataclasses.replace(CONFIG.sim, physics="auto")
    env = make_env(dataclasses.replace(CONFIG, sim=sim))
    assert env.cfg.sim == backend.resolve(dataclasses.replace(CONFIG, sim=sim)).sim
    assert env.cfg.sim.physics != "auto"
