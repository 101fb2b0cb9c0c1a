"""The compiled training step, with the smallest preset."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.agent import actor, actor_critic, rewards, values
from csac_jax.agent.csac import CSAC
from csac_jax.agent.learner import Learner, UpdateInfo
from csac_jax.config import Config, PrioritisedReplay
from csac_jax.constants import Outcome, Primitive
from csac_jax.env import Env
from csac_jax.io import checkpoint
from csac_jax.replay import ring, samplers
from csac_jax.robot.primitives import Action
from csac_jax.sim import physics as simulation
from csac_jax.training import programs, split_step, step, transitions
from csac_jax.training.step import Program, TrainState
from csac_jax.training.transitions import StepMetrics
from csac_jax.vision.heightmap import Observation

pytestmark = pytest.mark.mjx

C = {"physics": "c"}  # compiles fastest
CFG = presets.smoke().change(sim=C, replay={"capacity": 1024})  # a ring larger than all else
T = CFG.train.chunk
NUM_SEEN = T * CFG.train.scenes
HOST = ("callback", "infeed", "outfeed", "device_put", "debug_print")


class Run(NamedTuple):
    """A compiled chunk and what it did."""

    program: Program
    chunk: Callable[[TrainState], tuple[TrainState, StepMetrics]]  # uses up its argument
    states: list[TrainState]  # at the start and after each chunk
    metrics: list[StepMetrics]
    compilations: int  # by the calls after the first


def copy(state: TrainState) -> TrainState:
    return jax.tree.map(jnp.copy, state)


def half_in_reach(cfg: Config, height: jax.Array, action: Action) -> jax.Array:
    """Stands in for `physics.reachable`, which is true for a floating hand."""
    del cfg, height
    return action.pose[0] < 0.0


@pytest.fixture(scope="module")
def run() -> Run:
    """Three chunks of one compiled program; the warm-up ends in the first."""
    counted: list[str] = []

    def count(event: str, _: float, **__: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            counted.append(event)

    with jax.debug_key_reuse(True), mock.patch.object(simulation, "reachable", half_in_reach):
        program = programs.make(CFG)
        states = [programs.init(program)]
        chunk = programs.compile_chunk(program, T).lower(states[0]).compile()
        metrics = []
        compilations = 0
        jax.monitoring.register_event_duration_secs_listener(count)
        for number in range(3):
            inputs, before = copy(states[-1]), len(counted)
            state, seen = jax.block_until_ready(chunk(inputs))
            compilations += len(counted) - before if number else 0
            states.append(state)
            metrics.append(jax.device_get(seen))
        jax.monitoring.unregister_event_duration_listener(count)
    assert counted  # the first copy is compiled
    return Run(program, chunk, states, metrics, compilations)


def leaves(tree: Any) -> list[tuple[str, np.ndarray]]:
    """Returns names and values of all leaves; keys as their bits."""

    def value(leaf: Any) -> np.ndarray:
        is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if is_key else leaf)

    named = jax.tree_util.tree_leaves_with_path(tree)
    return [(jax.tree_util.keystr(path), value(leaf)) for path, leaf in named]


def assert_same(first: Any, other: Any) -> None:
    for (name, a), (_, b) in zip(leaves(first), leaves(other), strict=True):
        np.testing.assert_array_equal(a, b, err_msg=name)


def equal(first: Any, other: Any) -> bool:
    pairs = zip(leaves(first), leaves(other), strict=True)
    return all(np.array_equal(a, b) for (_, a), (_, b) in pairs)


def test_chunks_after_the_first_compile_nothing(run):
    """Claim: one program serves every chunk; nothing is compiled while it runs on."""
    assert run.compilations == 0
    assert [int(state.step) for state in run.states] == [0, T, 2 * T, 3 * T]


@pytest.mark.slow
def test_two_programs_do_what_one_does(run: Run):
    """Claim: a chunk as two programs, one of which acts and the other learns, ends in the states of
    the one program, and measures the same."""
    with mock.patch.object(simulation, "reachable", half_in_reach):
        chunk = split_step.compile_chunk(run.program, T).lower(run.states[0]).compile()
    for number in range(2):  # each from the same state: physics makes much of what rounding does
        state, metrics = chunk(copy(run.states[number]))
        wanted = (run.states[number + 1], run.metrics[number])
        for (name, a), (_, b) in zip(leaves(wanted), leaves((state, metrics)), strict=True):
            if name.rpartition(".")[2] in transitions.LOSSES:
                a, b = (np.where(metrics.learned, loss, 0.0) for loss in (a, b))
            np.testing.assert_allclose(b, a, rtol=1e-4, atol=1e-5, err_msg=name)
    assert metrics.learned.all()
    assert not run.metrics[0].learned.all()


class Pusher(Learner):
    """Pushes at random places, and learns nothing."""

    def init(self, key: jax.Array) -> Any:
        return jnp.zeros(())

    def act(self, key: jax.Array, state: Any, obs: Observation, *_: Any) -> Action:
        pose = jax.random.uniform(key, (len(obs.height), 3), minval=-0.1, maxval=0.1)
        return jax.vmap(Action.push)(*pose.T)

    def update(self, key: jax.Array, state: Any, batch: Any, weights: jax.Array) -> Any:
        raise NotImplementedError


def test_overlap_learns_from_what_was_before(monkeypatch: pytest.MonkeyPatch):
    """Claim: with overlap a step acts as without, and learns from the transitions before it."""

    def learn(_: Program, __: jax.Array, learner: Any, replay: Any, ___: jax.Array) -> Any:
        zero = jnp.zeros(())
        names = ("critic_loss", "actor_loss", "td_error")
        return learner, replay.priority, dict.fromkeys(names, zero) | {"q_mean": replay.size * 1.0}

    monkeypatch.setattr(step, "learn", learn)
    ends, seen = [], []
    for overlap in (False, True):
        train = {"overlap": overlap, "learning_starts": 1}
        cfg = CFG.change(learn={"batch": 1}, train=train)
        program = programs.make(cfg, learner=Pusher())
        run = jax.jit(functools.partial(programs.run_steps, program, 3))
        state, metrics = run(programs.init(program))
        ends.append(state)
        seen.append(metrics)
    assert_same(ends[0], ends[1])
    np.testing.assert_array_equal([one.q_mean for one in seen], [[2, 4, 6], [0, 2, 4]])
    np.testing.assert_array_equal([one.learned for one in seen], [[1, 1, 1], [0, 1, 1]])


def test_chunk_does_not_speak_to_the_host():
    """Claim: no callback, no feed and no transfer in a chunk with MJX, at any depth. It runs."""
    program = programs.make(CFG.change(sim={"physics": "mjx"}))
    traced = programs.compile_chunk(program, T).trace(begun := programs.init(program))
    loud = jax.make_jaxpr(jax.vmap(jax.jit(lambda x: jax.debug.print("{x}", x=x))))(jnp.ones(2))
    quiet, spoken = (str(jaxpr) for jaxpr in (traced.jaxpr, loud))  # nested programs too
    assert all(f" {name}[" in quiet for name in ("scan", "while", "conv_general_dilated", "sort"))
    assert not any(word in quiet for word in HOST)
    assert any(word in spoken for word in HOST)
    after, metrics = traced.lower().compile()(begun)
    assert int(after.replay.size) == NUM_SEEN
    assert not np.any(metrics.physics_diverged)


def test_replay_is_updated_in_place(run):
    """Claim: the compiled step copies no replay memory: the whole state is given back in its own
    memory, and what is needed besides is smaller than half a ring."""
    memory = run.chunk.memory_analysis()
    ring = sum(leaf.nbytes for leaf in jax.tree.leaves(run.states[0].replay))
    state = sum(leaf.nbytes for _, leaf in leaves(run.states[0]))
    assert memory.alias_size_in_bytes >= state > ring
    assert memory.temp_size_in_bytes < ring / 2


class Still(Env):
    """The environment without physics: compiles fast."""

    def step(self, state, action):
        return state.replace(actions=state.actions + 1)


class Losing(Still):
    """It drives a block out with every action."""

    def step(self, state, action):
        return state.replace(info=state.info.replace(blocks_lost=jnp.int32(1)))


@pytest.mark.slow
def test_blocks_that_left_reach_the_reward(run):
    """Claim: a step takes `reward.lost_block_penalty` where a block has left, from grasps of
    nothing and worthless pushes alike."""
    cfg = CFG.change(reward={"lost_block_penalty": 0.75})
    reward, env = cfg.reward, Losing(cfg, run.program.env.physics, run.program.env.scenes)
    program = programs.make(cfg, env=env)
    _, metrics = jax.jit(functools.partial(step.train_step, program))(copy(run.states[0]))
    grasp = reward.grasp_levels[Outcome.NOTHING] - 0.75
    push = rewards.scale(reward, reward.push_level) * reward.push_levels[0] - 0.75
    wanted = np.where(metrics.primitive == Primitive.GRASP, grasp, push)
    np.testing.assert_allclose(metrics.reward, wanted, rtol=1e-6)


def test_same_seed_gives_the_same_run(run):
    """Claim: two runs of one seed are the same in every bit of state and metrics."""
    state, metrics = run.chunk(copy(run.states[0]))
    assert_same(state, run.states[1])
    assert_same(metrics, run.metrics[0])


def test_seeds_differ(run):
    """Claim: seeds 0 and 1 begin with other scenes and networks, and choose and see other things in
    every scene."""
    other_cfg = dataclasses.replace(CFG, seed=1)
    begun = programs.init(dataclasses.replace(run.program, cfg=other_cfg))
    for name in ("scenes", "learner"):
        assert not equal(getattr(begun, name), getattr(run.states[0], name)), name
    state, _ = run.chunk(begun)
    pose = lambda state: np.asarray(state.replay.items.action.pose[:NUM_SEEN])  # noqa: E731
    poses, others = pose(run.states[1]), pose(state)
    assert np.all(np.any(poses != others, axis=1))


def test_scenes_and_steps_differ(run):
    """Claim: alike scenes, looked at by the same network, are acted on in different ways, and at
    each step in others."""
    state = run.states[1]
    alike = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:1], leaf.shape), state.scenes)
    first = int(state.replay.size)  # where the next actions are stored

    def poses(number: int) -> np.ndarray:
        after, _ = run.chunk(copy(state.replace(scenes=alike, step=jnp.int32(number))))
        return np.asarray(after.replay.items.action.pose)[first : first + CFG.train.scenes]

    acted = np.concatenate([poses(number) for number in range(T, T + 4)])
    assert len(np.unique(acted, axis=0)) == len(acted) == 4 * CFG.train.scenes


def test_nothing_is_learned_before_the_warm_up(run):
    """Claim: until `train.learning_starts` actions are done the networks, targets and optimisers
    stay as they are; then each training step has its updates."""
    assert run.metrics[0].learned.tolist() == [False, False, False, True]  # 8 actions, 2 per step
    late = run.states[0].replace(step=jnp.int32(-T - 1))  # a chunk ends before the warm-up does
    state, metrics = run.chunk(copy(late))
    assert not np.any(metrics.learned)
    assert_same(state.learner, run.states[0].learner)
    assert state.learner.updates == 0
    for name in ("critic", "actor"):
        before, after = (getattr(s.learner.online, name) for s in (run.states[0], run.states[1]))
        assert not equal(before, after), name
    updates = [int(s.learner.updates) for s in run.states]
    assert updates == [CFG.learn.updates_per_step * n for n in (0, 1, 1 + T, 1 + 2 * T)]
    assert updates == [int(step.updates_done(CFG, s.step)) for s in run.states]
    assert all(np.all(np.isfinite(m.critic_loss)) for m in run.metrics)


def test_resuming_goes_on_as_if_nothing_had_happened(run, tmp_path):
    """Claim: a run saved and restored between chunks is the uninterrupted one in every bit of every
    leaf."""
    checkpoint.save(tmp_path, T, run.states[1], CFG, {})
    restored, _ = checkpoint.restore(tmp_path, jax.eval_shape(lambda: run.states[0]))
    assert_same(restored, run.states[1])
    state, metrics = run.chunk(restored)
    assert_same(state, run.states[2])
    assert_same(metrics, run.metrics[1])


def test_every_action_is_stored(run):
    """Claim: the ring holds, in order, what was done and seen; each scene's next view is what it
    acts on next."""
    state, metrics = run.states[-1], run.metrics
    size = int(state.replay.size)
    assert size == 3 * NUM_SEEN == int(state.replay.head)
    shape = (3 * T, CFG.train.scenes)
    rows = lambda leaf: np.asarray(leaf[:size]).reshape(*shape, *leaf.shape[1:])  # noqa: E731
    items = jax.tree.map(rows, state.replay.items)
    stored = {"reward": items.reward, "primitive": items.action.primitive}
    for name, column in (stored | {"terminated": items.terminated}).items():
        wanted = np.concatenate([getattr(m, name) for m in metrics])
        np.testing.assert_array_equal(column, wanted, err_msg=name)
    done = np.concatenate([m.terminated | m.truncated for m in metrics])[:-1]
    assert not np.all(done)
    np.testing.assert_array_equal(items.next_obs.height[:-1][~done], items.obs.height[1:][~done])


def test_actions_out_of_reach_are_counted(run):
    """Claim: the metrics say which actions the robot could not follow."""
    size = int(run.states[-1].replay.size)
    x = np.asarray(run.states[-1].replay.items.action.pose[:size, 0])
    counted = np.concatenate([metrics.unreachable for metrics in run.metrics])
    np.testing.assert_array_equal(counted.ravel(), x >= 0.0)
    assert 0 < counted.sum() < size


def test_finished_scenes_are_replaced(run):
    """Claim: a scene that is cut off gives way to a fresh one, with no actions taken; its last
    transition is stored as not terminated, so that it bootstraps. The other scene goes on."""
    near_end = jnp.array([CFG.task.max_actions - T, 0], jnp.int32)
    scenes = run.states[0].scenes.replace(actions=near_end)
    state, metrics = run.chunk(copy(run.states[0].replace(scenes=scenes)))
    ended = np.asarray(metrics.terminated | metrics.truncated)
    assert ended[:, 0].any()
    for scene, ends in enumerate(map(np.flatnonzero, ended.T)):
        since = T - 1 - ends[-1] if ends.size else T + int(near_end[scene])
        assert state.scenes.actions[scene] == since
    assert not np.any(state.scenes.terminated | state.scenes.truncated)
    if metrics.truncated[-1, 0]:
        assert not np.asarray(state.replay.items.terminated)[NUM_SEEN - 2]
        assert np.all(state.scenes.steps_without_change[0] == 0)


def test_a_cleared_table_is_a_true_end(run):
    """Claim: an empty scene terminates, is stored as such and is replaced by one with blocks."""
    scenes = run.states[0].scenes
    in_play = scenes.scene.in_play & np.array([[False], [True]])
    aside = jnp.asarray([[3.0 + 0.3 * i, 0.0, 1.0] for i in range(3)])
    position = scenes.scene.position.at[0].set(aside)
    placed = scenes.scene.replace(in_play=in_play, position=position)
    empty = jax.jit(jax.vmap(lambda scene: Env.reset_to(run.program.env, scene)))(placed)
    state, metrics = run.chunk(copy(run.states[0].replace(scenes=empty)))
    assert metrics.terminated[0].tolist() == [True, False]
    assert state.replay.items.terminated[0]
    assert np.all(np.any(state.scenes.scene.in_play, axis=1))


def test_ill_scenes_leave_no_trace(run):
    """Claim: a scene whose physics fails is replaced and its transition is not stored; the other
    one's are, and are the same, bit for bit."""
    scenes = run.states[0].scenes
    broken = scenes.scene.replace(velocity=scenes.scene.velocity.at[0].set(jnp.nan))
    state, metrics = run.chunk(copy(run.states[0].replace(scenes=scenes.replace(scene=broken))))
    assert metrics.physics_diverged[0].tolist() == [True, False]
    assert (metrics.truncated[0, 0], metrics.terminated[0, 0]) == (True, False)
    for name in ("primitive", "outcome", "cleared", "reward"):
        ours, theirs = (getattr(seen, name)[:, 1] for seen in (metrics, run.metrics[0]))
        np.testing.assert_array_equal(ours, theirs, err_msg=name)
    assert int(state.replay.size) == NUM_SEEN - int(np.sum(metrics.physics_diverged))
    for name, leaf in leaves(state):
        assert np.issubdtype(leaf.dtype, np.integer) or np.all(np.isfinite(leaf)), name


