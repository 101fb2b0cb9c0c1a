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
from csac_jax.training import loop, step, traced
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
    monkeypatch.setattr(traced, "_folder", lambda: tmp_path / "traced")
    return tmp_path / "traced"


@pytest.fixture(scope="module")
def program() -> Program:
    return step.make(CFG)


def _shapes(program: Program) -> Any:
    return jax.eval_shape(step.compile_init(program))


def _untraceable() -> Any:
    return mock.patch.object(step, "train_step", side_effect=TracedError)


def _numbers(tree: Any) -> list[np.ndarray]:
    is_key = lambda leaf: jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)  # noqa: E731
    leaves = jax.tree.leaves(tree)
    return [np.asarray(jax.random.key_data(leaf) if is_key(leaf) else leaf) for leaf in leaves]


def test_kept_program_is_the_same(folder: Path, program: Program):
    """Claim: a program of another seed, in a process that has not traced it, is lowered without a
    trace, calls the physics of its own world, and computes the same bits as one that is traced."""
    shapes = _shapes(program)
    plain = step.compile_chunk(program, T).lower(shapes).compile()
    traced.compile_chunk(program, T).lower(shapes)
    assert len(list(folder.iterdir())) == 1
    other = step.make(dataclasses.replace(CFG, seed=3))
    with _untraceable(), mock.patch.dict(host_call._functions, clear=True):
        kept = traced.compile_chunk(other, T).lower(shapes).compile()
        begun = step.init(other)
        wanted = got = None
        for chunk in (plain, kept):
            state = jax.tree.map(lambda leaf: leaf.copy(), begun)
            for _ in range(2):
                state, metrics = chunk(state)
            wanted, got = got, _numbers((state, metrics))
    assert wanted is not None
    jax.tree.map(np.testing.assert_array_equal, wanted, got)
    assert len(list(folder.iterdir())) == 1


def test_damaged_program_is_traced_anew(folder: Path, program: Program):
    """Claim: a file with a flipped bit is not used, and replaced by a sound one."""
    shapes, chunk = _shapes(program), traced.compile_chunk(program, T)
    chunk.lower(shapes)
    (path,) = folder.iterdir()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with _untraceable(), pytest.raises(TracedError):
        chunk.lower(shapes)
    chunk.lower(shapes)
    with _untraceable():
        chunk.lower(shapes)


def _name(cfg: Config = CFG, num_steps: int = T, **env: Any) -> str:
    program = step.make(cfg)
    changed = dataclasses.replace(program, env=dataclasses.replace(program.env, **env))
    leaves, tree = jax.tree.flatten({"step": np.int32(0)})
    return traced.name(changed, num_steps, leaves, tree)


def test_names_tell_programs_apart(monkeypatch: pytest.MonkeyPatch, program: Program):
    """Claim: another setting, length, world, scene, way of JAX or source has another name; another
    seed and preset have not."""
    scenes = program.env.scenes
    moved = scenes.replace(position=scenes.position + np.float32(1e-6))
    given = [
        _name(),
        _name(CFG.change(learn={"tau": 0.5})),
        _name(CFG.change(sim={"gripper": "2f85"})),
        _name(num_steps=T + 1),
        _name(scenes=moved),
        _name(max_failures=7),
    ]
    with jax.numpy_rank_promotion("warn"):
        given.append(_name())
    monkeypatch.setattr(traced, "_sources", lambda: "of another commit")
    given.append(_name())
    assert len(set(given)) == len(given)
    monkeypatch.undo()
    assert _name(dataclasses.replace(CFG, seed=9, preset="mine")) == given[0]


def test_own_parts_are_not_kept(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Claim: `train` keeps no program with a part of the user's own, and none where JAX keeps no
    programs; else it does."""
    found: list[Any] = []

    def run(cfg: Config, run_dir: Path, init: Any, compile_chunk: Any, *_: Any, **__: Any):
        found.append(compile_chunk(T))
        raise FailedError("enough")

    monkeypatch.setattr(loop, "run", run)
    own = samplers.make(CFG.replay, CFG.train.scenes)
    for sampler in (None, own):
        with pytest.raises(FailedError):
            api.train(CFG, tmp_path / "run", sampler=sampler, verbose=False)
    monkeypatch.setattr(traced, "_folder", lambda: None)
    with pytest.raises(FailedError):
        api.train(CFG, tmp_path / "run", verbose=False)
    assert [isinstance(one, traced._Chunk) for one in found] == [True, False, False]


def test_folder_is_that_of_the_compiled_programs(monkeypatch: pytest.MonkeyPatch):
    """Claim: programs are kept next to the compiled ones, and only on a disk."""
    before = jax.config.jax_compilation_cache_dir
    try:
        for chosen, kept in (("/a/b", Path("/a/b/traced")), ("gs://a/b", None), (None, None)):
            jax.config.update("jax_compilation_cache_dir", chosen)
            assert traced._folder() == kept
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_oldest_program_goes_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Claim: no more than so many are kept; one that was just read stays."""
    monkeypatch.setattr(traced, "MOST", 2)
    for age, name in enumerate("ab"):
        traced._write(tmp_path / name, name.encode())
        os.utime(tmp_path / name, (age, age))
    assert traced._read(tmp_path / "a") == b"a"
    traced._write(tmp_path / "c", b"c")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c"]
