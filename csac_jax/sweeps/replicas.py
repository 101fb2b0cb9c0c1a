"""Many runs in one program: S replicas, which differ in seed and hyper-parameters.

`step.train_step` is vmapped here, once. All leaves of a state but `step` have a leading axis S:
replicas share the counter, so that a schedule stays a branch.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from csac_jax.agent import rewards
from csac_jax.agent.csac import CSAC
from csac_jax.config import Config, SmallNet
from csac_jax.io import configs
from csac_jax.nets import chunked_vmap
from csac_jax.runtime import compiler
from csac_jax.training import memory, programs, step
from csac_jax.training.own_parts import NO_PARTS, OwnParts
from csac_jax.training.sharding import AXIS, Shard
from csac_jax.training.step import Program, TrainState
from csac_jax.training.transitions import StepMetrics

_TRACED = {
    "target": "gamma",
    "reward": "success_bonus grasp_levels push_levels lost_block_penalty",
    "explore": "noise_std epsilon_primitive epsilon_place epsilon_decay push_fraction",
    "learn": "learning_rate actor_learning_rate lr_final_fraction tau",
    "replay": "end",
}
TRACED_HYPERPARAMS = tuple(f"{key}.{name}" for key in _TRACED for name in _TRACED[key].split())
"""Settings that enter a program as numbers only: no shape and no branch depends on them."""


def _prefix(replicas: Any, step: Any, scenes: Any) -> Any:
    """Builds a tree with a value for each part of a state."""
    return TrainState(key=replicas, step=step, scenes=scenes, learner=replicas, replay=replicas)


AXES = _prefix(0, None, 0)  # of a state of replicas
_WHOLE, _FIRST, _SECOND = PartitionSpec(), PartitionSpec(AXIS), PartitionSpec(None, AXIS)
_SPECS = {"seeds": _prefix(_FIRST, _WHOLE, _FIRST), "scenes": _prefix(_WHOLE, _WHOLE, _SECOND)}


class Replicas(NamedTuple):
    """Seeds and settings of replicas."""

    seed: Any  # [S] uint32
    hyperparams: programs.Hyperparams | None  # leaves [S, ...]; None if only the seeds differ


class ProgramGroup(NamedTuple):
    """Configs that one program serves; they differ in seed, names and TRACED_HYPERPARAMS."""

    configs: tuple[Config, ...]  # [S]
    hyperparams: tuple[str, ...]  # those in which they differ


def group_configs(cfgs: Sequence[Config]) -> list[ProgramGroup]:
    """Groups configs, in as few groups as possible, in the order of their first ones."""
    groups: dict[Config, list[Config]] = {}
    for cfg in cfgs:
        unnamed = dataclasses.replace(cfg, seed=0, preset="", algo="csac")
        blank = programs.replace_settings(unnamed, dict.fromkeys(_traced(cfg)))
        groups.setdefault(blank, []).append(cfg)
    return [ProgramGroup(tuple(alike), _differing(alike)) for alike in groups.values()]


def _differing(cfgs: Sequence[Config]) -> tuple[str, ...]:
    first, *others = map(_traced, cfgs)
    return tuple(name for name in first if any(other[name] != first[name] for other in others))


def _traced(cfg: Config) -> dict[str, Any]:
    """Returns the TRACED_HYPERPARAMS that this config has: alternatives have their own."""
    settings = configs.flat(configs.to_dict(cfg))
    return {name: settings[name] for name in TRACED_HYPERPARAMS if name in settings}


def group_replicas(group: ProgramGroup) -> Replicas:
    """Returns seeds and settings of a group, as NumPy arrays: every process has a copy."""
    cfgs, names = group
    seed = np.array([cfg.seed for cfg in cfgs], np.uint32)
    if not names:
        return Replicas(seed, None)
    traced = [_traced(cfg) for cfg in cfgs]
    values = {name: np.array([row[name] for row in traced], np.float32) for name in names}
    bounds = [rewards.bounds(cfg.reward, cfg.target.gamma) for cfg in cfgs]
    low, high = np.array(bounds, np.float32).T
    return Replicas(seed, programs.Hyperparams(values, (low, high)))


@dataclasses.dataclass(frozen=True, eq=False)
class SweepProgram:
    """A program of replicas, on one device or laid out over a mesh."""

    program: Program
    replicas: Replicas
    mesh: Mesh | None = None
    shard: Shard = "seeds"  # what the mesh divides
    parts: int = 1  # that the replicas run in, see `Pipelined`; 1 with a mesh
    start: Callable[[Any], Any] | None = None  # changes the learners' first state [S, ...]

    def init(self) -> TrainState:
        """Creates the initial state of all replicas."""
        state = self._jitted_init()(self.replicas)
        if self.start is None:
            return state
        return jax.device_put(state.replace(learner=self.start(state.learner)), self._shardings())

    def abstract(self) -> TrainState:
        """Returns shapes, dtypes and shardings of `init`'s state; nothing is compiled."""
        return self._jitted_init().eval_shape(self.replicas)

    def compile_chunk(self, num_steps: int) -> Any:
        """Returns a jitted state -> (state, StepMetrics [T, S, ...]) of T = `num_steps` steps.

        The state is donated. With a mesh over seeds each device scans its own replicas.
        """
        mesh, replicas, program = self.mesh, self.replicas, self.program
        vmapped = len(replicas.seed) // (self.parts if mesh is None else mesh.size)
        learner = program.learner
        if isinstance(learner, CSAC):
            learner = learner.batched(self._batching(vmapped))
        by_scenes = mesh if self.shard == "scenes" else None
        program = dataclasses.replace(program, learner=learner, mesh=by_scenes)

        def train_one(replica: Replicas, state: TrainState) -> tuple[TrainState, StepMetrics]:
            traced = programs.replace_hyperparams(program, replica.hyperparams)
            return step.train_step(traced, state)

        train_all = jax.vmap(train_one, in_axes=(0, AXES), out_axes=(AXES, 0))

        def chunk(state: TrainState, replicas: Replicas) -> tuple[TrainState, StepMetrics]:
            return jax.lax.scan(lambda state, _: train_all(replicas, state), state, None, num_steps)

        # The CPU's library for convolutions is not measured where they are vmapped or sharded.
        measured = not isinstance(program.cfg.net, SmallNet) or (vmapped == 1 and mesh is None)
        options = compiler.options(program.cfg) if measured else None
        jit = functools.partial(jax.jit, donate_argnums=0, compiler_options=options)
        if self.parts > 1:
            return Pipelined(jit(chunk), replicas, self.parts)
        if mesh is None:
            return jit(lambda state: chunk(state, replicas))
        if self.shard == "seeds":  # each device on its share
            ins, outs = (_SPECS["seeds"], _FIRST), (_SPECS["seeds"], _SECOND)
            chunk = jax.shard_map(chunk, mesh=mesh, in_specs=ins, out_specs=outs, check_vma=False)
        places = (self._shardings(), NamedSharding(mesh, _WHOLE))
        return jit(lambda state: chunk(state, replicas), out_shardings=places)

    def _batching(self, vmapped: int) -> chunked_vmap.Batching:
        """Returns how the networks of so many runs work under `vmap`; in no chunks where scenes are
        sharded or hyper-parameters traced: `vmap_in_chunks` cannot close over them."""
        sharded = self.mesh is not None and self.shard == "scenes"
        chunked = not sharded and self.replicas.hyperparams is None
        at_once = chunked_vmap.chunk_size(self.program.cfg, vmapped) if chunked else None
        return chunked_vmap.Batching(side_by_side=vmapped > 1, networks_at_once=at_once)

    def replica(self, state: TrainState, index: int) -> TrainState:
        """Returns the state of one replica, as `train` has it, on every device."""
        if self.mesh is None:
            return replica(state, index)
        return jax.jit(replica, out_shardings=NamedSharding(self.mesh, _WHOLE))(state, index)

    def _jitted_init(self) -> Any:
        def init_one(replica: Replicas) -> TrainState:
            key = jax.random.key(replica.seed)
            return programs.init_state(self.program, key, replica.hyperparams)

        return jax.jit(jax.vmap(init_one, out_axes=AXES), out_shardings=self._shardings())

    def _shardings(self) -> Any:
        if self.mesh is None:
            return None
        return jax.tree.map(functools.partial(NamedSharding, self.mesh), _SPECS[self.shard])


