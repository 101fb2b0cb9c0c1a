"""Traced training programs on disk: a run whose program was traced before begins without a trace.

From a warm cache of compiled programs, tracing is more than half of what a start takes. JAX exports
what it traced as StableHLO, next to the compiled programs. A file's name is a digest of all that
decides the trace: settings but for the seed, sources of the package, versions, JAX's own settings,
world and scenes. What has another name is traced. Only programs of one CPU are kept, in C's or
MJX's physics.
"""

import contextlib
import dataclasses
import functools
import hashlib
import os
from pathlib import Path
from typing import Any

import jax
from jax import export

import csac_jax
from csac_jax.env import Env
from csac_jax.runtime import compiler, provenance
from csac_jax.scene import stock
from csac_jax.sim import c_physics, host_call
from csac_jax.training import step
from csac_jax.training.step import Program

MOST = 64  # programs that are kept, of some MB each; those unused for longest go first
_UNTRACED = ("cache", "logging")  # parts of names of JAX's settings that leave a trace as it is
_CHECKSUM = 32  # bytes


def keep(program: Program, part: str, jitted: Any) -> Any:
    """A jitted part of a program's step, by its name, or what has `lower` alone and traces it only
    where no program of that name is kept. Both take a state, and maybe metrics, and give both. The
    program has no parts of your own."""
    folder = _folder()
    if folder is None or not _is_named(program):
        return jitted
    return _Kept(jitted, program, part, folder)


def _folder() -> Path | None:
    """Where programs are kept; None where JAX keeps none on a disk."""
    chosen = jax.config.jax_compilation_cache_dir
    on = jax.config.jax_enable_compilation_cache and chosen and "://" not in chosen
    return Path(chosen) / "traced" if on else None


def _is_named(program: Program) -> bool:
    """Whether a name holds all that the program is made of."""
    one_cpu = jax.default_backend() == "cpu" and jax.device_count() == 1
    if not (one_cpu and program.mesh is None and type(program.env) is Env):
        return False
    if type(program.env.physics) is c_physics.CPhysics:
        return True
    if program.cfg.sim.physics != "mjx":
        return False
    from csac_jax.sim import mjx_physics  # slow to import; the program has done it

    return type(program.env.physics) is mjx_physics.MjxPhysics


@dataclasses.dataclass(frozen=True, eq=False)
class _Kept:
    """What lowers a part of a program's step."""

    jitted: Any
    program: Program
    part: str
    folder: Path

    def lower(self, *given: Any) -> Any:
        """The part lowered for a state, and maybe metrics, such as these."""
        leaves, tree = jax.tree.flatten(given)
        path = self.folder / name(self.program, self.part, leaves, tree)
        kept = _read(path)
        if kept is None:
            kept = self._export(leaves, tree)
            _write(path, kept)
        else:
            _register_calls(self.program, given[0])
        exported = export.deserialize(bytearray(kept))
        result = jax.tree.structure((given[0], _BLANK))

        def part(*given: Any) -> Any:
            return jax.tree.unflatten(result, exported.call(*jax.tree.leaves(given)))

        options = compiler.options(self.program.cfg)
        return jax.jit(part, donate_argnums=0, compiler_options=options).lower(*given)

    def _export(self, leaves: list[Any], tree: Any) -> bytes:
        """The traced part, from leaves to leaves: JAX does not export the classes of trees."""

        def flat(*given: Any) -> list[Any]:
            return jax.tree.leaves(self.jitted.__wrapped__(*jax.tree.unflatten(tree, given)))

        unchecked = [export.DisabledSafetyCheck.custom_call(host_call.TARGET)]
        return bytes(export.export(jax.jit(flat), disabled_checks=unchecked)(*leaves).serialize())


_BLANK = step.StepMetrics(*range(len(step.StepMetrics._fields)))


def _register_calls(program: Program, state: Any) -> None:
    """Makes the functions of the host known that the environment's step calls."""
    env, shape = program.env, jax.ShapeDtypeStruct
    scene = jax.tree.map(lambda leaf: shape(leaf.shape[1:], leaf.dtype), state.scenes)
    action = jax.tree.map(lambda spec: shape(spec.shape, spec.dtype), env.action_spec)
    jax.eval_shape(env.step, scene, action)


def name(program: Program, part: str, leaves: list[Any], tree: Any) -> str:
    """A digest of all that decides the trace of a part, for arguments of these leaves and tree."""
    cfg, env = program.cfg, program.env
    settings = {
        key: value
        for key, value in jax.config.values.items()
        if not any(part in key for part in _UNTRACED)
    }
    told = (
        dataclasses.replace(cfg, seed=0, preset=""),
        part,
        env.physics.world.digest,
        env.gripper,
        (env.any_yaw, env.max_failures),
        stock.library(cfg.scene).sha256 if cfg.scene.has_objects else "",
        sorted(provenance.versions().items()),
        sorted(settings.items()),
        compiler.options(cfg),
        [(leaf.shape, str(leaf.dtype)) for leaf in leaves],
        str(tree),
        _sources(),
    )
    digest = hashlib.sha256(repr(told).encode())
    for array in jax.tree.leaves(env.scenes):
        digest.update(array.tobytes())
    return digest.hexdigest()[:40]


@functools.cache
def _sources() -> str:
    """Digest of the package's code."""
    digest, root = hashlib.sha256(), Path(csac_jax.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def _read(path: Path) -> bytes | None:
    """What is kept there; None if there is nothing, or it is damaged."""
    try:
        content = path.read_bytes()
        os.utime(path)
    except OSError:
        return None
    checksum, kept = content[:_CHECKSUM], content[_CHECKSUM:]
    return kept if hashlib.sha256(kept).digest() == checksum else None


def _write(path: Path, content: bytes) -> None:
    """Keeps it for later runs; a folder that cannot be written is no error."""
    temporary = path.with_suffix(f".{os.getpid()}")
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(hashlib.sha256(content).digest() + content)
        temporary.replace(path)
        newest = sorted(path.parent.iterdir(), key=lambda kept: -kept.stat().st_mtime)
        for old in newest[MOST:]:
            old.unlink()
