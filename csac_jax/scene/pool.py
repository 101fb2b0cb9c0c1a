"""A pool of settled scenes: blocks that were dropped and came to rest.

C MuJoCo settles on all cores, bit-identical for any number of threads. Pools are cached on disk.
"""

import concurrent.futures
import dataclasses
import functools
import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from csac_jax.config import SceneConfig
from csac_jax.errors import SceneError
from csac_jax.scene import blocks, layout
from csac_jax.scene.layout import Scene
from csac_jax.scene.model import (
    HAND_PARK_HEIGHT,
    BlockFields,
    World,
    assets,
    scene_fields,
    with_blocks,
)

TRAIN_STREAM = 0  # stream of random numbers of the training pool; evaluation takes 1 + its seed
_VERSION = 5  # raise when the meaning of a cached pool changes
_SPACING = 0.13  # m between the centres of blocks as they are dropped: none touch
_STILL = 0.008  # m/s: slower counts as at rest
_ROUND = 128  # scenes dropped per round
_PAUSE = 0.2  # s between blocks that are poured: a fall from drop_height takes 0.17 s
_PIN_EVERY = 10  # steps after which blocks that wait to be poured are put back
_MAX_PAUSES = 3  # per block, until pouring a scene is given up


def settled(
    world: World, cfg: SceneConfig, extent: float, stream: int, count: int, poured: bool = False
) -> Scene:
    """`count` distinct settled scenes for each number of blocks from `min_blocks` to N.

    Every block in play is at rest, its centre within extent / 2 of the workspace centre, so a scene
    can be rotated by any yaw. `world` has the floating hand, which waits high above. Blocks drop
    all at once, stacked in the air. `poured` drops them one after another, from `drop_height` above
    the pile; a block that rolls off the workspace drops again.

    Returns: NumPy leaves [P, N, ...], fewest blocks first; the same for the same arguments on every
    machine of one kind. Raises SceneError where hardly any scene comes to rest.
    """
    path = _cache_folder() / f"{_digest(world, cfg, extent, stream, count, poured)}.npz"
    cached = _read(path)
    if cached is not None:
        return cached
    rng = np.random.default_rng([stream, 20221])
    block_counts = range(cfg.min_blocks, len(cfg.slots) + 1)
    parts = [_settle(world, cfg, extent, rng, num, count, poured) for num in block_counts]
    scenes = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    _write(path, scenes)
    return scenes


def _settle(
    world: World,
    cfg: SceneConfig,
    extent: float,
    rng: np.random.Generator,
    num_blocks: int,
    count: int,
    poured: bool,
) -> Scene:
    """`count` settled scenes of `num_blocks` blocks."""
    fall = functools.partial(pour if poured else rest, world, cfg, extent)
    fields_of = jax.vmap(functools.partial(scene_fields, world))
    settled: list[Scene] = []
    dropped = 0
    with concurrent.futures.ThreadPoolExecutor() as threads:
        while len(settled) < count:
            # A round of piles takes minutes, so it is no larger than needed.
            num = min(_ROUND, count - len(settled)) if poured else _ROUND
            drops = [_drop(cfg, rng, num_blocks) for _ in range(num)]
            fields = jax.device_get(fields_of(_stack(drops)))
            rows = [jax.tree.map(lambda leaf, i=i: leaf[i], fields) for i in range(num)]
            settled += [scene for scene in threads.map(fall, drops, rows) if scene is not None]
            dropped += num
            if dropped >= 20 * _ROUND and len(settled) < dropped / 50:
                raise SceneError(
                    f"only {len(settled)} of {dropped} dropped scenes came to rest inside the "
                    "workspace; lower scene.min_blocks or scene.drop_extent, or raise "
                    "scene.settle_time"
                )
    return _stack(settled[:count])


def _stack(scenes: list[Scene]) -> Scene:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *scenes)


