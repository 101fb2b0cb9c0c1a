"""Primitives in C MuJoCo, the reference: every core of the host moves a scene.

The compiled step calls it back, so that the same environment can use it. C MuJoCo examines all
contacts; MJX keeps a fixed number of them.
"""

import contextlib
import copy
import dataclasses
import functools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from csac_jax.config import SimConfig
from csac_jax.scene import layout, model
from csac_jax.scene.layout import Scene
from csac_jax.scene.model import HAND_GEOMS, BlockFields, World
from csac_jax.sim import outcome
from csac_jax.sim.outcome import Substep, Trace
from csac_jax.sim.robot import JointTrajectory

_CALL_SUBSTEPS = 48  # per call of MuJoCo, ours: a longer call repeats more after a fast block


@dataclasses.dataclass(frozen=True, eq=False)
class CPhysics:
    """A world in C MuJoCo, with the solver's effort of the config.

    Raises ValueError for a world without touch sensors, which one built for MJX is.
    """

    world: World
    cfg: SimConfig

    def __post_init__(self) -> None:
        if self.world.model.nsensordata != len(HAND_GEOMS) * len(self.world.slots):
            raise ValueError("world: it has no touch sensors; build it with sim.physics c")

    @functools.cached_property
    def _simulators(self) -> "SimulatorPool":
        return SimulatorPool(self.world.model)

    def run(self, scene: Scene, joints: JointTrajectory) -> tuple[Scene, Trace]:
        """See `physics.Physics`."""
        num, substeps = len(self.world.slots), len(joints.control)
        shapes = [(num, 7), (num, 6), (substeps, num), (substeps,)]
        results = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
        touching = jax.ShapeDtypeStruct((substeps, len(HAND_GEOMS), num), bool)
        pose, velocity, rise, gap, touch = jax.pure_callback(
            functools.partial(_run_batch, self.world, self._simulators),
            (*results, touching),
            scene,
            model.scene_fields(self.world, scene),
            joints,
            vmap_method="broadcast_all",
        )
        moved = scene.replace(position=pose[:, :3], quaternion=pose[:, 3:], velocity=velocity)
        trace = outcome.trace_of(self.cfg, Substep(touch, rise, gap, jnp.zeros(substeps, bool)))
        return layout.park(moved, scene.in_play), trace


class Simulator(NamedTuple):
    """What one thread needs to move a scene."""

    model: mujoco.MjModel  # holds the blocks of the last scene
    data: mujoco.MjData
    engine: rollout.Rollout  # MuJoCo's own loop, run in the thread that calls it

    @classmethod
    def of(cls, world_model: mujoco.MjModel) -> "Simulator":
        """A simulator of a copy of the model."""
        own = copy.copy(world_model)
        own.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # no reset after a warning
        return cls(own, mujoco.MjData(own), rollout.Rollout(nthread=0))


class SimulatorPool:
    """One thread per core, and a simulator for each thread at work; both outlive a call.

    Making a simulator takes a sixteenth of the time of moving a scene of ten blocks.
    """

    def __init__(self, world_model: mujoco.MjModel) -> None:
        self._model = world_model
        self._threads = ThreadPoolExecutor(len(os.sched_getaffinity(0)))
        self._idle: list[Simulator] = []

    def map(self, function: Callable[[Any], Any], rows: Sequence[Any]) -> list[Any]:
        """The function's result for every row; concurrent calls share the threads."""
        return list(self._threads.map(function, rows))

    @contextlib.contextmanager
    def simulator(self) -> Iterator[Simulator]:
        """A simulator that nobody else uses meanwhile."""
        try:
            simulator = self._idle.pop()
        except IndexError:
            simulator = Simulator.of(self._model)
        try:
            yield simulator
        finally:
            self._idle.append(simulator)


def _run_batch(
    world: World,
    simulators: SimulatorPool,
    scene: Scene,
    fields: BlockFields,
    joints: JointTrajectory,
) -> Any:
    """`_run` of every scene of a batch; the leading axes come back. NumPy only: JAX must not run
    inside a callback."""
    axes = np.shape(joints.reachable)
    batch = jax.tree.map(
        lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[len(axes) :]), (scene, fields, joints)
    )
    rows = [jax.tree.map(lambda leaf, i=i: leaf[i], batch) for i in range(len(batch[2].reachable))]
    results = simulators.map(lambda row: _run(world, simulators, *row), rows)
    return jax.tree.map(
        lambda *leaves: np.stack(leaves).reshape((*axes, *np.shape(leaves[0]))), *results
    )


