"""Many runs in one program: members that differ in their seed and in settings that are nothing but
numbers.

S = members. `step.train_step` is written for one of them and is vmapped here, once, over all or
over those of a lane. Of a member's state all leaves have a leading axis S but `step`, which all
members share: what depends on it stays one schedule for all.
"""

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from csac_jax.agent import actor_critic, rewards
from csac_jax.config import Config
from csac_jax.runtime import compiler
from csac_jax.sweeps import pipelined
from csac_jax.training import chunked_vmap, step
from csac_jax.training.sharding import AXIS, Shard, Spread
from csac_jax.training.step import Program, StepMetrics, TrainState

Array = np.ndarray | jax.Array

NUMBERS = (
    *("cem.std", "cem.std_min", "target.gamma", "target.inverse_temperature"),
    *(
        "reward.success_bonus",
        "reward.distance_weight",
        "reward.distance_cap",
        "reward.eta0",
        "reward.eta1",
        "reward.push_level",
    ),
    *(
        "reward.grasp_level",
        "reward.nothing",
        "reward.empty",
        "reward.touched",
        "reward.dropped",
        "reward.lifted",
    ),
    *("reward.push_better", "reward.push_worse", "reward.dead_band", "reward.lost_block_penalty"),
    *(
        "explore.noise_std",
        "explore.noise_clip",
        "explore.epsilon_primitive_start",
        "explore.epsilon_primitive_end",
    ),
    *(
        "explore.epsilon_place_start",
        "explore.epsilon_place_end",
        "explore.decay",
        "explore.push_fraction",
    ),
    *(
        "learn.learning_rate",
        "learn.actor_learning_rate",
        "learn.lr_final_fraction",
        "learn.tau",
        "learn.gradient_clip",
    ),
    *(
        "learn.huber",
        "replay.alpha",
        "replay.per_epsilon",
        "replay.is_beta_start",
        "replay.is_beta_end",
    ),
    *("replay.beta_start", "replay.beta_middle", "replay.beta_middle_at", "replay.beta_end"),
)
"""Settings that enter the program as numbers only: no shape and no branch depends on them."""


def _prefix(members: Any, step: Any, scenes: Any) -> Any:
    """A value for each part of a state: its `step`, its scenes and all the rest."""
    return TrainState(key=members, step=step, scenes=scenes, learner=members, replay=members)


AXES = _prefix(0, None, 0)  # of a state of members


class Members(NamedTuple):
    """What tells members apart."""

    seed: Array  # [S] uint32
    numbers: dict[str, Array]  # those of NUMBERS that differ, [S, ...] float32
    bounds: (
        tuple[Array, Array] | None
    )  # smallest and largest possible return, [S]; None if no number differs


class Engine(NamedTuple):
    """What the host needs of a group's program."""

    init: Callable[[], Any]  # the first state, leaves [S, ...] but `step`
    abstract: Callable[[], Any]  # its shapes, types and places
    chunk: Callable[
        [int], Any
    ]  # number of steps -> jitted function state -> (state, StepMetrics [T, S, ...])
    member: Callable[[Any, int], Any]  # the state of one member, as `train` has it


class Group(NamedTuple):
    """Configs that one program serves; they differ in seed, names and NUMBERS."""

    configs: tuple[Config, ...]  # [S]
    numbers: tuple[str, ...]  # those in which they differ


def group(configs: Sequence[Config]) -> list[Group]:
    """The configs in as few groups as can be, in the order of their first members."""
    found: dict[Config, list[Config]] = {}
    for cfg in configs:
        blank = dict.fromkeys(NUMBERS)
        shape = dataclasses.replace(cfg, seed=0, preset="", algo="csac")
        found.setdefault(with_numbers(shape, blank), []).append(cfg)
    return [Group(tuple(members), _differing(members)) for members in found.values()]


def _differing(configs: Sequence[Config]) -> tuple[str, ...]:
    return tuple(name for name in NUMBERS if len({number(cfg, name) for cfg in configs}) > 1)


