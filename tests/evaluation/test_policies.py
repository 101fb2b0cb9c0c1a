"""Policies as objects: one scene and a key in, an action out."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import env as environment, presets
from csac_jax.agent import actor_critic, csac, policy, values
from csac_jax.constants import Primitive
from csac_jax.env import State
from csac_jax.evaluation import policies
from csac_jax.evaluation.policies import GeometricPolicy, NetworkPolicy, OraclePolicy, RandomPolicy
from csac_jax.io import checkpoint, policy_file
from tests.networks import random_params

pytestmark = pytest.mark.mjx

SMOKE = presets.smoke()
CFG = SMOKE.change(policy={"primitive": "rule"}, sim={"physics": "c"})
SCENES = 3


@pytest.fixture(scope="module")
def learned() -> NetworkPolicy:
    """Networks that no training gives."""
    return NetworkPolicy(CFG, random_params(CFG))


@pytest.fixture(scope="module")
def states() -> State:
    """Settled scenes; the last actions of the second one changed nothing."""
    env = environment.make_env(CFG, stream=1, num_scenes=SCENES)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(0), jnp.arange(SCENES))
    states = jax.jit(jax.vmap(env.reset))(keys)
    return states.replace(steps_without_change=jnp.array([0, 2, 0], jnp.int32))


def _scene(states: State, number: int) -> State:
    return jax.tree.map(lambda leaf: leaf[number], states)


def _keys() -> jax.Array:
    return jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(5), jnp.arange(SCENES))


def test_learned_acts_like_the_agent(learned, states):
    """Claim: the learned policy is `agent.policy.best_action` of the networks' maps, in a batch and
    in one scene."""
    parts = actor_critic.make(CFG)

    @jax.jit
    def wanted(params, states, keys):
        dense_maps = values.dense_maps(parts, params, states.obs)
        best = jax.vmap(policy.best_action, (0, None, 0, 0))
        return best(keys, parts, dense_maps, states.steps_without_change)

    expected = wanted(learned.params, states, _keys())
    batch = jax.jit(NetworkPolicy.batched)(learned, states, _keys())
    jax.tree.map(np.testing.assert_array_equal, batch, expected)
    assert batch.primitive.tolist() == [Primitive.GRASP, Primitive.PUSH, Primitive.GRASP]
    for number in range(SCENES):
        one = learned(_scene(states, number), _keys()[number])
        assert one.primitive == expected.primitive[number]
        np.testing.assert_allclose(one.pose, expected.pose[number], atol=1e-4)


def test_mirror_images_reach_the_policy(learned, states):
    """Claim: with `policy.augment` a policy, what is drawn of it and a learner without exploration
    follow `decision_maps`, by which they act otherwise than without."""
    off = CFG.change(
        policy={"place": "argmax", "primitive": "grasp"}, explore={"push_fraction": 0.0}
    )
    cfg = off.change(policy={"augment": True})
    parts, key = actor_critic.make(cfg), jax.random.key(0)
    state = jax.jit(lambda key: actor_critic.init(key, parts))(key)
    look = jax.jit(lambda obs: values.decision_maps(parts, state.online, obs))
    best = jax.vmap(policy.best_action, (0, None, 0, 0))
    expected = best(_keys(), parts, look(states.obs), states.steps_without_change).pose
    mirrored, plain = (NetworkPolicy(one, state.online) for one in (cfg, off))
    np.testing.assert_allclose(mirrored.batched(states, _keys()).pose, expected, atol=1e-5)
    agent = csac.CSAC(parts).act(key, state, states.obs, states.steps_without_change)
    np.testing.assert_allclose(agent.pose, expected, atol=1e-5)
    value = jax.vmap(values.best_grasp)(look(states.obs))[0]
    np.testing.assert_allclose(mirrored.debug(_scene(states, 0), key).best_grasp, value, atol=1e-6)
    assert np.abs(plain.batched(states, _keys()).pose - expected).max() > 0.005


def test_failures_lead_to_other_places(learned, states):
    """Claim: with `policy.retry_temperature` an action after failed grasps is drawn, another for
    another key; without failures, or from an observation, it is the best one."""
    greedy = CFG.change(policy={"place": "argmax"})
    cfgs = (greedy, greedy.change(policy={"retry_temperature": 10.0}))
    learned, bold = (dataclasses.replace(learned, cfg=cfg) for cfg in cfgs)
    state, key = _scene(states, 0), jax.random.key
    failed = state.replace(failed_grasps=jnp.int32(3))
    for seen in (state, failed.obs):
        jax.tree.map(np.testing.assert_array_equal, bold(seen, key(0)), learned(state, key(0)))
    calm = [learned(failed, key(seed)).pose for seed in range(3)]
    drawn = [bold(failed, key(seed)).pose for seed in range(3)]
    assert max(np.ptp(np.stack(calm)[:, :2], axis=0)) < 0.02
    assert max(np.ptp(np.stack(drawn)[:, :2], axis=0)) > 0.02
    tried = bold.debug(failed, key(0)).candidates.reshape(-1, 3)
    assert np.abs(tried - drawn[0]).max(axis=1).min() < 1e-5


def test_observation_serves_for_a_state(learned, states):
    """Claim: learned and random policy act on a bare observation as in the state; without a state
    no action counts as one without change."""
    state, other = _scene(states, 0), _scene(states, 1)
    for one in (learned, RandomPolicy(CFG), GeometricPolicy(CFG)):
        a, b = (one(seen, jax.random.key(1)) for seen in (state, state.obs))
        jax.tree.map(np.testing.assert_array_equal, a, b)
    assert learned(other, jax.random.key(1)).primitive == Primitive.PUSH
    assert learned(other.obs, jax.random.key(1)).primitive == Primitive.GRASP


def test_oracle_asks_for_a_state(states):
    """Claim: the oracle acts on a state; it and the planner say so where they are given an
    observation."""
    state = _scene(states, 0)
    action = OraclePolicy(CFG)(state, jax.random.key(1))
    places = state.scene.position[np.asarray(state.scene.in_play), :2]
    assert np.linalg.norm(places - action.pose[:2], axis=1).min() < 1e-6
    for blind in (OraclePolicy(CFG), policies.PlannerPolicy(CFG)):
        with pytest.raises(TypeError, match="give it a State"):
            blind(state.obs, jax.random.key(1))


@pytest.mark.parametrize("kind", [RandomPolicy, GeometricPolicy, OraclePolicy])
def test_policies_are_pure(kind, states):
    """Claim: a policy can be vmapped and jitted, itself an argument; it is as in each scene."""
    batch = jax.jit(lambda one, *at: jax.vmap(one)(*at))(kind(CFG), states, _keys())
    for number in range(SCENES):
        one = kind(CFG)(_scene(states, number), _keys()[number])
        assert one.primitive == batch.primitive[number]
        np.testing.assert_allclose(one.pose, batch.pose[number], atol=1e-6)


def test_load_reads_a_file(tmp_path, learned):
    """Claim: a policy comes from its file, as learned; the other kinds take the config alone."""
    path = tmp_path / "policy.safetensors"
    policy_file.save(path, learned.params, CFG)
    read = policies.load(str(path))
    assert read.cfg == CFG
    jax.tree.map(np.testing.assert_array_equal, read.params, learned.params)
    assert policies.make("random", str(path)) == RandomPolicy(CFG)
    assert policies.make("oracle", str(path)) == OraclePolicy(CFG)
    with pytest.raises(FileNotFoundError, match="there is no folder nowhere"):
        policies.load("nowhere")


def test_a_state_that_does_not_fit_is_refused(tmp_path, monkeypatch: pytest.MonkeyPatch):
    """Claim: a checkpoint whose state exceeds the memory is refused before it is read."""
    cfg = SMOKE.change(replay={"capacity": 2**30})
    checkpoint.save(tmp_path, 1, {"step": jnp.int32(1)}, cfg, {})
    monkeypatch.setattr(checkpoint, "restore", None)
    with pytest.raises(checkpoint.CheckpointError, match=r"its state takes \d+\.\d GiB"):
        policies.load(tmp_path)


def test_policy_of_a_module(tmp_path, monkeypatch: pytest.MonkeyPatch):
    """Claim: `MODULE:NAME` is a callable in the current folder, called with the config of the
    source; one that is missing is one line."""
    code = "from csac_jax.evaluation.policies import RandomPolicy\n\ndef mine(cfg):\n"
    (tmp_path / "my_policies.py").write_text(code + "    return RandomPolicy(cfg)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    made = policies.make("my_policies:mine", "shipped")
    assert made == RandomPolicy(policies.load_config("shipped"))
    for path in ("my_policies:yours", "no_module:mine"):
        with pytest.raises(ValueError, match=rf"^policy: '{path}' cannot be imported"):
            policies.make(path, "shipped")
    with pytest.raises(ValueError, match=r"neither MODULE:NAME nor one of: learned, learned\+pl"):
        policies.make("best", "shipped")
