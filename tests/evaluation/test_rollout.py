"""Episodes of fixed policies."""

import dataclasses
import types
import warnings
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import env as environment, presets
from csac_jax.config import Config, SensorConfig, TaskConfig
from csac_jax.constants import Outcome, Primitive
from csac_jax.env import Env, State
from csac_jax.evaluation import rollout, suites
from csac_jax.evaluation.metrics import Episodes
from csac_jax.evaluation.policies import NetworkPolicy, OraclePolicy, RandomPolicy
from csac_jax.robot.primitives import Action
from csac_jax.vision import observe
from csac_jax.world import scene_state

pytestmark = pytest.mark.mjx


class ShortTask(TaskConfig):
    """Ends after three actions without change."""

    max_steps_without_change: ClassVar[int] = 3


CFG = dataclasses.replace(presets.smoke(), task=ShortTask(max_actions=6))
ORACLE, RANDOM = OraclePolicy(CFG), RandomPolicy(CFG)
EPISODES = 5


class Magnet(Env):
    """No physics: a grasp within reach of a block's centre takes it, all else does nothing."""

    reach: ClassVar[float] = 0.012  # m

    def step(self, state: State, action: Action) -> State:
        off = jnp.linalg.norm(state.scene.position[:, :2] - action.pose[None, :2], axis=1)
        taken = state.scene.in_play & (off < self.reach) & (action.primitive == Primitive.GRASP)
        scene, took = scene_state.park(state.scene, ~taken), jnp.any(taken)
        actions, idle = state.actions + 1, jnp.where(took, 0, state.steps_without_change + 1)
        terminated, task = ~jnp.any(scene.in_play), self.cfg.task
        capped = (actions >= task.max_actions) | (idle >= task.max_steps_without_change)
        outcome = jnp.where(took, jnp.int32(Outcome.LIFTED), jnp.int32(Outcome.EMPTY))
        cleared, moved = jnp.sum(taken, dtype=jnp.int32), jnp.where(took, 25.0, 0.0)
        return state.replace(
            scene=scene,
            obs=observe.observe(self.cfg, scene),
            terminated=terminated,
            truncated=capped & ~terminated,
            actions=actions,
            steps_without_change=idle,
            reward=took.astype(jnp.float32),
            info=state.info.replace(outcome=outcome, cleared=cleared, moved=moved),
        )


def _compiled(env: Env):
    """What rollouts in this environment call, see `rollout._compiled`."""
    return rollout._compiled(type(env), env.cfg, env.physics, env.any_yaw, env.max_failures)


@pytest.fixture(scope="module")
def magnet() -> Magnet:
    made = environment.make_env(CFG, stream=1, num_scenes=EPISODES)
    return Magnet(made.cfg, made.physics, made.scenes)


@pytest.fixture(scope="module")
def random(magnet) -> Episodes:
    with jax.debug_key_reuse(True):
        return rollout.rollout(magnet, RANDOM, EPISODES, 0)


def assert_consistent(episodes: Episodes, max_actions: int) -> None:
    """What holds of every record of episodes."""
    same, (valid, taken) = np.testing.assert_array_equal, (episodes.valid, episodes.cleared)
    actions = valid.sum(axis=1)
    same(valid, np.arange(max_actions)[None] < actions[:, None])  # a prefix
    assert np.all(actions >= 1)
    assert not np.any(taken[~valid])
    gone = taken.sum(axis=1) + episodes.blocks_lost
    same(gone == episodes.blocks, episodes.completed)
    assert np.all(gone <= episodes.blocks)
    grasps = valid & (episodes.primitive == Primitive.GRASP)
    same(taken > 0, grasps & (episodes.outcome == Outcome.LIFTED))


def _blocks(env: Env) -> np.ndarray:
    """Blocks in the scenes of EPISODES episodes: the pool has six, three of two blocks and three of
    three."""
    in_play = env.scenes.in_play.sum(axis=1)
    np.testing.assert_array_equal(in_play, [2, 2, 2, 3, 3, 3])
    return in_play[[0, 1, 2, 3, 4]]


