"""Many runs in one program: replicas, which differ in seed and hyper-parameters.

S = replicas. `step.train_step` is written for one run and vmapped here, once. All leaves of a state
have a leading axis S but `step`: replicas share the counter, so that a schedule by it stays a
branch.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from csac_jax.agent import rewards
from csac_jax.config import Config
from csac_jax.nets import chunked_vmap
from csac_jax.runtime import compiler
from csac_jax.sweeps import pipelined
from csac_jax.training import step
from csac_jax.training.sharding import AXIS, DataSharding, Shard
from csac_jax.training.step import Hyperparams, Program, StepMetrics, TrainState

_TRACED = {
    "target": "gamma",
    "reward": "success_bonus distance_weight eta grasp_levels push_levels lost_block_penalty",
    "explore": "noise_std epsilon_primitive epsilon_place decay push_fraction",
    "learn": "learning_rate actor_learning_rate lr_final_fraction tau",
    "replay": "start middle end",
}
TRACED_HYPERPARAMS = tuple(
    f"{section}.{name}" for section, names in _TRACED.items() for name in names.split()
)
"""Settings that enter a program as numbers only: no shape and no branch depends on them."""


def _prefix(replicas: Any, step: Any, scenes: Any) -> Any:
    """A value for each part of a state: its `step`, its scenes and all the rest."""
    return TrainState(key=replicas, step=step, scenes=scenes, learner=replicas, replay=replicas)


AXES = _prefix(0, None, 0)  # of a state of replicas


class Replicas(NamedTuple):
    """What tells replicas apart."""

    seed: Any  # [S] uint32
    hyperparams: Hyperparams | None  # leaves [S, ...] float32; None if only the seeds differ


class SweepProgram(NamedTuple):
    """What the host needs of a group's program."""

    init: Callable[[], Any]  # the first state, leaves [S, ...] but `step`
    abstract: Callable[[], Any]  # its shapes, types and places
    chunk: Callable[[int], Any]  # steps -> jitted, state -> (state, StepMetrics [T, S, ...])
    replica: Callable[[Any, int], Any]  # the state of one replica, as `train` has it


class ProgramGroup(NamedTuple):
    """Configs that one program serves; they differ in seed, names and TRACED_HYPERPARAMS."""

    configs: tuple[Config, ...]  # [S]
    hyperparams: tuple[str, ...]  # those in which they differ


def group_configs(configs: Sequence[Config]) -> list[ProgramGroup]:
    """The configs in as few groups as can be, in the order of their first ones."""
    groups: dict[Config, list[Config]] = {}
    for cfg in configs:
        unnamed = dataclasses.replace(cfg, seed=0, preset="", algo="csac")
        blank = step.replace_settings(unnamed, dict.fromkeys(_traced(cfg)))
        groups.setdefault(blank, []).append(cfg)
    return [ProgramGroup(tuple(alike), _differing(alike)) for alike in groups.values()]


def _differing(configs: Sequence[Config]) -> tuple[str, ...]:
    return tuple(name for name in _traced(configs[0]) if len(set(_values(configs, name))) > 1)


def _traced(cfg: Config) -> list[str]:
    """The TRACED_HYPERPARAMS that this config has: alternatives have settings of their own."""
    return [name for name in TRACED_HYPERPARAMS if _has(cfg, name)]


def _has(cfg: Config, name: str) -> bool:
    section, field = name.split(".")
    return field in {one.name for one in dataclasses.fields(getattr(cfg, section))}


def _values(configs: Sequence[Config], name: str) -> list[Any]:
    """The configs' values of a setting, by its dotted name."""
    section, field = name.split(".")
    return [getattr(getattr(cfg, section), field) for cfg in configs]


def of_group(group: ProgramGroup) -> Replicas:
    """What tells the runs of a group apart, as arrays of NumPy: every process has its own copy.

    Bounds of returns are computed here, from plain numbers.
    """
    seed = np.array([cfg.seed for cfg in group.configs], np.uint32)
    if not group.hyperparams:
        return Replicas(seed, None)
    values = {
        name: np.array(_values(group.configs, name), np.float32) for name in group.hyperparams
    }
    bounds = [rewards.bounds(cfg.reward, cfg.target.gamma) for cfg in group.configs]
    low, high = np.array(bounds, np.float32).T
    return Replicas(seed, Hyperparams(values, (low, high)))


def init(
    program: Program, replicas: Replicas, mesh: Mesh | None = None, shard: Shard = "seeds"
) -> TrainState:
    """The state of all replicas before the first step, laid out over the mesh if there is one."""

    def init_one(replica: Replicas) -> TrainState:
        return step.init_state(program, jax.random.key(replica.seed), replica.hyperparams)

    build = jax.vmap(init_one, out_axes=AXES)
    return jax.jit(build, out_shardings=shardings(mesh, shard))(replicas)


def shardings(mesh: Mesh | None, shard: Shard) -> Any:
    """Where the leaves of a state of replicas lie, as a prefix of it; None without a mesh."""
    if mesh is None:
        return None
    every, seeds = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(AXIS))
    if shard == "seeds":
        return _prefix(seeds, every, seeds)
    return _prefix(every, every, NamedSharding(mesh, PartitionSpec(None, AXIS)))