def number(cfg: Config, name: str) -> Any:
    """The value of a setting by its dotted name, such as `learn.tau`."""
    section, field = name.split(".")
    return getattr(getattr(cfg, section), field)


def with_numbers(cfg: Config, values: dict[str, Any]) -> Config:
    """The config with other values of settings, which may be traced and are not checked."""
    cfg = copy.copy(cfg)
    for name, value in values.items():
        section, field = name.split(".")
        changed = copy.copy(getattr(cfg, section))
        object.__setattr__(changed, field, value)
        object.__setattr__(cfg, section, changed)
    return cfg


def members(given: Group) -> Members:
    """What tells the members of a group apart. Arrays of NumPy: every process of a cluster brings
    its own along.

    Bounds of returns are found here, from plain numbers.
    """
    seed = np.array([cfg.seed for cfg in given.configs], np.uint32)
    numbers: dict[str, Array] = {}
    numbers |= {
        name: np.array([number(cfg, name) for cfg in given.configs], np.float32)
        for name in given.numbers
    }
    if not numbers:
        return Members(seed, {}, None)
    low, high = np.array(
        [rewards.bounds(cfg.reward, cfg.target.gamma) for cfg in given.configs], np.float32
    ).T
    return Members(seed, numbers, (low, high))


def _lifted(program: Program, member: Members) -> Program:
    """The program of one member: its numbers in place of the constants."""
    if member.bounds is None:
        return program
    cfg = with_numbers(program.cfg, member.numbers)
    return dataclasses.replace(
        program, cfg=cfg, learner=actor_critic.with_numbers(program.learner, cfg, member.bounds)
    )


def init(
    program: Program, given: Members, mesh: Mesh | None = None, shard: Shard = "seeds"
) -> TrainState:
    """The state of all members before the first step, laid out over the mesh if there is one."""

    def begin(member: Members) -> TrainState:
        return step.begin(_lifted(program, member), jax.random.key(member.seed))

    build = jax.vmap(begin, out_axes=AXES)
    return jax.jit(build, out_shardings=shardings(mesh, shard))(given)


def shardings(mesh: Mesh | None, shard: Shard) -> Any:
    """Where the leaves of a state of members lie, as a prefix of it; None without a mesh."""
    if mesh is None:
        return None
    every, seeds = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(AXIS))
    if shard == "seeds":
        return _prefix(seeds, every, seeds)
    scenes = NamedSharding(mesh, PartitionSpec(None, AXIS))
    return _prefix(every, every, scenes)


def compile_chunk(
    program: Program,
    given: Members,
    num_steps: int,
    mesh: Mesh | None = None,
    shard: Shard = "seeds",
    in_lanes: int = 1,
):
    """A jitted function state -> (state, StepMetrics [T, S, ...]) of `num_steps` training steps of
    all members.

    The state is donated. With a mesh over seeds each device scans its own members and hears nothing
    of the others; metrics end up on every device. Networks that take turns do so, unless numbers
    are traced, which cannot be lifted out of a loop over members, or scenes are spread. Without a
    mesh members may run in lanes, which divide them.
    """
    here = len(given.seed) // (
        in_lanes if mesh is None else mesh.size
    )  # vmapped in one program of a device
    if mesh is not None and shard == "scenes":
        program = dataclasses.replace(program, spread=Spread(mesh))
    elif not given.numbers:
        program = dataclasses.replace(program, at_once=chunked_vmap.at_once(program.cfg, here))

    def chunk(state: TrainState, given: Members) -> tuple[TrainState, StepMetrics]:
        def one(member: Members, state: TrainState) -> tuple[TrainState, StepMetrics]:
            return step.train_step(_lifted(program, member), state)

        every = jax.vmap(one, in_axes=(0, AXES), out_axes=(AXES, 0))
        return jax.lax.scan(lambda carry, _: every(given, carry), state, length=num_steps)

    # What a CPU's library for convolutions makes of vmapped ones, or on several devices, is not
    # measured.
    known = program.cfg.net.kind != "small" or (here == 1 and mesh is None)
    asked = compiler.options(program.cfg) if known else None
    if mesh is None and in_lanes > 1:
        shares = [
            jax.tree.map(lambda leaf, part=part: leaf[part], given)
            for part in _parts(len(given.seed), in_lanes)
        ]
        jitted = jax.jit(chunk, donate_argnums=0, compiler_options=asked)
        return pipelined.InLanes(
            jitted, shares, jax.jit(lambda state: _split(state, in_lanes)), jax.jit(_joined)
        )
    if mesh is None:
        return jax.jit(lambda state: chunk(state, given), donate_argnums=0, compiler_options=asked)
    if shard == "seeds":
        chunk = _each_device(mesh, chunk)
    out = (shardings(mesh, shard), NamedSharding(mesh, PartitionSpec()))
    return jax.jit(
        lambda state: chunk(state, given),
        donate_argnums=0,
        out_shardings=out,
        compiler_options=asked,
    )