def _drop(cfg: SceneConfig, rng: np.random.Generator, count: int) -> Scene:
    """A random scene of `count` blocks before they fall, one above the other as in VPG."""
    num = len(cfg.slots)
    in_play = rng.permutation(num) < count
    quaternion = rng.normal(size=(num, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    half = 0.5 * rng.uniform(*cfg.drop_extent)
    xy = rng.uniform(-half, half, (num, 2))
    z = cfg.drop_height + _SPACING * rng.permutation(num)[:, None]
    position = np.where(in_play[:, None], np.concatenate([xy, z], axis=1), layout.parking(num))
    num_colours = len(blocks.COLOURS)
    leaves: dict[str, Any] = {
        "position": position.astype(np.float32),
        "quaternion": quaternion.astype(np.float32),
        "velocity": np.zeros((num, 6), np.float32),
        "half_size": _half_sizes(cfg, rng),
        "density": rng.uniform(*cfg.density, num).astype(np.float32),
        "friction": rng.uniform(*cfg.friction, num).astype(np.float32),
        "colour": rng.permutation(max(num, num_colours))[:num].astype(np.int32) % num_colours,
        "in_play": in_play,
        "target": np.int32(layout.ANY),
    }
    return Scene(**leaves)


def _half_sizes(cfg: SceneConfig, rng: np.random.Generator) -> np.ndarray:
    """Half sizes [N, 3] m of random shapes and scales; mesh blocks of one kind are alike."""
    choices = [blocks.half_size_choices(kind) for kind in cfg.slots]
    scales = 1.0 + blocks.size_jitter(cfg) * rng.uniform(-1.0, 1.0, len(cfg.slots))
    sizes = np.stack([kind[rng.integers(len(kind))] for kind in choices])
    return (sizes * scales[blocks.size_leader(cfg.slots)][:, None]).astype(np.float32)


def _falling(
    world: World, scene: Scene, fields: BlockFields
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The scene's blocks where they are, the hand high above."""
    model = with_blocks(world, fields)
    model.opt.iterations, model.opt.ls_iterations = 20, 20  # quality over speed: this runs once
    model.opt.timestep = 0.5 * world.model.opt.timestep
    data = mujoco.MjData(model)
    data.qpos[world.robot_qpos] = [0.0, 0.0, HAND_PARK_HEIGHT, 0.0, 0.0, 0.0]
    data.ctrl[:] = [0.0, 0.0, HAND_PARK_HEIGHT, 0.0, 0.0]
    data.qpos[world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
    return model, data


def rest(
    world: World, cfg: SceneConfig, extent: float, scene: Scene, fields: BlockFields
) -> Scene | None:
    """The scene after its blocks fell; None if one is not at rest or left the workspace."""
    model, data = _falling(world, scene, fields)
    model.body_gravcomp[world.block_bodies[~scene.in_play]] = 1.0
    mujoco.mj_step(model, data, nstep=round(cfg.settle_time / model.opt.timestep))
    return _at_rest(world, extent, scene, data)


def pour(
    world: World, cfg: SceneConfig, extent: float, scene: Scene, fields: BlockFields
) -> Scene | None:
    """As `rest`, but blocks drop one after another, lowest first; those that roll off, again."""
    model, data = _falling(world, scene, fields)
    num, pause = len(scene.in_play), round(_PAUSE / model.opt.timestep)
    waiting = [int(slot) for slot in np.argsort(scene.position[:, 2]) if scene.in_play[slot]]
    rng = np.random.default_rng(np.abs(scene.position * 1e6).astype(np.uint64).ravel())
    half = 0.5 * rng.uniform(*cfg.drop_extent)
    pinned = np.ones(num, bool)  # waiting in the air
    places, quiet = layout.parking(num), 0.0

    for _ in range(_MAX_PAUSES * len(waiting)):
        if waiting:
            slot = waiting.pop(0)
            top = data.qpos[world.block_qpos[~pinned, 2]].max(initial=0.0)
            pinned[slot], quiet = False, 0.0
            xy = rng.uniform(-half, half, 2)
            data.qpos[world.block_qpos[slot, :3]] = [*xy, top + cfg.drop_height]
            data.qvel[world.block_dofs[slot]] = 0.0
        for _ in range(0, pause, _PIN_EVERY):
            data.qpos[world.block_qpos[pinned, :3]] = places[pinned]
            data.qvel[world.block_dofs[pinned]] = 0.0
            mujoco.mj_step(model, data, nstep=_PIN_EVERY)
        quiet += _PAUSE
        radius = np.linalg.norm(data.qpos[world.block_qpos[:, :2]], axis=1)
        outside = ~pinned & (radius > 0.5 * extent)
        waiting += [int(slot) for slot in np.flatnonzero(outside)]
        pinned |= outside
        if not waiting and quiet >= cfg.settle_time:
            return _at_rest(world, extent, scene, data)
    return None


def _at_rest(world: World, extent: float, scene: Scene, data: mujoco.MjData) -> Scene | None:
    """The scene as its blocks lie now; None if one is not at rest or left the workspace."""
    parked = ~scene.in_play
    pose = data.qpos[world.block_qpos].astype(np.float32)
    position, quaternion = pose[:, :3], pose[:, 3:]
    speed = np.abs(data.qvel[world.block_dofs]) * [1, 1, 1, 0.03, 0.03, 0.03]
    ok = np.hypot(position[:, 0], position[:, 1]) <= 0.5 * extent
    ok &= (speed.max(axis=1) < _STILL) & (position[:, 2] > 0.0) & np.isfinite(pose).all(axis=1)
    if not np.all(ok | parked):
        return None
    upright = np.array([1, 0, 0, 0], np.float32)
    pose_now: dict[str, Any] = {
        "position": np.where(parked[:, None], scene.position, position),
        "quaternion": np.where(parked[:, None], upright, quaternion),
    }
    return dataclasses.replace(scene, **pose_now)


def _cache_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "csac_jax" / "pools"


def _digest(
    world: World, cfg: SceneConfig, extent: float, stream: int, count: int, poured: bool
) -> str:
    """Name of a pool: hash of everything that decides its content."""
    versions = (_VERSION, mujoco.__version__)
    relevant = (*versions, repr(cfg), float(extent), stream, count, world.model.opt.timestep)
    content = hashlib.sha256(repr((*relevant, "poured") if poured else relevant).encode())
    for name in ("table.xml", "hand.xml", "blocks.xml"):
        content.update((assets() / name).read_bytes())
    return content.hexdigest()[:32]


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    content = (np.ascontiguousarray(arrays[name]).tobytes() for name in sorted(arrays))
    return hashlib.sha256(b"".join(content)).hexdigest()


def _read(path: Path) -> Scene | None:
    """The cached scenes; None if there are none or they are damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        if str(arrays.pop("sha256")) != _checksum(arrays):
            return None
        return Scene(**arrays)
    except Exception:  # a damaged archive raises nearly anything, from BadZipFile to KeyError
        return None


def _write(path: Path, scenes: Scene) -> None:
    """Saves the scenes for the next run; a cache that cannot be written is no error."""
    arrays: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in vars(scenes).items()}
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".npz", delete=False) as file:
            np.savez(file, sha256=_checksum(arrays), **arrays)
        os.replace(file.name, path)
    except OSError:
        return
