"""Traced programs that are kept on disk."""

import dataclasses
import os
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
from csac_jax.sim import host_call
from csac_jax.training import loop, program as programs, split_step, step, trace_cache
from csac_jax.training.step import Program

pytestmark = pytest.mark.mjx

CFG = algorithms.configure(presets.smoke().change(sim={"physics": "c"}), "grasp_only")
T = CFG.train.chunk


@pytest.fixture(autouse=True)
def no_updates(monkeypatch: pytest.MonkeyPatch):
    """Programs that act and remember, which compile sooner."""
    losses = dict.fromkeys(("critic_loss", "actor_loss", "td_error", "q_mean"), jnp.float32(0.0))
    monkeypatch.setattr(
        step, "learn", lambda _, __, state, ring, ___: (state, ring.priority, losses)
    )


class TracedError(Exception):
    """Python was asked for the program."""


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Where programs are kept, still empty."""
    monkeypatch.setattr(trace_cache, "_folder", lambda: tmp_path / "traced")
    return tmp_path / "traced"


@pytest.fixture(scope="module")
def program() -> Program:
    return programs.make(CFG)


def _shapes(program: Program) -> Any:
    return jax.eval_shape(programs.compile_init(program))


def _untraceable() -> Any:
    untraceable = {"side_effect": TracedError}
    return mock.patch.multiple(
        step,
        act_step=mock.create_autospec(step.act_half, **untraceable),
        learn_step=mock.create_autospec(step.learn_half, **untraceable),
    )


def _lower(program: Program, shapes: Any) -> None:
    """Lowers the part that acts."""
    split_step.compile_chunk(program, T, keep=True).part(step.act_half).lower(shapes)


def _numbers(tree: Any) -> list[np.ndarray]:
    is_key = lambda leaf: jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)  # noqa: E731
    leaves = jax.tree.leaves(tree)
    return [np.asarray(jax.random.key_data(leaf) if is_key(leaf) else leaf) for leaf in leaves]


def test_kept_program_is_the_same(folder: Path, program: Program):
    """Claim: a program of another seed, in a process that has not traced it, is lowered without a
    trace, calls the physics of its own world, and computes the same bits as one that is traced."""
    shapes = _shapes(program)
    plain = split_step.compile_chunk(program, T).lower(shapes).compile()
    split_step.compile_chunk(program, T, keep=True).lower(shapes).compile()
    assert len(list(folder.iterdir())) == 2
    other = programs.make(dataclasses.replace(CFG, seed=3))
    with _untraceable(), mock.patch.dict(host_call._functions, clear=True):
        kept = split_step.compile_chunk(other, T, keep=True).lower(shapes).compile()
        begun = programs.init(other)
        wanted = got = None
        for chunk in (plain, kept):
            state = jax.tree.map(lambda leaf: leaf.copy(), begun)
            for _ in range(2):
                state, metrics = chunk(state)
            wanted, got = got, _numbers((state, metrics))
    assert wanted is not None
    jax.tree.map(np.testing.assert_array_equal, wanted, got)
    assert len(list(folder.iterdir())) == 2


def test_damaged_program_is_traced_anew(folder: Path, program: Program):
    """Claim: a file with a flipped bit is not used, and replaced by a sound one."""
    shapes = _shapes(program)
    _lower(program, shapes)
    (path,) = folder.iterdir()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with _untraceable(), pytest.raises(TracedError):
        _lower(program, shapes)
    _lower(program, shapes)
    with _untraceable():
        _lower(program, shapes)


def _name(cfg: Config = CFG, part: str = "act_step", **env: Any) -> str:
    program = programs.make(cfg)
    changed = dataclasses.replace(program, env=dataclasses.replace(program.env, **env))
    leaves, tree = jax.tree.flatten({"step": np.int32(0)})
    return trace_cache.name(changed, part, leaves, tree)


def test_names_tell_programs_apart(monkeypatch: pytest.MonkeyPatch, program: Program):
    """Claim: another setting, part, world, scene, way of JAX or source has another name; another
    seed and preset have not."""
    scenes = program.env.scenes
    moved = scenes.replace(position=scenes.position + np.float32(1e-6))
    given = [
        _name(),
        _name(CFG.change(learn={"tau": 0.5})),
        _name(CFG.change(sim={"gripper": "2f85"})),
        _name(part="learn_step"),
        _name(scenes=moved),
        _name(max_failures=7),
    ]
    with jax.numpy_rank_promotion("warn"):
        given.append(_name())
    monkeypatch.setattr(trace_cache, "_sources", lambda: "of another commit")
    given.append(_name())
    assert len(set(given)) == len(given)
    monkeypatch.undo()
    assert _name(dataclasses.replace(CFG, seed=9, preset="mine")) == given[0]


def test_own_parts_are_not_kept(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Claim: `train` keeps no program with a part of the user's own, and none where JAX keeps no
    programs; else it does."""
    found: list[bool] = []

    def run(cfg: Config, run_dir: Path, init: Any, compile_chunk: Any, *_: Any, **__: Any):
        found.append(isinstance(compile_chunk(T).part(step.act_half), trace_cache._Kept))
        raise FailedError("enough")

    monkeypatch.setattr(loop, "run", run)
    own = samplers.make(CFG.replay, CFG.train.scenes)
    for sampler in (None, own):
        with pytest.raises(FailedError):
            api.train(CFG, tmp_path / "run", sampler=sampler, verbose=False)
    monkeypatch.setattr(trace_cache, "_folder", lambda: None)
    with pytest.raises(FailedError):
        api.train(CFG, tmp_path / "run", verbose=False)
    assert found == [True, False, False]


def test_folder_is_that_of_the_compiled_programs(monkeypatch: pytest.MonkeyPatch):
    """Claim: programs are kept next to the compiled ones, and only on a disk."""
    before = jax.config.jax_compilation_cache_dir
    try:
        for chosen, kept in (("/a/b", Path("/a/b/traced")), ("gs://a/b", None), (None, None)):
            jax.config.update("jax_compilation_cache_dir", chosen)
            assert trace_cache._folder() == kept
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_oldest_program_goes_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Claim: no more than so many are kept; one that was just read stays."""
    monkeypatch.setattr(trace_cache, "MOST", 2)
    for age, name in enumerate("ab"):
        trace_cache._write(tmp_path / name, name.encode())
        os.utime(tmp_path / name, (age, age))
    assert trace_cache._read(tmp_path / "a") == b"a"
    trace_cache._write(tmp_path / "c", b"c")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c"]
