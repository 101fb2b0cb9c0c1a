"""Dense maps of one state: Q and actor logits for every primitive, yaw and cell.

Map k stays in frame k, the workspace turned so that yaw_k points along +column. Q at an action is
bilinear in the two frames next to its yaw, linear between them.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax import geometry, grippers
from csac_jax.agent import box
from csac_jax.config import Config, HeightmapConfig, PolicyConfig, SimConfig
from csac_jax.constants import Primitive
from csac_jax.grippers import Fingers
from csac_jax.nets import dense
from csac_jax.nets.convolution import conv2d
from csac_jax.nets.networks import Networks
from csac_jax.robot import fit, primitives
from csac_jax.sim.outcome import BARE
from csac_jax.vision import heightmap, rotate
from csac_jax.vision.heightmap import Observation
from csac_jax.world import tray

FIT_SCALE = 100.0  # 1 / m, of the maps of `fit.everywhere` in the net's input


def allowed_primitives(cfg: PolicyConfig) -> tuple[Primitive, ...]:
    """Returns the primitives that a policy takes; V(s) and the actor's loss range over them."""
    return (Primitive.GRASP,) if cfg.primitive == "grasp" else tuple(Primitive)


@dataclasses.dataclass(frozen=True, eq=False)
class Frames:
    """Geometry of the dense maps' cells. K = yaws, h = w = rows and columns of a map."""

    tables: rotate.RotationTables  # of the first K / 2 frames; the others are these upside down
    sim: SimConfig  # of a net that sees how the hand fits
    sees_fit: bool
    yaws: np.ndarray  # [K] rad
    networks: Networks
    side: int  # h = w, cells
    cell: float  # side of a cell, m
    extent: float  # side of the workspace, m
    push_length: float  # m
    shows_target: bool  # the net sees the target's mask
    all_cells: bool  # actions may begin on bare table
    walls: np.ndarray  # [H, W] m, height of the tray's walls; 0 elsewhere
    xy: np.ndarray  # [K, h, w, 2] m, workspace position of every cell
    inside: np.ndarray  # [K, h, w] bool, above the workspace, or above the tray's floor
    reachable: np.ndarray  # [P, K, h, w] bool, the robot reaches both ends of the action