def sweep_program(
    group: ProgramGroup,
    mesh: Mesh | None = None,
    shard: Shard = "seeds",
    start: Any = None,
    own: OwnParts = NO_PARTS,
) -> SweepProgram:
    """Makes the program of a group, with its environment and parts of one's own."""
    program = programs.make(group.configs[0], **own._asdict())
    parts = num_parts(program.cfg, len(group.configs), mesh)
    return SweepProgram(program, group_replicas(group), mesh, shard, parts, start)


def num_parts(cfg: Config, replicas: int, mesh: Mesh | None = None) -> int:
    """Returns how many parts are best for so many replicas, see `Pipelined`; on a GPU at most two.
    One on several devices, for DenseNet-121, which keeps a device busy, and where the states do not
    fit twice: they are taken apart and joined again."""
    even = cfg.sim.physics == "c" and replicas % 2 == 0
    parts = replicas if jax.default_backend() == "cpu" else 2 if even else 1
    if parts == 1 or mesh is not None or not isinstance(cfg.net, SmallNet):
        return 1
    fits = 2 * replicas * sum(memory.state_bytes(cfg).values()) <= memory.limit()
    return parts if fits else 1


@dataclasses.dataclass(frozen=True, eq=False)
class Pipelined:
    """A chunk of all replicas made of one that serves an equal part of them; the state is donated.
    It is lowered and compiled like a jitted function, and callable once compiled.

    On a GPU with C physics the host moves the scenes of one part while the device is at work for
    another. On a CPU each replica is a part, one after the other: vmapped convolutions become
    grouped ones, which take twice as long.
    """

    program: Any  # jitted, lowered or compiled: (state of a part, its replicas) -> (state, metrics)
    replicas: Replicas
    parts: int

    def lower(self, state: TrainState) -> "Pipelined":
        first = jax.eval_shape(lambda state: _split(state, self.parts)[0], state)
        share, *_ = _in_parts(self.replicas, self.parts)
        return dataclasses.replace(self, program=self.program.lower(first, share))

    def compile(self) -> "Pipelined":
        return dataclasses.replace(self, program=self.program.compile())

    def memory_analysis(self) -> Any:
        return self.program.memory_analysis()

    def __call__(self, state: TrainState) -> tuple[TrainState, StepMetrics]:
        """Runs all parts; returns their joined result."""
        states = jax.block_until_ready(_split(state, self.parts))
        for leaf in jax.tree.leaves(state):
            leaf.delete()

        def run(state: TrainState, share: Replicas) -> Any:
            return jax.block_until_ready(self.program(state, share))

        with ThreadPoolExecutor(1 if jax.default_backend() == "cpu" else self.parts) as threads:
            return _join(list(threads.map(run, states, _in_parts(self.replicas, self.parts))))


def _in_parts(tree: Any, parts: int) -> list[Any]:
    split = jax.tree.map(lambda leaf: leaf.reshape(parts, -1, *leaf.shape[1:]), tree)
    return [jax.tree.map(lambda leaf, k=k: leaf[k], split) for k in range(parts)]


@functools.partial(jax.jit, static_argnums=1)
def _split(state: TrainState, parts: int) -> list[TrainState]:
    split = _in_parts(state.replace(step=()), parts)
    return [jax.tree.map(jnp.copy, part.replace(step=state.step)) for part in split]


@jax.jit
def _join(done: Sequence[tuple[TrainState, StepMetrics]]) -> tuple[TrainState, StepMetrics]:
    """Joins states [S', ...] and metrics [T, S', ...] of parts."""
    states, metrics = zip(*done, strict=True)
    leading = [state.replace(step=()) for state in states]
    joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *leading)
    beside = jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1), *metrics)
    return joined.replace(step=states[0].step), beside


def replica(state: TrainState, index: int) -> TrainState:
    """Returns the state of one replica, as `train` has it."""
    part = jax.tree.map(lambda leaf: leaf[index], state.replace(step=()))
    return part.replace(step=state.step)