def _run(
    world: World,
    simulators: SimulatorPool,
    scene: Scene,
    fields: BlockFields,
    joints: JointTrajectory,
) -> tuple[Any, ...]:
    """One scene: final poses [N, 7] and velocities [N, 6]; rise [T, N], gap [T] and touching
    [T, 3, N] as in `Substep`."""
    num, substeps = len(world.slots), len(joints.control)
    if not _moves(scene, joints):
        pose = np.concatenate([scene.position, scene.quaternion], axis=1)
        unseen = np.zeros((substeps, num), np.float32), np.zeros(substeps, np.float32)
        return pose, scene.velocity, *unseen, np.zeros((substeps, len(HAND_GEOMS), num), bool)
    with simulators.simulator() as simulator:
        qpos, qvel, sensed = _rollout(world, simulator, scene, fields, joints)
    pose, velocity = qpos[-1][world.block_qpos], qvel[-1][world.block_dofs]
    rise = qpos[:, world.block_qpos[:, 2]] - scene.position[:, 2]
    gap = 2.0 * qpos[:, world.robot_qpos[-2]]
    touching = sensed.reshape(substeps, len(HAND_GEOMS), num) > 0.0
    return *(leaf.astype(np.float32) for leaf in (pose, velocity, rise, gap)), touching


def _moves(scene: Scene, joints: JointTrajectory) -> bool:
    """Whether there is anything to simulate: a block, a reachable plan, and no NaN, which would
    make MuJoCo reset."""
    state = (scene.position, scene.quaternion, scene.velocity)
    return bool(
        joints.reachable and scene.in_play.any() and all(np.isfinite(leaf).all() for leaf in state)
    )


class Trajectory(NamedTuple):
    """Every state of a scene while the robot moves. T = substeps."""

    qpos: np.ndarray  # [T, nq] m and rad, MuJoCo's order
    qvel: np.ndarray  # [T, nv] m/s and rad/s
    sensed: np.ndarray  # [T, sensors], as the substep begins


def trajectory(
    world: World, fields: BlockFields, scene: Scene, joints: JointTrajectory
) -> Trajectory:
    """Every state of one scene, of NumPy arrays; no substep where the robot cannot follow."""
    if joints.reachable:
        return _rollout(world, Simulator.of(world.model), scene, fields, joints)
    sizes = world.model.nq, world.model.nv, world.model.nsensordata
    return Trajectory(*(np.zeros((0, size)) for size in sizes))


def _rollout(
    world: World, simulator: Simulator, scene: Scene, fields: BlockFields, joints: JointTrajectory
) -> Trajectory:
    """Every state of one scene. Parked blocks touch nothing and stay where they are."""
    own, parked = simulator.model, ~scene.in_play
    is_parked = np.isin(world.slot_of_geom, np.flatnonzero(parked))
    own.geom_contype[:] = np.where(is_parked, 0, world.model.geom_contype)
    own.geom_conaffinity[:] = np.where(is_parked, 0, world.model.geom_conaffinity)
    # MuJoCo derives the bodies' contact masks here: the geoms' come first.
    model.with_blocks(world, fields, into=(own, simulator.data))
    start, speeds = _start(world, scene, joints), 1 + own.nq + world.block_dofs[scene.in_play]
    states, sensed = _simulate(simulator, start, np.asarray(joints.control), speeds)
    qpos, qvel = np.split(states[:, 1:], [own.nq], axis=1)
    waiting = world.block_qpos[parked]
    qpos[:, waiting], qvel[:, world.block_dofs[parked]] = start[1 + waiting], 0.0  # they fell
    return Trajectory(qpos, qvel, sensed)


def _start(world: World, scene: Scene, joints: JointTrajectory) -> np.ndarray:
    """State [1 + nq + nv], MuJoCo's, of the scene's blocks and the robot at its first set-point."""
    qpos, qvel = world.model.qpos0.copy(), np.zeros(world.model.nv)
    qpos[world.robot_qpos] = joints.start
    qpos[world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
    qvel[world.block_dofs] = scene.velocity
    return np.concatenate([[0.0], qpos, qvel])


def _simulate(
    simulator: Simulator, state: np.ndarray, control: np.ndarray, speeds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """States [T, 1 + nq + nv], MuJoCo's, and sensors [T, ...] from `state` by `control` [T, ...].

    `speeds` [..., 6] are the places of block velocities in a state: after every substep they are
    held to SPEED_LIMIT. MuJoCo's own loop cannot do that, so a call ends with the first substep
    after which a block is too fast. The next call starts from the limited velocities and the
    solver's warm start, which gives the same bits as a loop that never ended.
    """
    own, data, engine = simulator
    parts, done, ahead, warm = [], 0, _CALL_SUBSTEPS, np.zeros(own.nv)
    while done < len(control):
        (states,), (sensed,) = engine.rollout(
            own, data, state, control[None, done : done + ahead], initial_warmstart=warm
        )
        too_fast = (np.abs(states[:, speeds]) > layout.SPEED_LIMIT).any(axis=(1, 2))
        if too_fast[:-1].any():
            ahead = int(np.argmax(too_fast)) + 1
            continue
        state, warm = states[-1], data.qacc_warmstart.copy()
        state[speeds] = np.clip(state[speeds], -layout.SPEED_LIMIT, layout.SPEED_LIMIT)
        parts.append((states, sensed))
        done, ahead = done + len(states), 1 if too_fast[-1] else min(2 * ahead, _CALL_SUBSTEPS)
    all_states, all_sensed = zip(*parts, strict=True)
    return np.concatenate(all_states), np.concatenate(all_sensed)
