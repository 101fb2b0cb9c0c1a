"""Primitives in C MuJoCo: the reference, scene by scene in threads on the host.

It runs behind a callback, so that the same environment, compiled, can be asked to use it. Contacts are all examined
here: MJX keeps a fixed number of them.
"""

import concurrent.futures
import dataclasses
import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from csac_jax.config import SimConfig
from csac_jax.scene import layout, model
from csac_jax.scene.layout import Scene
from csac_jax.scene.model import BlockFields, World
from csac_jax.sim import outcome
from csac_jax.sim.outcome import Trace
from csac_jax.sim.robot import Drive


@dataclasses.dataclass(frozen=True, eq=False)
class CPhysics:
    """A world in C MuJoCo, with the solver's effort of the config."""

    world: World
    cfg: SimConfig

    def run(self, scene: Scene, drive: Drive) -> tuple[Scene, Trace]:
        """See `physics.Physics`."""
        num = len(self.world.slots)
        shapes = jax.eval_shape(lambda: (jnp.zeros((num, 7)), jnp.zeros((num, 6)), outcome.blank(num)))
        fields = model.scene_fields(self.world, scene)
        host = functools.partial(_run_batch, self.world, sum(self.cfg.grasp_phases[:2]) - 1)
        pose, velocity, trace = jax.pure_callback(host, shapes, scene, fields, drive, vmap_method="broadcast_all")
        moved = scene.replace(position=pose[:, :3], quaternion=pose[:, 3:], velocity=velocity)
        return layout.park(moved, scene.in_play), trace


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
        "saturated": np.zeros((), np.int32),
    }
    return Trace(**leaves)


def _run_batch(world: World, closed_at: int, scene: Scene, fields: BlockFields, drive: Drive) -> Any:
    """Every scene of a batch, leaves [..., N, ...], in a thread of its own; same axes come back."""
    axes = np.shape(drive.reachable)
    rows = jax.tree.map(lambda leaf: np.reshape(leaf, (-1, *np.shape(leaf)[len(axes) :])), (scene, fields, drive))
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], rows) for i in range(len(rows[2].reachable))]
    with concurrent.futures.ThreadPoolExecutor() as threads:
        done = list(threads.map(lambda row: _run(world, closed_at, *row), each))
    return jax.tree.map(lambda *leaves: np.stack(leaves).reshape((*axes, *np.shape(leaves[0]))), *done)


def _run(world: World, closed_at: int, scene: Scene, fields: BlockFields, drive: Drive) -> tuple[Any, Any, Trace]:
    """Poses [N, 7], velocities [N, 6] and trace of one scene; NumPy throughout, as JAX must not run in a callback."""
    pose = np.concatenate([scene.position, scene.quaternion], axis=1)
    if not (np.isfinite(pose).all() and np.isfinite(scene.velocity).all()):  # MuJoCo would start anew from scratch
        return pose, scene.velocity, _blank(len(pose))
    if not (drive.reachable and scene.in_play.any()):  # nothing moves, and nobody looks at the gap
        return pose, scene.velocity, _blank(len(pose))
    row_of_geom, touched = np.full(world.model.ngeom, -1), False
    row_of_geom[world.hand_geoms] = np.arange(len(world.hand_geoms))
    held, held_rise, gap_closed = np.zeros(len(pose), bool), np.zeros(len(pose), np.float32), np.float32(0.0)
    heights, finger = world.block_qpos[:, 2], world.robot_qpos[-2]
    for index, data in enumerate(_substeps(world, model.with_blocks(world, fields), scene, drive)):
        touching = _touching(world, row_of_geom, data)
        held = touching[1] & touching[2]
        rise = (data.qpos[heights] - pose[:, 2]).astype(np.float32)
        touched = touched or bool(touching.any())
        if held.any():
            held_rise = np.where(held, np.maximum(held_rise, rise), held_rise)
        if index == closed_at:
            gap_closed = np.float32(2.0 * data.qpos[finger])
    leaves: dict[str, Any] = {
        "touched": np.asarray(touched),
        "held_rise": held_rise,
        "held": held,
        "rise": rise,
        "gap_closed": gap_closed,
        "gap_end": np.float32(2.0 * data.qpos[finger]),
        "saturated": np.zeros((), np.int32),
    }
    end = data.qpos[world.block_qpos].astype(np.float32), data.qvel[world.block_dofs].astype(np.float32)
    return *end, Trace(**leaves)


def _substeps(world: World, exact: mujoco.MjModel, scene: Scene, drive: Drive) -> Iterator[mujoco.MjData]:
    """The state after every substep, one and the same object; NumPy throughout."""
    exact.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data, parked = mujoco.MjData(exact), np.flatnonzero(~scene.in_play)
    pose = np.concatenate([scene.position, scene.quaternion], axis=1)
    data.qpos[world.robot_qpos] = drive.start
    data.qpos[world.block_qpos], data.qvel[world.block_dofs] = pose, scene.velocity
    places, still, waiting = world.block_qpos[parked], world.block_dofs[parked], pose[parked]
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


class Film(NamedTuple):
    """What `run` goes through, substep by substep; no substep where the robot cannot follow. T = substeps."""

    qpos: np.ndarray  # [T, nq] m and rad, MuJoCo's order
    qvel: np.ndarray  # [T, nv] m/s and rad/s


def film(world: World, fields: BlockFields, scene: Scene, drive: Drive) -> Film:
    """Every state of one drive of one scene; NumPy throughout."""
    exact = model.with_blocks(world, fields)
    steps = _substeps(world, exact, scene, drive) if drive.reachable else ()
    states = [(data.qpos.copy(), data.qvel.copy()) for data in steps]
    return (
        Film(*(np.stack(column) for column in zip(*states, strict=True)))
        if states
        else Film(np.zeros((0, exact.nq)), np.zeros((0, exact.nv)))
    )


def _touching(world: World, row_of_geom: np.ndarray, data: mujoco.MjData) -> np.ndarray:
    """Which hand geom touches which block, [3, N] bool; `row_of_geom` [geoms], -1 where it is none of the hand's."""
    touching = np.zeros((len(world.hand_geoms), len(world.slots)), bool)
    pairs = data.contact.geom  # [C, 2]
    row = row_of_geom[pairs]
    near = np.flatnonzero((row >= 0).any(axis=1))
    if near.size:
        near = near[data.contact.dist[near] < 0.0]
        row, slot = row[near], world.slot_of_geom[pairs[near]]
        for hand, other in ((0, 1), (1, 0)):
            met = (row[:, hand] >= 0) & (slot[:, other] >= 0)
            touching[row[met, hand], slot[met, other]] = True
    return touching