def frames(cfg: Config, networks: Networks) -> Frames:
    """Builds the frames of a config's heightmap and net."""
    size, extent, rotations = cfg.heightmap.size, cfg.heightmap.extent, cfg.net.rotations
    tables = rotate.tables(size, extent, rotations, rotations // 2, cfg.net.canvas(size))
    side, cell = tables.canvas // networks.stride, tables.cell * networks.stride
    sim = dataclasses.replace(cfg.sim, gripper=grippers.resolve(cfg.sim.gripper))
    xy, yaws = _cells(rotations, side, cell)
    return Frames(
        tables=tables,
        sim=sim,
        sees_fit=cfg.net.fit,
        yaws=yaws,
        networks=networks,
        side=side,
        cell=cell,
        extent=extent,
        push_length=cfg.sim.push_length,
        shows_target=cfg.sees_mask,
        all_cells=cfg.policy.action_mask == "none",
        walls=_walls(cfg),
        xy=xy,
        inside=np.all(np.abs(xy) <= 0.5 * (cfg.scene.tray or extent), axis=-1),
        reachable=_reachable(sim, cfg.heightmap, rotations, side, cell),
    )


def _walls(cfg: Config) -> np.ndarray:
    size, cell = cfg.heightmap.size, cfg.heightmap.cell
    # NumPy: `geometry.cell_centres` has no values while jax2onnx traces. The same, bit for bit.
    places = (np.arange(size, dtype=np.float32) - 0.5 * (size - 1)) * cell
    xy = np.stack(np.meshgrid(places, places), axis=-1)
    # A point that a camera at the side sees lies anywhere in its cell.
    margin = 0.5 * cfg.heightmap.cell if cfg.heightmap.view != "ortho" else 0.0
    return tray.heights(cfg.scene.tray, xy, margin)


def _cells(rotations: int, side: int, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns each cell's workspace position [K, h, w, 2] m, and the frames' yaws [K] rad."""
    yaws = 2.0 * np.pi * np.arange(rotations) / rotations
    along = (np.arange(side) - 0.5 * (side - 1)) * cell
    x, y = along[None, None, :], along[None, :, None]
    cos, sin = np.cos(yaws)[:, None, None], np.sin(yaws)[:, None, None]
    xy = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    return xy.astype(np.float32), yaws.astype(np.float32)


@functools.lru_cache(maxsize=8)
def _reachable(
    sim: SimConfig, heightmap: HeightmapConfig, rotations: int, side: int, cell: float
) -> np.ndarray:
    """Computes the cells of the workspace where the robot can act, [P, K, h, w] bool."""
    xy, yaws = _cells(rotations, side, cell)
    if sim.robot == "hand":
        return np.ones((len(Primitive), *xy.shape[:3]), bool)
    inside = np.all(np.abs(xy) <= 0.5 * heightmap.extent, axis=-1)
    turned = np.broadcast_to(yaws[:, None, None, None], (*inside.shape, 1))
    poses = np.concatenate([xy, turned], axis=-1)[inside]
    rows = np.resize(poses, (-(-len(poses) // side), side, 3))  # the last one is filled up
    with jax.ensure_compile_time_eval():
        found = np.asarray(jax.jit(functools.partial(reach_of_rows, sim, heightmap))(rows))
    reach = np.zeros((*inside.shape, len(Primitive)), bool)
    reach[inside] = found.reshape(-1, len(Primitive))[: len(poses)]
    return np.moveaxis(reach, -1, 0)


def reach_of_rows(sim: SimConfig, heightmap: HeightmapConfig, poses: jax.Array) -> jax.Array:
    """Tells where the arm reaches both ends of an action, a row at a time: [R, w, P] bool.

    All at once take gigabytes. Args: poses [R, w, 3], x and y in m, yaw in rad.
    """
    reachable = functools.partial(primitives.reachable, sim, heightmap)
    return jax.lax.map(jax.vmap(lambda pose: reachable(pose[:2], pose[2])), poses)


@struct.dataclass
class DenseMaps:
    """Maps of one state. P = primitives, K = yaws; each [h, w] in its own frame."""

    q: jax.Array  # [P, K, h, w] float32, the critic's value
    logits: jax.Array  # [P, K, h, w] float32, the actor's
    valid: jax.Array  # [P, K, h, w] bool, see `actionable_cells`


def map_primitives(
    call: Callable[[jax.Array, DenseMaps], Any], state: DenseMaps, chosen: Sequence[Primitive]
) -> Any:
    """Calls `call(p, single)`, with the maps of p alone, for p of `chosen`: [len(chosen), ...]."""
    singles = jax.tree.map(lambda leaf: jnp.stack([leaf[p][None] for p in chosen]), state)
    return jax.vmap(call)(jnp.array(chosen, jnp.int32), singles)


def input_maps(frames: Frames, obs: Observation) -> jax.Array:
    """Builds the net's input maps [..., H, W, I] of an observation, in the workspace's frame."""
    target = obs.target if frames.shows_target else None
    return frames.networks.inputs(obs.colour, obs.height, target, obs.fingers)


def rotated_inputs(frames: Frames, obs: Observation, k: Any = slice(None)) -> jax.Array:
    """Rotates the net's input to frames `k` [F] of the first K / 2, by default all: [F, C, C, I].

    A net that sees how the hand fits gets the maps of `fit.everywhere`, in units of 10 mm.
    """
    rotated = rotate.rotate(frames.tables, input_maps(frames, obs), k)
    if not frames.sees_fit:
        return rotated
    gripper = grippers.load(frames.sim.gripper)
    fingers = gripper.fingers if obs.fingers is None else Fingers(*obs.fingers)
    heights = rotate.rotate(frames.tables, obs.height[..., None], k)[..., 0]
    least = primitives.grasp_depth(frames.sim, gripper), primitives.lowest(frames.sim, gripper)
    found = fit.everywhere(frames.tables.cell, heights, *least, gripper, fingers)
    return jnp.concatenate([rotated, FIT_SCALE * _computed_once(found)], axis=-1)


def _computed_once(maps: jax.Array) -> jax.Array:
    """Returns maps [F, C, C, ch] through a product by 1, which XLA computes apart from the rest.

    On a CPU it would else compute them again for each channel of what they are joined to.
    """
    if jax.default_backend() != "cpu":
        return maps
    one = jnp.eye(maps.shape[-1], dtype=maps.dtype)[None, None]
    return conv2d(maps, one, stride=1, dilation=1, padding=0)


def unfold(halves: jax.Array) -> jax.Array:
    """Returns net outputs of K / 2 frames [K / 2, h, w, OUTPUTS] for all K: [P, K, h, w]."""
    ahead, back, grasp = (halves[..., output] for output in range(dense.OUTPUTS))
    return jnp.stack([_all_frames(ahead, back), _all_frames(grasp, grasp)])


def _all_frames(ahead: jax.Array, back: jax.Array) -> jax.Array:
    """Joins two halves [K / 2, h, w]: frame k + K / 2 is frame k upside down; [K, h, w]."""
    return jnp.concatenate([ahead, back[..., ::-1, ::-1]])


def actionable_cells(frames: Frames, obs: Observation) -> jax.Array:
    """Returns cells where an action can have an effect, [P, K, h, w] bool; SPOT, arXiv:1909.11730.

    Grasp: a surface above BARE under the cell, in the target task the target's. Push: one within
    its length ahead. While nothing of a target is seen, any surface may be grasped. A tray's walls
    are none. With `policy.action_mask` none, every cell that the robot reaches.
    """
    allowed = frames.inside[None] & frames.reachable
    if frames.all_cells:
        return jnp.asarray(allowed)
    under, graspable = (cell_heights(frames, top) > BARE for top in surfaces(frames, obs))
    reach = int(np.ceil(frames.push_length / frames.cell))
    beside = _any_of(under, (1, 3, 1), (0, 1, 0))
    ahead = _any_of(beside, (1, 1, reach + 1), (0, 0, reach))
    return jnp.stack([ahead, graspable]) & allowed


def _any_of(maps: jax.Array, window: tuple[int, ...], after: tuple[int, ...]) -> jax.Array:
    """Tells of each cell whether any in its window holds, which ends `after` cells on."""
    padding = [(size - 1 - end, end) for size, end in zip(window, after, strict=True)]
    return jax.lax.reduce_window(maps, False, jnp.logical_or, window, (1, 1, 1), padding)


def surfaces(frames: Frames, obs: Observation) -> tuple[jax.Array, jax.Array]:
    """Returns the surfaces to push and to grasp, each [H, W] m; 0 where there is none."""
    walls, height = frames.walls, obs.height
    if walls.any():
        height = jnp.where((walls > 0.0) & (height <= walls + BARE), 0.0, height)
    if not frames.shows_target:
        return height, height
    return height, jnp.where(heightmap.wanted(obs.target), height, 0.0)


def cell_heights(frames: Frames, height: jax.Array) -> jax.Array:
    """Returns the highest point of the map [H, W] m under each cell, [K, h, w] m; 0 outside."""
    side, stride = frames.side, frames.networks.stride
    rotated = rotate.rotate(frames.tables, height[..., None])
    cells = rotated.reshape(-1, side, stride, side, stride).max(axis=(2, 4))  # [K / 2, h, w]
    return _all_frames(cells, cells)


def yaw_index(frames: Frames, yaw: jax.Array) -> jax.Array:
    """Returns the fractional frame index of yaws [...] rad, float32; whole at the frames' yaws."""
    return yaw * (frames.yaws.shape[0] / (2.0 * np.pi))


def read(frames: Frames, maps: jax.Array, primitive: jax.Array, pose: jax.Array) -> jax.Array:
    """Interpolates `maps` [P, K, h, w] at a pose [3] m, m, rad: []; differentiable in both."""
    num, side, index = frames.yaws.shape[0], frames.side, yaw_index(frames, pose[2])
    lower = rotate.floor(index)

    def at(k: jax.Array) -> jax.Array:
        k = jnp.mod(k, num)
        position = rotate.to_cell(side, frames.cell, jnp.asarray(frames.yaws)[k], pose[:2])
        row_col = jnp.clip(position, 0.0, side - 1.0)
        first_row = ((primitive * num + k) * side).astype(jnp.float32)
        offset = jnp.stack([first_row, jnp.zeros_like(first_row)])
        return rotate.bilinear(maps.reshape(-1, side), row_col + offset)

    below, above = jax.vmap(at)(lower.astype(jnp.int32) + np.arange(2, dtype=np.int32))
    upper_weight = index - lower
    return (1.0 - upper_weight) * below + upper_weight * above


def is_valid(frames: Frames, valid: jax.Array, primitive: jax.Array, pose: jax.Array) -> jax.Array:
    """Checks that the cell nearest to a pose [3] is valid, [] bool; `valid` [P, K, h, w]."""
    num, side = frames.yaws.shape[0], frames.side
    k = jnp.mod(jnp.round(yaw_index(frames, pose[2])).astype(jnp.int32), num)
    position = rotate.to_cell(side, frames.cell, jnp.asarray(frames.yaws)[k], pose[:2])
    row, col = jnp.clip(jnp.round(position), 0.0, side - 1.0).astype(jnp.int32)
    return valid[primitive, k, row, col]


def read_valid(
    frames: Frames, state: DenseMaps, primitive: jax.Array | int, pose: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Reads Q [] at a pose [3], and if its nearest cell is valid, [] bool."""
    which = jnp.int32(primitive)
    return read(frames, state.q, which, pose), is_valid(frames, state.valid, which, pose)


def best_over_yaws(frames: Frames, state: DenseMaps, places: jax.Array) -> jax.Array:
    """Returns the largest valid Q over yaws [P, H, W] at `places` [H, W, 2] m, else -inf."""

    def best(primitive: jax.Array, place: jax.Array) -> jax.Array:
        poses = jax.vmap(jnp.append, (None, 0))(place, jnp.asarray(frames.yaws))
        values, valid = jax.vmap(lambda pose: read_valid(frames, state, primitive, pose))(poses)
        return jnp.max(jnp.where(valid, values, -jnp.inf))

    primitives = jnp.arange(len(Primitive))[:, None, None]
    return jnp.vectorize(best, signature="(),(n)->()")(primitives, places[None])


def best_cells(values: jax.Array, valid: jax.Array, num: int) -> jax.Array:
    """Returns flat indices [num] int32 into [K, h, w] of the largest (valid) values."""
    masked = jnp.where(valid | ~jnp.any(valid), values, -jnp.inf)
    return jax.lax.top_k(masked.reshape(-1), num)[1].astype(jnp.int32)


def cell_pose(frames: Frames, index: jax.Array) -> jax.Array:
    """Returns the pose [3] (m, m, rad) of the cell of flat index [] into [K, h, w]."""
    xy = jnp.asarray(frames.xy).reshape(-1, 2)[index]
    return jnp.append(xy, jnp.asarray(frames.yaws)[index // frames.side**2])


def cell_point(frames: Frames, index: jax.Array) -> jax.Array:
    """Returns `cell_pose` in the box, [3]."""
    return normalise(frames, cell_pose(frames, index))


def normalise(frames: Frames, pose: jax.Array) -> jax.Array:
    """Maps a pose [3] (m, m, rad) to the box [-1, 1]^3."""
    return box.project(jnp.append(pose[:2] / (0.5 * frames.extent), pose[2] / np.pi - 1.0))


def denormalise(frames: Frames, u: jax.Array) -> jax.Array:
    """Maps a point of the box [-1, 1]^3 to a pose [3] (m, m, rad in [0, 2 pi))."""
    return jnp.append(u[:2] * (0.5 * frames.extent), geometry.wrap_angle((u[2] + 1.0) * np.pi))
