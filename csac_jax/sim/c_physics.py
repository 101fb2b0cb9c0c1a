"""Primitives in C MuJoCo, the reference engine, on every core; the compiled step calls it back."""

import contextlib
import copy
import dataclasses
import functools
import hashlib
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from mujoco import rollout

from csac_jax.config import SimConfig
from csac_jax.robot.primitives import JointTrajectory
from csac_jax.runtime import host_call
from csac_jax.sim import model_fields, outcome
from csac_jax.sim.outcome import Substep, Trace
from csac_jax.world import model, scene_state
from csac_jax.world.model import BlockFields, World
from csac_jax.world.scene_state import SceneState

_CALL_SUBSTEPS = 48  # per call of MuJoCo, ours: a longer call repeats more after a fast block


@dataclasses.dataclass(frozen=True, eq=False)
class CPhysics:
    """A world in C MuJoCo. Raises ValueError for one without touch sensors, as MJX has them."""

    world: World
    cfg: SimConfig
    _idle: list["CSimulator"] = dataclasses.field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        if self.world.model.nsensordata != len(self.world.hand_geoms) * len(self.world.slots):
            raise ValueError("world: it has no touch sensors; build it with sim.physics c")

    @functools.cached_property
    def _key(self) -> str:
        """Returns a digest of world, settings and MuJoCo, the same in every process."""
        identity = repr((self.world.digest, self.cfg, mujoco.__version__))
        return hashlib.sha256(identity.encode()).hexdigest()

    @functools.cached_property
    def _threads(self) -> ThreadPoolExecutor:
        """Returns one thread per core, which concurrent calls share."""
        return ThreadPoolExecutor(len(os.sched_getaffinity(0)))

    @contextlib.contextmanager
    def _simulator(self) -> Iterator["CSimulator"]:
        try:
            simulator = self._idle.pop()
        except IndexError:
            simulator = CSimulator(self.world)
        yield simulator
        self._idle.append(simulator)

    def run(self, scene: SceneState, joints: JointTrajectory) -> tuple[SceneState, Trace]:
        """Runs one primitive, see `physics.Physics`."""
        fields = model.scene_fields(self.world, scene)
        result = scene, outcome.nothing_seen(len(joints.control), len(self.world.slots))
        run = self._run_batch
        call = functools.partial(jax.pure_callback, run, vmap_method="broadcast_all")
        if jax.default_backend() == "cpu" and jax.device_count() == 1:
            call = functools.partial(host_call.call, run, self._key)
        moved, substeps = call(result, scene, fields, joints)
        return scene_state.park(moved, scene.in_play), outcome.trace_of(self.cfg, substeps)

    def _run_batch(self, *batch: Any) -> Any:
        """Runs a batch of scenes and keeps its axes. NumPy only: JAX must not run in a callback."""
        batch = jax.tree.map(np.asarray, batch)
        axes = batch[-1].reachable.shape
        rows = [jax.tree.map(lambda leaf, i=i: leaf[i], batch) for i in np.ndindex(axes)]
        results = self._threads.map(self._run, *zip(*rows, strict=True))
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *results)
        return jax.tree.map(lambda leaf: leaf.reshape((*axes, *leaf.shape[1:])), stacked)

    def _run(
        self, scene: SceneState, fields: BlockFields, joints: JointTrajectory
    ) -> tuple[SceneState, Substep]:
        world = self.world
        substeps = outcome.nothing_seen(len(joints.control), len(world.slots))
        inputs = scene.position, scene.quaternion, scene.velocity, joints.start, joints.control
        finite = all(np.isfinite(leaf).all() for leaf in inputs)  # MuJoCo resets one with NaN
        if not (finite and joints.reachable and scene.in_play.any()):
            return scene, substeps
        with self._simulator() as simulator:
            qpos, qvel, sensed = simulator.rollout(scene, fields, joints)
        last = qpos[-1].astype(np.float32), qvel[-1].astype(np.float32)
        moved = model_fields.moved(world, scene, *last)
        found = sensed.reshape(len(sensed), len(world.hand_geoms), -1) > 0.0
        parts = [found[:, world.hand_parts == part].any(axis=1) for part in range(outcome.PARTS)]
        touching = np.stack(parts, axis=1)
        rise = np.float32(qpos[:, world.block_qpos[:, 2]] - scene.position[:, 2])
        gap = np.float32(world.gripper.gap(qpos[:, world.finger_qpos]))
        lag = np.float32(qpos[:, world.press_qpos] - joints.control[:, world.press])
        return moved, substeps.replace(touching=touching, rise=rise, gap=gap, lag=lag)


