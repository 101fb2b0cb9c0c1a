"""Traced programs that are cached on disk."""

import dataclasses
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import algorithms, api, presets
from csac_jax.config import Config
from csac_jax.errors import FailedError
from csac_jax.replay import samplers
from csac_jax.runtime import host_call
from csac_jax.training import loop, programs, split_step, step, trace_cache
from csac_jax.training.step import Program
from csac_jax.training.transitions import LOSSES
from tests.training.test_step import assert_same, copy

pytestmark = pytest.mark.mjx

CFG = algorithms.configure(presets.smoke().change(sim={"physics": "c"}), "grasp_only")
T = CFG.train.chunk


@pytest.fixture(autouse=True)
def no_updates(monkeypatch: pytest.MonkeyPatch):
    """Programs that act and remember, which compile sooner."""
    losses = dict.fromkeys(LOSSES, jnp.float32(0.0))
    monkeypatch.setattr(
        step, "learn", lambda _, __, state, ring, ___: (state, ring.priority, losses)
    )


class TracedError(Exception):
    """A trace of the program by Python."""


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The empty folder of traced programs."""
    monkeypatch.setattr(trace_cache, "_folder", lambda: tmp_path / "traced")
    return tmp_path / "traced"


@pytest.fixture(scope="module")
def program() -> Program:
    return programs.make(CFG)


@pytest.fixture(scope="module")
def shapes(program: Program) -> Any:
    return jax.eval_shape(programs.compile_init(program))


def _untraceable() -> Any:
    halves = {"act_half": step.act_half, "learn_half": step.learn_half}
    failing = {k: mock.create_autospec(v, side_effect=TracedError) for k, v in halves.items()}
    return mock.patch.multiple(step, **failing)


def test_cached_program_is_the_same(folder: Path, program: Program, shapes: Any):
    """Claim: a program of another seed, in a process that has not traced it, is lowered without a
    trace, calls the physics of its own world, and computes the same bits as one that is traced."""
    plain = split_step.compile_chunk(program, T).lower(shapes).compile()
    split_step.compile_chunk(program, T, cached=True).lower(shapes).compile()
    other = programs.make(dataclasses.replace(CFG, seed=3))
    with _untraceable(), mock.patch.dict(host_call._functions, clear=True):
        cached = split_step.compile_chunk(other, T, cached=True).lower(shapes).compile()
        results, begun = [], programs.init(other)
        for chunk in (plain, cached):
            state, metrics = chunk(copy(begun))
            results.append((metrics, *chunk(state)))
    assert_same(*results)
    assert len(list(folder.iterdir())) == 2


def test_damaged_program_is_traced_again(folder: Path, program: Program, shapes: Any):
    """Claim: a file with a flipped bit is not used, and replaced by a sound one."""

    def lower() -> None:
        trace_cache.jit(program, step.act_half, cached=True).lower(shapes)

    lower()
    (path,) = folder.iterdir()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with _untraceable(), pytest.raises(TracedError):
        lower()
    lower()
    with _untraceable():
        lower()


def _name(cfg: Config = CFG, half: str = "act_half", **env: Any) -> str:
    program = programs.make(cfg)
    changed = dataclasses.replace(program, env=dataclasses.replace(program.env, **env))
    leaves, tree = jax.tree.flatten({"step": np.int32(0)})
    return trace_cache.name(changed, half, leaves, tree)


def test_names_tell_programs_apart(monkeypatch: pytest.MonkeyPatch, program: Program):
    """Claim: another setting, half, world, scene, option of JAX or source has another name; another
    seed and preset have not."""
    scenes = program.env.scenes
    moved = scenes.replace(position=scenes.position + np.float32(1e-6))
    names = [
        _name(),
        _name(CFG.change(learn={"tau": 0.5})),
        _name(CFG.change(sim={"gripper": "2f85"})),
        _name(half="learn_half"),
        _name(scenes=moved),
        _name(max_failures=7),
    ]
    with jax.numpy_rank_promotion("warn"):
        names.append(_name())
    monkeypatch.setattr(trace_cache, "_sources", lambda: "of another commit")
    names.append(_name())
    assert len(set(names)) == len(names)
    monkeypatch.undo()
    assert _name(dataclasses.replace(CFG, seed=9, preset="mine")) == names[0]


def test_own_parts_are_not_cached(program: Program, monkeypatch: pytest.MonkeyPatch):
    """Claim: `train` caches no program with a part of the user's own, and none where JAX caches
    none on a disk; else it does."""
    asked: list[bool] = []

    def run(cfg: Config, run_dir: Path, init: Any, compile_chunk: Any, *_: Any, **__: Any):
        asked.append(compile_chunk(T).cached)
        raise FailedError("enough")

    monkeypatch.setattr(loop, "run", run)
    for sampler in (None, samplers.make(CFG.replay, CFG.train.scenes)):
        with pytest.raises(FailedError):
            api.train(CFG, "unused", sampler=sampler, verbose=False)
    assert asked == [True, False]
    monkeypatch.undo()
    before = jax.config.jax_compilation_cache_dir
    try:
        for chosen, cached in (("/a/b", True), ("gs://a/b", False), (None, False)):
            jax.config.update("jax_compilation_cache_dir", chosen)
            assert hasattr(trace_cache.jit(program, step.act_half, True), "folder") == cached
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
