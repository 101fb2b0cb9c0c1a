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
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), jax.eval_shape(lambda: outcome.blank(num)))


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
    trace = _blank(len(pose))
    for index, data in enumerate(_substeps(world, model.with_blocks(world, fields), scene, drive)):
        touching = _touching(world, data)
        held = touching[1] & touching[2]
        rise = (data.qpos[world.block_qpos[:, 2]] - pose[:, 2]).astype(np.float32)
        gap = np.float32(2.0 * data.qpos[world.robot_qpos[-2]])
        seen: dict[str, Any] = {
            "touched": trace.touched | touching.any(),
            "held_rise": np.where(held, np.maximum(trace.held_rise, rise), trace.held_rise),
            "held": held,
            "rise": rise,
            "gap_closed": gap if index == closed_at else trace.gap_closed,
            "gap_end": gap,
        }
        trace = dataclasses.replace(trace, **seen)
    return data.qpos[world.block_qpos].astype(np.float32), data.qvel[world.block_dofs].astype(np.float32), trace


def _substeps(world: World, exact: mujoco.MjModel, scene: Scene, drive: Drive) -> Iterator[mujoco.MjData]:
    """The state after every substep, one and the same object; NumPy throughout."""
    exact.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data, parked = mujoco.MjData(exact), ~scene.in_play
    pose = np.concatenate([scene.position, scene.quaternion], axis=1)
    data.qpos[world.robot_qpos] = drive.start
    data.qpos[world.block_qpos], data.qvel[world.block_dofs] = pose, scene.velocity
    for control in drive.control:
        data.ctrl[:] = control
        mujoco.mj_step(exact, data)
        data.qvel[world.block_dofs] = np.clip(data.qvel[world.block_dofs], -layout.SPEED_LIMIT, layout.SPEED_LIMIT)
        data.qpos[world.block_qpos[parked]], data.qvel[world.block_dofs[parked]] = pose[parked], 0.0
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


def _touching(world: World, data: mujoco.MjData) -> np.ndarray:
    """Which hand geom touches which block, [3, N] bool."""
    pairs = data.contact.geom[data.contact.dist < 0.0]  # [C, 2]
    touching = np.zeros((len(world.hand_geoms), len(world.slots)), bool)
    for hand, other in (pairs.T, pairs.T[::-1]):
        slot = world.slot_of_geom[other]
        for row, geom in enumerate(world.hand_geoms):
            touching[row, slot[(hand == geom) & (slot >= 0)]] = True
    return touching