@pytest.mark.slow
def test_oracle_by_hand(magnet):
    """Claim: where a grasp above a block always takes it, the oracle takes one block with each
    action, and all."""
    episodes = rollout.rollout(magnet, ORACLE, EPISODES, 0)
    assert_consistent(episodes, CFG.task.max_actions)
    np.testing.assert_array_equal(episodes.blocks, _blocks(magnet))
    assert np.all(episodes.completed)
    np.testing.assert_array_equal(episodes.valid.sum(axis=1), episodes.blocks)
    np.testing.assert_array_equal(episodes.cleared[episodes.valid], 1)


def test_random_episodes_end_at_the_caps(magnet, random):
    """Claim: records are consistent; an episode that is not completed ran to the action cap or the
    no-change cap."""
    assert_consistent(random, CFG.task.max_actions)
    assert random.valid.shape == (EPISODES, CFG.task.max_actions)
    assert not np.all(random.completed)
    most = CFG.task.max_steps_without_change
    for i, (cleared, valid) in enumerate(zip(random.cleared, random.valid, strict=True)):
        num = valid.sum()
        idle = num >= most and not np.any(cleared[num - most : num])
        capped = 1 if num == CFG.task.max_actions else 2 if idle else None
        assert random.ending[i] == (0 if random.completed[i] else capped)
    np.testing.assert_array_equal(random.changed & random.valid, random.cleared > 0)
    assert not random.wrong.any()


def test_same_seed_same_episodes(magnet, random):
    """Claim: the same seed gives the same episodes, another seed others."""
    again, other = (rollout.rollout(magnet, RANDOM, EPISODES, seed) for seed in (0, 1))
    jax.tree.map(np.testing.assert_array_equal, random, again)
    assert any(not np.array_equal(a, b) for a, b in zip(random, other, strict=True))


def test_batches_do_not_matter(magnet, random, monkeypatch):
    """Claim: what an episode draws does not depend on how many run side by side, nor on one left
    over."""
    (begin, _), key = _compiled(magnet), jax.random.key(0)
    rows = [
        jax.tree.map(lambda leaf, some=some: leaf[some], magnet.scenes)
        for some in (slice(0, 5), slice(3, 5))
    ]
    whole, part = begin(key, jnp.arange(5), rows[0]), begin(key, jnp.arange(3, 5), rows[1])
    np.testing.assert_allclose(whole.scene.position[3:], part.scene.position, atol=1e-6)
    monkeypatch.setattr(rollout, "SIDE_BY_SIDE", 3)
    apart = rollout.rollout(magnet, RANDOM, EPISODES, 0)
    jax.tree.map(np.testing.assert_array_equal, random, apart)


def test_policies_of_equal_fields_are_told_apart(magnet, monkeypatch):
    """Claim: what a policy's program is found by holds its type: JAX takes the structures of
    dataclasses with equal fields for equal, and runs the program of the one for the other where
    their hashes share seven bits."""
    begin, step = _compiled(magnet)
    kinds = []

    def spied(*args: object) -> object:
        kinds.append([leaf for leaf in jax.tree.leaves(args) if isinstance(leaf, type)])
        return step(*args)

    monkeypatch.setattr(rollout, "_compiled", lambda *_: (begin, spied))
    for policy in (ORACLE, RANDOM):
        kinds.clear()
        rollout.rollout(magnet, policy, EPISODES, 0)
        assert all(kind == [type(policy)] for kind in kinds)
        assert kinds


def test_function_is_a_policy(magnet):
    """Claim: any object with a config that maps a state and a key to an action can be measured; as
    it may be no pytree, its calls compile once for it."""
    calls = []

    class Same:
        cfg = CFG

        def __call__(self, scene: State, key: jax.Array) -> Action:
            calls.append(type(scene))
            return RANDOM(scene, key)

    own, episodes = Same(), rollout.rollout(magnet, RANDOM, EPISODES, 0)
    for _ in range(2):
        again = rollout.rollout(magnet, own, EPISODES, 0)
        jax.tree.map(np.testing.assert_array_equal, episodes, again)
    assert calls == [State]