class Trajectory(NamedTuple):
    """Every state of a scene while the robot moves. T = substeps."""

    qpos: np.ndarray  # [T, nq] m and rad, MuJoCo's order
    qvel: np.ndarray  # [T, nv] m/s and rad/s
    sensed: np.ndarray  # [T, sensors], as the substep begins


def trajectory(
    world: World, fields: BlockFields, scene: SceneState, joints: JointTrajectory
) -> Trajectory:
    """Simulates one scene of NumPy arrays; returns no substep where the robot cannot follow."""
    if joints.reachable:
        return CSimulator(world).rollout(scene, fields, joints)
    sizes = world.model.nq, world.model.nv, world.model.nsensordata
    return Trajectory(*(np.zeros((0, size)) for size in sizes))


class CSimulator:
    """A MuJoCo model and data that one thread reuses for scenes. Objects at rest sleep."""

    def __init__(self, world: World) -> None:
        self._world = world
        self.model = copy.copy(world.model)  # holds the blocks of the last scene
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # after a warning
        if world.objects is not None:
            self.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
            self.model.opt.sleep_tolerance = scene_state.STILL
        self._data = mujoco.MjData(self.model)
        self._engine = rollout.Rollout(nthread=0)  # MuJoCo's own loop, run in the calling thread

    def rollout(
        self, scene: SceneState, fields: BlockFields, joints: JointTrajectory
    ) -> Trajectory:
        """Simulates one scene. Parked blocks touch nothing and stay where they are."""
        world, mj_model, parked = self._world, self.model, ~scene.in_play
        is_parked = np.isin(world.slot_of_geom, np.flatnonzero(parked))
        mj_model.geom_contype[:] = np.where(is_parked, 0, world.model.geom_contype)
        mj_model.geom_conaffinity[:] = np.where(is_parked, 0, world.model.geom_conaffinity)
        # MuJoCo derives the bodies' contact masks here: the geoms' come first.
        model.with_blocks(world, fields, into=(mj_model, self._data))
        mujoco.mj_resetData(mj_model, self._data)  # what slept in the last scene
        start = np.concatenate([[0.0], world.model.qpos0, np.zeros(mj_model.nv)])
        start[1 + world.robot_qpos] = joints.start
        start[1 + world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
        start[1 + mj_model.nq + world.block_dofs] = scene.velocity
        speeds = 1 + mj_model.nq + world.block_dofs[scene.in_play]
        states, sensed = self._steps(start, np.asarray(joints.control), speeds)
        qpos, qvel = np.split(states[:, 1:], [mj_model.nq], axis=1)
        waiting = world.block_qpos[parked]
        qpos[:, waiting], qvel[:, world.block_dofs[parked]] = start[1 + waiting], 0.0  # they fell
        return Trajectory(qpos, qvel, sensed)

    def _steps(self, state: Any, control: np.ndarray, speeds: np.ndarray) -> list[np.ndarray]:
        """Steps by `control` [T, ...]; returns states [T, 1 + nq + nv] and sensors [T, ...].

        Velocities, at places `speeds` [..., 6] in a state, are held to SPEED_LIMIT after every
        substep. MuJoCo's own loop cannot do that, so a call ends with the first substep after which
        a block is too fast. The next one starts from the limited velocities and the solver's warm
        start. That gives the bits of one loop, except that sleeping objects may wake.
        """
        most, warm = scene_state.SPEED_LIMIT, np.zeros(self.model.nv)
        parts, done, ahead = [], 0, _CALL_SUBSTEPS
        while done < len(control):
            rows = control[None, done : done + ahead]
            (states,), (sensed,) = self._engine.rollout(
                self.model, self._data, state, rows, initial_warmstart=warm
            )
            too_fast = (np.abs(states[:, speeds]) > most).any(axis=(1, 2))
            if too_fast[:-1].any():
                ahead = int(np.argmax(too_fast)) + 1
                continue
            state, warm = states[-1], self._data.qacc_warmstart.copy()
            state[speeds] = np.clip(state[speeds], -most, most)
            parts.append((states, sensed))
            done, ahead = done + len(states), 1 if too_fast[-1] else min(2 * ahead, _CALL_SUBSTEPS)
        return [np.concatenate(leaves) for leaves in zip(*parts, strict=True)]