@pytest.mark.parametrize("part", ["reward", "critic_optimiser", "online", "target"])
def test_nan_is_reported_at_once(run, part: str):
    """Claim: NaN in the rewards that are learned from, in what Adam keeps of a gradient, or in a
    network is found in the metrics of the chunk that it reaches."""
    lose = lambda leaf: jnp.full_like(leaf, jnp.nan) if leaf.dtype == jnp.float32 else leaf  # noqa: E731
    state = copy(run.states[1])
    if part == "reward":
        items = state.replay.items.replace(reward=lose(state.replay.items.reward))
        state = state.replace(replay=state.replay.replace(items=items))
    else:
        lost = {part: jax.tree.map(lose, getattr(state.learner, part))}
        state = state.replace(learner=state.learner.replace(**lost))
    assert run.metrics[1].finite.all()
    assert not run.chunk(state)[1].finite.all()


@pytest.mark.parametrize("sampler", ["prioritised", "beta"])
def test_weights_and_priorities_reach_their_places(monkeypatch, sampler):
    """Claim: the sampler's weights are those of the critic's loss, and what a batch's errors make
    of priorities is stored in the slots that were drawn, and nowhere else. Sampler and networks
    stand in."""
    num = CFG.learn.batch
    weights, error = jnp.linspace(0.5, 1.0, num), jnp.linspace(-1.0, 1.0, num)

    def update(self, key, state, batch, weights):
        return state, UpdateInfo(jnp.sum(weights * error), jnp.float32(0.0), error)

    nothing: Any = None
    cfg, slots = CFG.change(replay={"capacity": 64, "sampler": sampler}), 2 * jnp.arange(num)
    made, drawn = samplers.make(cfg.replay), samplers.Sample(slots, weights)
    monkeypatch.setattr(type(made), "sample", lambda *_: drawn)
    monkeypatch.setattr(PrioritisedReplay, "alpha", 0.5)
    monkeypatch.setattr(PrioritisedReplay, "per_epsilon", 0.25)
    monkeypatch.setattr(CSAC, "update", update)
    monkeypatch.setattr(CSAC, "update_actor", lambda self, state, obs: (state, jnp.float32(0.0)))
    replay = ring.init(jnp.full(64, 7.0), programs.example(cfg)).replace(size=jnp.int32(64))
    learner_state = actor_critic.LearnerState(None, None, None, None, jnp.int32(0))
    program = Program(cfg, nothing, CSAC(nothing), made)
    inputs = jax.random.key(0), learner_state, replay, jnp.int32(0)
    _, priority, losses = step.learn(program, *inputs)
    np.testing.assert_allclose(losses["critic_loss"], np.sum(weights * error), rtol=1e-5)
    expected, size = np.full(64, 7.0), np.abs(error)
    expected[: 2 * num : 2] = np.sqrt(size + 0.25) if sampler == "prioritised" else size
    np.testing.assert_allclose(priority, expected, rtol=1e-6)