def compile_chunk(
    program: Program,
    replicas: Replicas,
    num_steps: int,
    mesh: Mesh | None = None,
    shard: Shard = "seeds",
    parts: int = 1,
) -> Any:
    """A jitted function state -> (state, StepMetrics [T, S, ...]) of `num_steps` training steps.

    The state is donated. With a mesh over seeds each device scans its own replicas; metrics end up
    on every device. Without a mesh the replicas may run in several `parts`, see `pipelined`.
    Networks work in chunks unless hyper-parameters are traced, which `chunked_vmap` cannot close
    over, or scenes are sharded.
    """
    vmapped = len(replicas.seed) // (parts if mesh is None else mesh.size)  # in one program
    if mesh is not None and shard == "scenes":
        program = dataclasses.replace(program, sharding=DataSharding(mesh))
    elif replicas.hyperparams is None:
        at_once = chunked_vmap.chunk_size(program.cfg, vmapped)
        program = dataclasses.replace(program, learner=program.learner.in_chunks(at_once))

    def chunk(state: TrainState, replicas: Replicas) -> tuple[TrainState, StepMetrics]:
        def train_one(replica: Replicas, state: TrainState) -> tuple[TrainState, StepMetrics]:
            return step.train_step(program, state, replica.hyperparams)

        train_all = jax.vmap(train_one, in_axes=(0, AXES), out_axes=(AXES, 0))
        return jax.lax.scan(lambda carry, _: train_all(replicas, carry), state, length=num_steps)

    # The CPU's library for convolutions is not measured where they are vmapped or sharded.
    measured = program.cfg.net.kind != "small" or (vmapped == 1 and mesh is None)
    options = compiler.options(program.cfg) if measured else None
    if mesh is None and parts > 1:
        return _in_parts(
            jax.jit(chunk, donate_argnums=0, compiler_options=options), replicas, parts
        )
    out = None
    if mesh is not None:
        out = (shardings(mesh, shard), NamedSharding(mesh, PartitionSpec()))
        chunk = _each_device(mesh, chunk) if shard == "seeds" else chunk
    return jax.jit(
        lambda state: chunk(state, replicas),
        donate_argnums=0,
        out_shardings=out,
        compiler_options=options,
    )


def _each_device(mesh: Mesh, chunk: Any) -> Any:
    """The chunk on each device's share of the replicas."""
    share, every, metrics = PartitionSpec(AXIS), PartitionSpec(), PartitionSpec(None, AXIS)
    state = _prefix(share, every, share)
    return jax.shard_map(
        chunk, mesh=mesh, in_specs=(state, share), out_specs=(state, metrics), check_vma=False
    )


def _in_parts(chunk: Any, replicas: Replicas, parts: int) -> pipelined.Pipelined:
    """The jitted chunk for all replicas, an equal part of them at a time."""
    size = len(replicas.seed) // parts
    slices = [slice(k * size, (k + 1) * size) for k in range(parts)]

    def split(state: TrainState) -> list[TrainState]:
        return [jax.tree.map(jnp.copy, replica(state, part)) for part in slices]

    shares = [jax.tree.map(lambda leaf, part=part: leaf[part], replicas) for part in slices]
    return pipelined.Pipelined(chunk, shares, jax.jit(split), jax.jit(_join))


def _join(done: Sequence[tuple[TrainState, StepMetrics]]) -> tuple[TrainState, StepMetrics]:
    """States [S', ...] and metrics [T, S', ...] of the parts as those of all replicas."""
    states, metrics = zip(*done, strict=True)
    leading = [state.replace(step=()) for state in states]
    joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *leading)
    all_metrics = jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1), *metrics)
    return joined.replace(step=states[0].step), all_metrics


def replica(state: TrainState, index: int | slice) -> TrainState:
    """The state of one replica, as `train` has it, or of several."""
    own = jax.tree.map(lambda leaf: leaf[index], state.replace(step=()))
    return own.replace(step=state.step)


def abstract(
    program: Program, replicas: Replicas, mesh: Mesh | None = None, shard: Shard = "seeds"
) -> TrainState:
    """Shapes, types and places of `init`'s state; nothing is compiled."""
    shapes = jax.eval_shape(lambda: init(program, replicas))
    if mesh is None:
        return shapes

    def place(sharding: NamedSharding, tree: Any) -> Any:
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), tree
        )

    return jax.tree.map(place, shardings(mesh, shard), shapes)


def sweep_program(
    group: ProgramGroup,
    mesh: Mesh | None = None,
    shard: Shard = "seeds",
    start: Callable[[Any], Any] | None = None,
) -> SweepProgram:
    """The program of a group; its environment is made here.

    Args: start, changes the learners' first state [S, ...], as networks that they start from.
    """
    program, replicas = step.make(group.configs[0]), of_group(group)
    parts = pipelined.num_parts(program.cfg, len(group.configs), mesh)

    def first_state() -> TrainState:
        state = init(program, replicas, mesh, shard)
        if start is None:
            return state
        state = state.replace(learner=start(state.learner))
        return state if mesh is None else jax.device_put(state, shardings(mesh, shard))

    return SweepProgram(
        init=first_state,
        abstract=lambda: abstract(program, replicas, mesh, shard),
        chunk=lambda num_steps: compile_chunk(program, replicas, num_steps, mesh, shard, parts),
        replica=replica
        if mesh is None
        else jax.jit(replica, out_shardings=NamedSharding(mesh, PartitionSpec())),
    )
