"""Replicas in one program, with a small step in place of the learner's."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

from csac_jax import algorithms, presets
from csac_jax.sweeps import replicas
from csac_jax.sweeps.replicas import SweepProgram
from csac_jax.training import programs, step
from tests.training import toys

pytestmark = pytest.mark.optax

OTHER = {
    "target.gamma": 0.4,
    "reward.success_bonus": 0.5,
    "reward.grasp_levels": (-2.0, -0.9, -0.3, 0.2, 3.0),
    "reward.push_levels": (-0.4, 0.6),
    "reward.lost_block_penalty": 0.7,
    "explore.noise_std": 0.2,
    "explore.epsilon_primitive": (0.9, 0.2),
    "explore.epsilon_place": (0.8, 0.1),
    "explore.epsilon_decay": 0.99,
    "explore.push_fraction": 0.6,
    "learn.learning_rate": 3e-3,
    "learn.actor_learning_rate": 2e-3,
    "learn.lr_final_fraction": 0.5,
    "learn.tau": 0.3,
    "replay.end": (4.0, 2.0),
}
"""Another value of every traced hyper-parameter."""


@pytest.fixture(autouse=True)
def toy_step(monkeypatch: pytest.MonkeyPatch):
    """Replaces the real step by the small one."""
    monkeypatch.setattr(programs, "init_state", toys.init_state)
    monkeypatch.setattr(step, "train_step", toys.train_step)


def _seeds(num: int, cfg=toys.CFG) -> replicas.ProgramGroup:
    (group,) = replicas.group_configs([dataclasses.replace(cfg, seed=k) for k in range(num)])
    return group


def _program(group: replicas.ProgramGroup, parts: int = 1) -> SweepProgram:
    return SweepProgram(toys.program(group.configs[0]), replicas.group_replicas(group), parts=parts)


def _chunks(chunk: Any, state: Any, chunks: int) -> tuple[Any, list[Any]]:
    """Returns the state after some chunks, and their metrics."""
    seen = []
    for _ in range(chunks):
        state, metrics = chunk(state)
        seen.append(jax.device_get(metrics))
    return state, seen


def _run(group: replicas.ProgramGroup, chunks: int = 2) -> tuple[Any, list[Any]]:
    program = _program(group)
    return _chunks(program.compile_chunk(4), program.init(), chunks)


def _alone(cfg, chunks: int = 2) -> tuple[Any, list[Any]]:
    """Runs as `train` does: settings are constants, the state has no axis of replicas."""
    program = toys.program(cfg)
    return _chunks(programs.compile_chunk(program, 4), programs.init(program), chunks)


def assert_close(a: Any, b: Any, rtol: float, atol: float = 1e-6) -> None:
    for (path, one), other in zip(
        jax.tree_util.tree_leaves_with_path(a), jax.tree.leaves(b), strict=True
    ):
        if jax.dtypes.issubdtype(one.dtype, jax.dtypes.prng_key):
            one, other = jax.random.key_data(one), jax.random.key_data(other)
        np.testing.assert_allclose(one, other, rtol, atol, err_msg=jax.tree_util.keystr(path))


def test_replicas_are_the_runs_of_train():
    """Claim: each replica is the run that `train` makes of its seed and settings, to rounding, also
    where hyper-parameters are traced, every one of them."""
    assert OTHER.keys() == set(replicas.TRACED_HYPERPARAMS)
    configs = (toys.CFG, programs.replace_settings(toys.CFG, OTHER).change(seed=1))
    (group,) = replicas.group_configs(configs)
    assert group == (configs, replicas.TRACED_HYPERPARAMS)
    state, seen = _run(group)
    for k, cfg in enumerate(configs):
        alone, metrics = _alone(cfg)
        assert_close(replicas.replica(state, k), alone, 1e-4)
        for one, other in zip(seen, metrics, strict=True):
            assert_close(jax.tree.map(lambda leaf, k=k: leaf[:, k], one), other, 1e-4)


def test_seeds_differ_and_share_the_counter():
    """Claim: replicas of two seeds differ in every scene and network; they share the step counter,
    so that a schedule by it stays a branch, a `cond`; a chunk gives their state back in its own
    memory."""
    program = _program(_seeds(2))
    state = program.init()
    assert state.scenes.shape == (2, toys.SCENES)
    traced = program.compile_chunk(4).trace(state)
    assert "cond[" in str(traced.jaxpr)
    chunk = traced.lower().compile()
    replay = sum(leaf.nbytes for leaf in jax.tree.leaves(state.replay))
    assert chunk.memory_analysis().alias_size_in_bytes >= replay
    after, _ = chunk(state)
    assert (after.step.shape, int(after.step)) == ((), 4)
    for leaf in (after.scenes, after.learner["online"]):
        assert len(np.unique(np.asarray(leaf))) == leaf.size


@pytest.mark.parametrize("differ", [False, True])
def test_parts_are_the_same_runs(differ: bool):
    """Claim: in parts replicas are what they are side by side, in the same order, also where
    hyper-parameters differ; chunks follow one another, the state is used up."""
    configs = [dataclasses.replace(toys.CFG, seed=k) for k in range(6)]
    if differ:
        configs[3:] = [programs.replace_settings(cfg, {"target.gamma": 0.1}) for cfg in configs[3:]]
    (group,) = replicas.group_configs(configs)
    wanted, seen = _run(group)
    program = _program(group, parts=3)
    begun = state = program.init()
    chunk = program.compile_chunk(4).lower(state).compile()
    for one in seen:
        state, metrics = chunk(state)
        assert_close(metrics, one, 1e-5)
    assert_close(state, wanted, 1e-5)
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(begun))


def test_settings_that_are_numbers_share_a_program():
    """Claim: numbers, names and seeds do not separate groups; a sampler, a size or a branch does.
    Order is kept."""
    smoke = presets.smoke()
    uniform = algorithms.configure(smoke, "csac")
    configs = [smoke, uniform, smoke.change(learn={"tau": 0.5}), uniform.change(seed=3)]
    first, second = replicas.group_configs(configs)
    assert first == ((configs[0], configs[2]), ("learn.tau",))
    assert second == ((configs[1], configs[3]), ())
    vpg, reactive = (algorithms.configure(smoke, name) for name in ("vpg", "reactive"))
    assert replicas.group_configs([vpg, reactive])[0].hyperparams == ("target.gamma",)


def test_bounds_are_those_of_the_settings():
    """Claim: traced bounds of returns are those that each setting has by itself. Where only seeds
    differ, nothing is traced."""
    seeds = replicas.group_replicas(_seeds(2))
    assert (seeds.hyperparams, seeds.seed.tolist()) == (None, [0, 1])
    other = toys.CFG.change(target={"gamma": 0.25})
    (group,) = replicas.group_configs([toys.CFG, other])
    each = replicas.group_replicas(group)
    wanted = np.array([toys.program(cfg).learner.parts.bounds for cfg in (toys.CFG, other)])
    np.testing.assert_allclose(np.stack(each.hyperparams.return_bounds, axis=1), wanted, 1e-6)
