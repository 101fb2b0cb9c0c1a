"""Primitives in C MuJoCo: the reference, a scene per core of the host at a time.

It runs behind a callback, so that the same environment, compiled, can be asked to use it. Contacts
are all examined here: MJX keeps a fixed number of them.
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
from csac_jax.sim.outcome import Trace
from csac_jax.sim.robot import Drive

_AHEAD = 48  # substeps at a time, ours: more calls of MuJoCo cost less than going back to where a block is too fast


@dataclasses.dataclass(frozen=True, eq=False)
class CPhysics:
    """A world in C MuJoCo, with the solver's effort of the config.

    Raises ValueError for a world that was built for MJX, which has no touch sensors.
    """

    world: World
    cfg: SimConfig

    def __post_init__(self) -> None:
        if self.world.model.nsensordata != len(HAND_GEOMS) * len(self.world.slots):
            raise ValueError("world: it has no touch sensors; build it with sim.physics c")

    @functools.cached_property
    def _workers(self) -> "Workers":
        return Workers(self.world.model)

    def run(self, scene: Scene, drive: Drive) -> tuple[Scene, Trace]:
        """See `physics.Physics`."""
        num = len(self.world.slots)
        shapes = jax.eval_shape(
            lambda: (jnp.zeros((num, 7)), jnp.zeros((num, 6)), outcome.blank(num))
        )
        fields = model.scene_fields(self.world, scene)
        host = functools.partial(
            _run_batch, self.world, self._workers, sum(self.cfg.grasp_phases[:2]) - 1
        )
        pose, velocity, trace = jax.pure_callback(
            host, shapes, scene, fields, drive, vmap_method="broadcast_all"
        )
        moved = scene.replace(position=pose[:, :3], quaternion=pose[:, 3:], velocity=velocity)
        return layout.park(moved, scene.in_play), trace


class Room(NamedTuple):
    """What it takes to move one scene."""

    exact: mujoco.MjModel  # its blocks are those of the last scene
    data: mujoco.MjData
    loop: rollout.Rollout  # MuJoCo's own, in the thread that calls it


class Workers:
    """Threads that move scenes of a model, as many as there are cores, and a room for each that is
    at work.

    Both are kept from call to call: to make a room takes a sixteenth of the time of moving a scene
    of ten blocks.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._threads = ThreadPoolExecutor(len(os.sched_getaffinity(0)))
        self._idle: list[Room] = []

    def each(self, do: Callable[[Any], Any], rows: Sequence[Any]) -> list[Any]:
        """What `do` makes of every row; calls at the same time share the threads."""
        return list(self._threads.map(do, rows))

    @contextlib.contextmanager
    def room(self) -> Iterator[Room]:
        """A room that nobody else has meanwhile."""
        try:
            room = self._idle.pop()
        except IndexError:
            exact = _lasting(copy.copy(self._model))
            room = Room(exact, mujoco.MjData(exact), rollout.Rollout(nthread=0))
        try:
            yield room
        finally:
            self._idle.append(room)


def _blank(num: int) -> Trace:
    """`outcome.blank` in NumPy."""
    no, zero, zeros = np.zeros((), bool), np.zeros((), np.float32), np.zeros(num, np.float32)
    leaves: dict[str, Any] = {
        "touched": no,
        "held_rise": zeros,
        "held": np.zeros(num, bool),
        "rise": zeros,
        "gap_closed": zero,
        "gap_end": zero,
        "contact_overflow": np.zeros((), np.int32),
    }
    return Trace(**leaves)


def _run_batch(
    world: World, workers: Workers, closed_at: int, scene: Scene, fields: BlockFields, drive: Drive
) -> Any:
    """Every scene of a batch, leaves [..., N, ...]; same axes come back. NumPy throughout: JAX must
    not run here."""
    axes = np.shape(drive.reachable)
    rows = jax.tree.map(
        lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[len(axes) :]), (scene, fields, drive)
    )
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], rows) for i in range(len(rows[2].reachable))]
    done = workers.each(lambda row: _run(world, workers, closed_at, *row), each)
    return jax.tree.map(
        lambda *leaves: np.stack(leaves).reshape((*axes, *np.shape(leaves[0]))), *done
    )


def _run(
    world: World, workers: Workers, closed_at: int, scene: Scene, fields: BlockFields, drive: Drive
) -> Any:
    """Poses [N, 7], velocities [N, 6] and trace of one scene."""
    if not _moves(scene, drive):
        return _unmoved(scene)
    with workers.room() as room:
        return _judge(world, closed_at, scene, _roll(world, room, scene, fields, drive))


def _moves(scene: Scene, drive: Drive) -> bool:
    """Whether there is anything to simulate: a block, a way to go, and no NaN, at which MuJoCo
    would start anew."""
    state = (scene.position, scene.quaternion, scene.velocity)
    return bool(
        drive.reachable and scene.in_play.any() and all(np.isfinite(leaf).all() for leaf in state)
    )


def _unmoved(scene: Scene) -> tuple[Any, Any, Trace]:
    """Poses [N, 7], velocities [N, 6] and trace of a scene in which nothing moves; nobody looks at
    the gap."""
    return (
        np.concatenate([scene.position, scene.quaternion], axis=1),
        scene.velocity,
        _blank(len(scene.in_play)),
    )


class Film(NamedTuple):
    """What a drive goes through, substep by substep; no substep where the robot cannot follow. T =
    substeps."""

    qpos: np.ndarray  # [T, nq] m and rad, MuJoCo's order
    qvel: np.ndarray  # [T, nv] m/s and rad/s
    sensed: np.ndarray  # [T, sensors], at the beginning of the substep