def test_only_pushes_ask_for_the_best_grasps(monkeypatch: pytest.MonkeyPatch):
    """Claim: phi_g before and after an action is the target critic's of a scene that was pushed,
    and 0 of any other. A stand-in values a map by its height."""
    monkeypatch.setattr(rewards, "rewards_of", lambda _, result: result[3:5])

    def best_grasps(learner: Any, params: Any, obs: Observation, asked: jax.Array) -> jax.Array:
        assert params == "target"
        return jnp.where(asked, obs.height.sum(axis=(1, 2)), 0.0)

    monkeypatch.setattr(values, "best_grasps", best_grasps)
    learner = actor_critic.make(CFG)
    state = actor_critic.LearnerState("online", "target", None, None, 0)
    views = [Observation(*(jnp.full((2, 4, 4), n),) * 3) for n in (1.0, 2.0)]
    none, zeros, no = jnp.zeros(2, jnp.int32), jnp.zeros(2), jnp.zeros(2, bool)
    for pushed in ([False, True], [True, True], [False, False]):
        primitive = jnp.where(jnp.array(pushed), Primitive.PUSH, Primitive.GRASP)
        result = rewards.ActionResult(primitive, none, zeros, zeros, zeros, no, none)
        found = CSAC(learner).reward(CFG.reward, state, *views, result)
        wanted = np.where(pushed, [[16.0], [32.0]], 0.0)
        np.testing.assert_array_equal(np.stack(found), wanted)


def test_actor_learns_on_a_part_of_the_batch(monkeypatch: pytest.MonkeyPatch):
    """Claim: the actor's update takes `learn.actor_batch` of the batch's transitions, all if that
    is 0."""
    taken = []

    def update(learner, state, obs):
        taken.append(obs.height.shape[0])
        return state, jnp.zeros(())

    monkeypatch.setattr(actor, "update", update)
    for actor_batch in (0, 3):
        cfg = CFG.change(learn={"actor_batch": actor_batch})
        program = programs.make(cfg, env=object())
        state = jax.eval_shape(program.learner.init, jax.random.key(0))
        replay = jax.eval_shape(lambda: ring.init(jnp.zeros(64), programs.example(CFG)))
        learn = functools.partial(step.learn, program)
        jax.eval_shape(learn, jax.random.key(0), state, replay, jnp.int32(0))
    assert taken == [CFG.learn.batch, 3]