def test_evaluate_gives_metrics(magnet, monkeypatch):
    """Claim: the metrics of one part come as they are, of several by their names; our policies act
    in the world of each part's environment, whatever their own config's is."""
    elsewhere = OraclePolicy(presets.quick())
    for name, parts in (("one", {"a": magnet}), ("two", {"a": magnet, "b": magnet})):
        monkeypatch.setitem(suites.SUITES, name, suites.Suite(lambda *_, parts=parts: parts))
    told = []
    one = rollout.evaluate(elsewhere, "one", EPISODES, on_progress=lambda *at: told.append(at))
    two = rollout.evaluate(elsewhere, "two", EPISODES)
    assert two == {"parts": {"a": one, "b": one}}
    assert one["completion"]["value"] == one["action_efficiency"]["value"] == 1.0
    assert told[-1] == ("a", EPISODES, EPISODES)
    random = rollout.evaluate(RandomPolicy(presets.quick()), "one", EPISODES)
    assert random == rollout.evaluate(RANDOM, "one", EPISODES)


def test_physics_that_are_named_are_taken(monkeypatch):
    """Claim: physics that are named are taken; `auto` is C MuJoCo on a CPU."""
    monkeypatch.setitem(suites.SUITES, "none", suites.Suite(lambda *_: {}))
    for physics in ("c", "mjx"):
        got = suites.prepare(CFG, "none", physics=physics, robot="ur5").cfg
        assert (got.sim.physics, got.sim.robot) == (physics, "ur5")
        assert dataclasses.replace(got, sim=CFG.sim) == CFG
    wanted = "c" if jax.default_backend() == "cpu" else "mjx"
    assert suites.prepare(presets.get("fast"), "none").cfg.sim.physics == wanted


@pytest.mark.slow
def test_oracle_beats_random_in_physics():
    """Claim: in physics too the oracle clears more blocks per action than random grasps above
    blocks."""
    cfg = presets.smoke()
    env = environment.make_env(cfg, stream=1, num_scenes=12)
    policies = OraclePolicy(cfg), RandomPolicy(cfg)
    oracle, random = (rollout.rollout(env, policy, 12, 0) for policy in policies)
    for episodes in (oracle, random):
        assert_consistent(episodes, cfg.task.max_actions)
    efficiency = [e.cleared.sum() / e.valid.sum() for e in (oracle, random)]
    assert efficiency[0] > 1.3 * efficiency[1]
    assert oracle.completed.mean() >= 0.75


ANY: Any = {"sim": {"physics": "auto"}}
ONE = presets.quick().change(scene={"packed_fraction": 0.0}, **ANY)
BOTH = presets.general().change(sensor=SensorConfig(), **ANY)


@pytest.mark.parametrize(
    ("cfg", "change", "text"),
    [
        (ONE, {"sim": {"gripper": "franka_hand"}}, "hand rg2, not franka_hand: expect less"),
        (ONE, {"heightmap": {"view": "oblique"}}, "view maps from above, not exact images of an"),
        (ONE, {"task": {"kind": "target"}}, "task take all, not get a marked one"),
        (ONE, {"scene": {"slots": ("object",) * 5, "objects": "x"}}, "with blocks, not objects of"),
        (ONE, {"train": {"scenes": 1}, "sim": {"physics": "c"}}, None),
        *((BOTH, {"task": {"kind": kind}}, None) for kind in ("clear", "target")),
        *((BOTH, {"scene": {"slots": (s,), "min_blocks": 1}}, None) for s in ("box", "object")),
    ],
)
def test_policies_say_what_they_were_not_made_for(
    monkeypatch: pytest.MonkeyPatch, cfg: Config, change: dict[str, Any], text: str | None
):
    """Claim: an evaluation of networks warns in one line of a hand, view, task or objects that they
    were not trained with; one of other policies does not, nor of what changes no decision, nor of
    networks that were trained in both."""
    part = types.SimpleNamespace(cfg=cfg.change(**change), scenes=None)
    suite = suites.PreparedSuite("s", cfg, {"s": part}, 1, 0)
    monkeypatch.setattr(rollout, "rollout", lambda *_: None)
    monkeypatch.setattr(rollout.metrics, "summarise", lambda _: {})
    monkeypatch.setattr(rollout.object_slots, "fingerprint", lambda *_: "")
    monkeypatch.setattr(rollout, "_by_object", lambda *_: {})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rollout.evaluate(RandomPolicy(cfg), suite)
        assert caught == []
        rollout.evaluate(NetworkPolicy(cfg, None), suite)
    lines = [str(warning.message) for warning in caught]
    assert len(lines) == (text is not None)
    assert all(text in line and "\n" not in line for line in lines)