def _judge(world: World, closed_at: int, scene: Scene, film: Film) -> tuple[Any, Any, Trace]:
    """Poses [N, 7], velocities [N, 6] and trace of what a film shows."""
    touching = film.sensed.reshape(len(film.sensed), len(HAND_GEOMS), len(world.slots)) > 0.0
    held = touching[:, 1] & touching[:, 2]  # [T, N]
    rise = (film.qpos[:, world.block_qpos[:, 2]] - scene.position[:, 2]).astype(
        np.float32
    )  # [T, N]
    gap = (2.0 * film.qpos[:, world.robot_qpos[-2]]).astype(np.float32)
    leaves: dict[str, Any] = {
        "touched": touching.any(),
        "held_rise": np.where(held, rise, np.float32(0.0)).max(axis=0, initial=0.0),
        "held": held[-1],
        "rise": np.where(scene.in_play, rise[-1], np.float32(0.0)),
        "gap_closed": gap[closed_at],
        "gap_end": gap[-1],
        "contact_overflow": np.zeros((), np.int32),
    }
    pose, velocity = film.qpos[-1][world.block_qpos], film.qvel[-1][world.block_dofs]
    return pose.astype(np.float32), velocity.astype(np.float32), Trace(**leaves)


def _roll(world: World, room: Room, scene: Scene, fields: BlockFields, drive: Drive) -> Film:
    """`film` of a scene that moves, by MuJoCo's own loop; parked blocks fall and meet nothing."""
    exact = room.exact
    parked = np.isin(world.slot_of_geom, np.flatnonzero(~scene.in_play))
    exact.geom_contype[:] = np.where(parked, 0, world.model.geom_contype)
    exact.geom_conaffinity[:] = np.where(parked, 0, world.model.geom_conaffinity)
    model.with_blocks(
        world, fields, room.data, into=exact
    )  # after these, of which MuJoCo derives those of bodies
    start = np.concatenate([[0.0], *_start(world, scene, drive)])
    in_play = (
        1 + exact.nq + world.block_dofs[scene.in_play]
    )  # [N in play, 6], where a state has their velocities
    states, sensed = _limited(room, start, np.asarray(drive.control), in_play)
    qpos, qvel = np.split(states[:, 1:], [exact.nq], axis=1)
    return Film(qpos, qvel, sensed)


def _limited(
    room: Room, state: np.ndarray, control: np.ndarray, limited: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """States [T, 1 + nq + nv], MuJoCo's, and sensors [T, ...] from `state` by `control` [T, ...].

    What a state has at `limited` [..., 6], velocities of blocks, is held to the limit, which
    MuJoCo's own loop cannot. So it ends with a substep after which one is beyond, and goes on from
    there with the limited velocities and the solver's warm start: the same bits as if it had never
    ended.
    """
    exact, data, loop = room
    parts, done, ahead, warm = [], 0, _AHEAD, np.zeros(exact.nv)
    while done < len(control):
        (states,), (sensed,) = loop.rollout(
            exact, data, state, control[None, done : done + ahead], initial_warmstart=warm
        )
        too_fast = (np.abs(states[:, limited]) > layout.SPEED_LIMIT).any(axis=(1, 2))
        if too_fast[:-1].any():
            ahead = int(np.argmax(too_fast)) + 1
            continue
        state, warm = states[-1], data.qacc_warmstart.copy()
        state[limited] = np.clip(state[limited], -layout.SPEED_LIMIT, layout.SPEED_LIMIT)
        parts.append((states, sensed))
        done, ahead = done + len(states), 1 if too_fast[-1] else min(2 * ahead, _AHEAD)
    all_states, all_sensed = zip(*parts, strict=True)
    return np.concatenate(all_states), np.concatenate(all_sensed)


def _lasting(exact: mujoco.MjModel) -> mujoco.MjModel:
    """The model, its state never begun anew after a warning."""
    exact.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return exact


def _start(world: World, scene: Scene, drive: Drive) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities, MuJoCo's order, of the scene's blocks and the robot at the drive's
    start."""
    qpos, qvel = world.model.qpos0.copy(), np.zeros(world.model.nv)
    qpos[world.robot_qpos] = drive.start
    qpos[world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
    qvel[world.block_dofs] = scene.velocity
    return qpos, qvel


def _substeps(
    world: World, exact: mujoco.MjModel, scene: Scene, drive: Drive
) -> Iterator[mujoco.MjData]:
    """The state after every substep, one and the same object; NumPy throughout."""
    data, parked = mujoco.MjData(_lasting(exact)), np.flatnonzero(~scene.in_play)
    data.qpos[:], data.qvel[:] = _start(world, scene, drive)
    places, still = world.block_qpos[parked], world.block_dofs[parked]
    waiting = data.qpos[places]
    fastest = np.full(exact.nv, np.inf)
    fastest[world.block_dofs] = layout.SPEED_LIMIT
    for control in drive.control:
        data.ctrl[:] = control
        mujoco.mj_step(exact, data)
        np.minimum(data.qvel, fastest, out=data.qvel)
        np.maximum(data.qvel, -fastest, out=data.qvel)
        if len(parked):
            data.qpos[places], data.qvel[still] = waiting, 0.0
        yield data


def film(world: World, fields: BlockFields, scene: Scene, drive: Drive) -> Film:
    """Every state of one drive of one scene; NumPy throughout."""
    exact = model.with_blocks(world, fields)
    steps = _substeps(world, exact, scene, drive) if drive.reachable else ()
    states = [(data.qpos.copy(), data.qvel.copy(), data.sensordata.copy()) for data in steps]
    sizes = exact.nq, exact.nv, exact.nsensordata
    return Film(
        *(
            map(np.stack, zip(*states, strict=True))
            if states
            else (np.zeros((0, size)) for size in sizes)
        )
    )
