"""Traced training programs on disk, so that a later run of the same program begins without a trace.

With a warm cache of compiled programs, tracing is more than half of a start. JAX exports what it
traced as StableHLO. A file's name is a digest of all that decides the trace, see `name`. Only
programs of one CPU are cached, in C's or MJX's physics.
"""

import contextlib
import dataclasses
import functools
import hashlib
import os
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from jax import export

import csac_jax
from csac_jax.runtime import compiler, host_call, provenance
from csac_jax.training.step import Program
from csac_jax.training.transitions import StepMetrics
from csac_jax.world import object_slots

MOST = 64  # files, of some MB each; those unused for longest are deleted
_UNTRACED = re.compile("cache|logging")  # in names of JAX's settings that change no trace


def jit(program: Program, half: Callable[..., Any], cached: bool) -> Any:
    """Returns a jitted half of `step.train_step`, or what has `lower` alone if it can be `cached`.
    The state is donated. A cached program has no custom parts."""
    bound = functools.partial(half, program)
    one_cpu = jax.default_backend() == "cpu" and jax.device_count() == 1
    if cached and one_cpu and program.cfg.sim.physics in ("c", "mjx") and (folder := _folder()):
        return _Cached(program, half.__name__, bound, folder)
    return jax.jit(bound, donate_argnums=0, compiler_options=compiler.options(program.cfg))


def _folder() -> Path | None:
    """Returns the folder of traced programs; None where JAX caches none on a disk."""
    chosen = jax.config.jax_compilation_cache_dir
    on = jax.config.jax_enable_compilation_cache and chosen and "://" not in chosen
    return Path(chosen) / "traced" if on else None


@dataclasses.dataclass(frozen=True, eq=False)
class _Cached:
    """A half of a program's step that is traced only if its file is missing."""

    program: Program
    half: str
    function: Callable[..., Any]
    folder: Path

    def lower(self, *inputs: Any) -> Any:
        leaves, tree = jax.tree.flatten(inputs)
        path = self.folder / name(self.program, self.half, leaves, tree)
        traced = _read(path)
        if traced is None:
            traced = self._export(leaves, tree)
            _write(path, traced)
        else:
            _register_calls(self.program, inputs[0])
        exported = export.deserialize(bytearray(traced))
        metrics = StepMetrics(*range(len(StepMetrics._fields)))  # for its structure
        result = jax.tree.structure((inputs[0], metrics))

        def call(*inputs: Any) -> Any:
            return jax.tree.unflatten(result, exported.call(*jax.tree.leaves(inputs)))

        options = compiler.options(self.program.cfg)
        return jax.jit(call, donate_argnums=0, compiler_options=options).lower(*inputs)

    def _export(self, leaves: list[Any], tree: Any) -> bytes:
        """Traces from leaves to leaves: JAX does not export the classes of trees."""

        def flat(*leaves: Any) -> list[Any]:
            return jax.tree.leaves(self.function(*jax.tree.unflatten(tree, leaves)))

        unchecked = [export.DisabledSafetyCheck.custom_call(host_call.TARGET)]
        return bytes(export.export(jax.jit(flat), disabled_checks=unchecked)(*leaves).serialize())


def _register_calls(program: Program, state: Any) -> None:
    """Registers the functions of the host that the environment's step calls."""
    env, shape = program.env, jax.ShapeDtypeStruct
    scene = jax.tree.map(lambda leaf: shape(leaf.shape[1:], leaf.dtype), state.scenes)
    action = jax.tree.map(lambda spec: shape(spec.shape, spec.dtype), env.action_spec)
    jax.eval_shape(env.step, scene, action)


def name(program: Program, half: str, leaves: list[Any], tree: Any) -> str:
    """Returns a digest of all that decides the trace, for arguments of these leaves and tree."""
    cfg, env = program.cfg, program.env
    parts = (
        (dataclasses.replace(cfg, seed=0, preset=""), half, env.physics.world.digest),
        (env.gripper, env.any_yaw, env.max_failures),
        object_slots.library(cfg.scene).sha256 if cfg.scene.has_objects else "",
        sorted(provenance.versions().items()),
        sorted(item for item in jax.config.values.items() if not _UNTRACED.search(item[0])),
        [(leaf.shape, str(leaf.dtype)) for leaf in leaves],
        (compiler.options(cfg), str(tree), _sources()),
    )
    digest = hashlib.sha256(repr(parts).encode())
    for array in jax.tree.leaves(env.scenes):
        digest.update(array.tobytes())
    return digest.hexdigest()[:40]


@functools.cache
def _sources() -> str:
    digest, root = hashlib.sha256(), Path(csac_jax.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def _read(path: Path) -> bytes | None:
    """Reads a file; None if it is missing or damaged."""
    with contextlib.suppress(OSError, zlib.error):
        traced = zlib.decompress(path.read_bytes())  # it has a checksum
        os.utime(path)
        return traced
    return None


def _write(path: Path, traced: bytes) -> None:
    """Writes a file for later runs; a folder that cannot be written is no error."""
    temporary = path.with_suffix(f".{os.getpid()}")
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(zlib.compress(traced, 1))
        temporary.replace(path)
        for old in sorted(path.parent.iterdir(), key=lambda file: -file.stat().st_mtime)[MOST:]:
            old.unlink()