def _each_device(mesh: Mesh, chunk: Any) -> Any:
    """The chunk on each device's share of the members."""
    share, every, metrics = PartitionSpec(AXIS), PartitionSpec(), PartitionSpec(None, AXIS)
    state = _prefix(share, every, share)
    return jax.shard_map(
        chunk, mesh=mesh, in_specs=(state, share), out_specs=(state, metrics), check_vma=False
    )


def _parts(num: int, in_lanes: int) -> list[slice]:
    """Which of `num` members each lane has."""
    return [slice(k * num // in_lanes, (k + 1) * num // in_lanes) for k in range(in_lanes)]


def _split(state: TrainState, in_lanes: int) -> list[TrainState]:
    """The state of each lane, in memory of its own."""
    return [
        jax.tree.map(jnp.copy, member(state, part)) for part in _parts(state.key.shape[0], in_lanes)
    ]


def _joined(done: Sequence[tuple[TrainState, StepMetrics]]) -> tuple[TrainState, StepMetrics]:
    """What the lanes return, [S', ...] and [T, S', ...] each, as of all members."""
    states, metrics = zip(*done, strict=True)
    every = jax.tree.map(
        lambda *leaves: jnp.concatenate(leaves), *(one.replace(step=()) for one in states)
    )
    return every.replace(step=states[0].step), jax.tree.map(
        lambda *leaves: jnp.concatenate(leaves, axis=1), *metrics
    )


def member(state: TrainState, index: int | slice) -> TrainState:
    """The state of one member, as `train` has it, or of several."""
    parts = {
        "key": state.key,
        "scenes": state.scenes,
        "learner": state.learner,
        "replay": state.replay,
    }
    return TrainState(step=state.step, **jax.tree.map(lambda leaf: leaf[index], parts))


def abstract(
    program: Program, given: Members, mesh: Mesh | None = None, shard: Shard = "seeds"
) -> TrainState:
    """Shapes, types and places of `init`'s state; nothing is compiled."""
    shapes = jax.eval_shape(lambda: init(program, given))
    if mesh is None:
        return shapes

    def place(sharding: NamedSharding, tree: Any) -> Any:
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), tree
        )

    return jax.tree.map(place, shardings(mesh, shard), shapes)


def engine(
    given: Group, mesh: Mesh | None = None, shard: Shard = "seeds", trunk: Any = None
) -> Engine:
    """What the host needs of a group's program. The environment is made here; see `step.init` for
    `trunk`."""
    program, each = step.make(given.configs[0]), members(given)
    in_lanes = pipelined.number(program.cfg, len(given.configs), mesh)

    def begin() -> TrainState:
        state = init(program, each, mesh, shard)
        if trunk is None:
            return state
        state = state.replace(learner=actor_critic.with_trunk(state.learner, trunk))
        return state if mesh is None else jax.device_put(state, shardings(mesh, shard))

    return Engine(
        init=begin,
        abstract=lambda: abstract(program, each, mesh, shard),
        chunk=lambda num_steps: compile_chunk(program, each, num_steps, mesh, shard, in_lanes),
        member=member
        if mesh is None
        else jax.jit(member, out_shardings=NamedSharding(mesh, PartitionSpec())),
    )
