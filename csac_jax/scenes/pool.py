"""The scenes that an environment draws from: packed arrangements, and blocks that were dropped.

C MuJoCo settles dropped blocks on all cores, bit-identical for any number of threads. Scenes are
cached on disk; those of the presets `quick` and `fast` come with the package. `stream` numbers the
stream of random numbers.
"""

import contextlib
import dataclasses
import functools
import hashlib
import logging
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from csac_jax import cache_folder
from csac_jax.assets import assets
from csac_jax.config import Config, SceneConfig, SlotKind
from csac_jax.errors import SceneError
from csac_jax.scenes import arrange, cases, certify, constructions, packings
from csac_jax.section import require
from csac_jax.world import blocks, model, object_slots, scene_state
from csac_jax.world.model import BlockFields, World
from csac_jax.world.scene_state import SceneState

TRAIN_STREAM = 0  # evaluation takes others
_VERSION = 6  # raise when the meaning of a cached pool changes
_SPACING = 0.13  # m between the centres of blocks as they are dropped: none touch
_ROUND = 128  # scenes dropped per round
_MOST_DROPPED = 12  # blocks that drop all at once: of 20, hardly any stay in the workspace
_PAUSE = 0.2  # s between blocks that are poured: a fall from drop_height takes 0.17 s
_PIN_EVERY = 10  # steps after which blocks that wait to be poured are put back
_DRAWS = 20  # of objects, for which there must be room side by side
_LOGGED_EVERY = 10.0  # s between log lines while scenes settle
_MAX_PAUSES = 3  # per block, until pouring a scene is given up; for a few, 2 and the settling

_LOG = logging.getLogger(__name__)

Fall = Callable[[SceneState, BlockFields], SceneState | None]


def scenes(cfg: Config, stream: int, count: int | None = None) -> SceneState:
    """Returns at least `count` scenes at rest, as many of each number of blocks, [P, N, ...].

    The last `scene.packed_fraction` of them are arrangements of the blocks, without the objects; or
    of objects alone, side by side in the largest square of `scene.drop_extent`. Without a count,
    `scene.pool` of each number of blocks. With `scene.certified` all certified scenes for training
    of these suites, whatever the count; or of TRAIN_STREAM the last `scene.certified_fraction`, of
    other streams none.
    Raises SceneError for blocks that do not come to rest or allow no arrangement.
    """
    block_counts = 1 + len(cfg.scene.slots) - cfg.scene.min_blocks
    number = cfg.scene.pool if count is None else -(-count // block_counts)
    if not cfg.scene.certified:
        return _uncertified(cfg, stream, number)
    if not cfg.scene.mixes_certified:
        return _certified(cfg.scene)
    share = cfg.scene.certified_fraction if stream == TRAIN_STREAM else 0.0
    certified = min(round(share * number), number - 1)
    others = _flagged(_uncertified(cfg, stream, number - certified), False)
    known, wanted = _certified(cfg.scene), certified * block_counts
    rows = np.arange(wanted) * len(known.target) // max(wanted, 1)
    some = _flagged(jax.tree.map(lambda leaf: leaf[rows], known), True)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), others, some)


def _flagged(scenes: SceneState, certified: bool) -> SceneState:
    return scenes.replace(certified=np.full(len(scenes.target), certified))


def _uncertified(cfg: Config, stream: int, number: int) -> SceneState:
    """Returns dropped and packed scenes, `number` of each number of blocks."""
    block_counts = 1 + len(cfg.scene.slots) - cfg.scene.min_blocks
    arranged = round(cfg.scene.packed_fraction * number)
    parts = [settled(cfg, stream, number - arranged)] if arranged < number else []
    if arranged and set(cfg.scene.slots) == {"object"}:
        widest = cfg.change(scene={"drop_extent": (cfg.scene.drop_extent[1],) * 2})
        parts.append(settled(widest, stream, arranged, packed=True))
    elif arranged:
        parts.append(_arranged(cfg, stream, arranged * block_counts))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def _arranged(cfg: Config, stream: int, count: int) -> SceneState:
    """Returns packed arrangements of the blocks, [count, N, ...], the objects parked."""
    slots, least = cfg.scene.slots, cfg.scene.min_blocks
    alone: tuple[SlotKind, ...] = tuple(kind for kind in slots if kind != "object")
    if alone != slots:
        own = {"slots": alone, "min_blocks": min(least, len(alone)), "objects": ""}
        cfg = cfg.change(scene=own)
    drawn = (cfg.scene, cfg.heightmap.extent, stream, count)
    name = _digest(cfg, stream, count, "arranged")
    scenes = _stored(name, lambda: arrange.arrangements(*drawn))
    return scenes if alone == slots else _stack(_seated("packed", alone, scenes, slots))


def _seated(
    name: str, own: tuple[SlotKind, ...], scenes: SceneState, slots: tuple[SlotKind, ...]
) -> list[SceneState]:
    """Moves scenes [P, N, ...] with slots of their own to other ones, see `cases.seat`."""
    rows = [jax.tree.map(lambda leaf, i=i: leaf[i], scenes) for i in range(len(scenes.target))]
    return [cases.seat(cases.Case(name, own, row), slots) for row in rows]


def _certified(cfg: SceneConfig) -> SceneState:
    """Returns the certified scenes for training of the suites, [P, N, ...], in the config's slots.

    Raises SettingsError where slots or tray do not fit.
    """
    seated = []
    for name in cfg.certified:
        suite = constructions.SUITES[name]
        require(suite.tray == cfg.tray, f"scene.tray: scenes of {name} need {suite.tray:g}")
        scenes = certify.load(certify.shipped(f"{name}-train")).scenes
        seated += _seated(name, suite.slots, scenes, cfg.slots)
    return _stack(seated)


def settled(
    cfg: Config,
    stream: int,
    count: int,
    poured: bool = False,
    packed: bool = False,
    sides: tuple[float, float] = object_slots.ANY_SIDE,
) -> SceneState:
    """Returns `count` distinct settled scenes for each number of blocks from `min_blocks` to N.

    NumPy leaves [P, N, ...], fewest blocks first; the same on every machine of one kind. Centres of
    blocks in play lie within extent / 2 of the workspace's, so a scene can be rotated by any yaw.
    Up to 12 blocks drop all at once. More, or all if `poured`, drop one after another; one that
    rolls off drops again. If `packed`, objects stand on the table, see `object_slots.packed`. Of a
    library, objects are drawn whose middle side lies in the range `sides`, m.
    Raises SceneError where hardly any scene comes to rest.
    """
    scene = dataclasses.replace(cfg.scene, packed_fraction=0.0)

    def settle() -> SceneState:
        world = model.build(scene, dataclasses.replace(cfg.sim, robot="hand", gripper="rg2"))
        rng = np.random.default_rng([stream, 20221])
        numbers = range(scene.min_blocks, len(scene.slots) + 1)
        done: list[SceneState] = []
        logged_at = time.monotonic()
        for number in numbers:
            drop = functools.partial(_stand if packed else _drop, scene, rng, number, sides)
            pouring = poured or (number > _MOST_DROPPED and not packed)
            fall = functools.partial(pour if pouring else rest, world, cfg)
            for fallen in _settle(world, drop, fall, count, costly=pouring or packed):
                done.append(fallen)
                if time.monotonic() - logged_at >= _LOGGED_EVERY:
                    logged_at = time.monotonic()
                    _LOG.info("settling scenes: %d of %d", len(done), count * len(numbers))
        return _stack(done)

    how = ["poured"] * poured + ["packed"] * packed
    how += [f"sides {sides}"] * (sides != object_slots.ANY_SIDE)
    if len(scene.slots) > _MOST_DROPPED and not (poured or packed):
        how = [f"poured above {_MOST_DROPPED}"]
    return _stored(_digest(cfg, stream, count, *how), settle)


def _stored(digest: str, make: Callable[[], SceneState]) -> SceneState:
    """Returns the scenes of that digest: shipped, cached, or made now and cached."""
    name, cache = f"{digest}.npz", cache_folder.private("pools")
    for folder in (shipped(), cache):
        if folder and (stored := _read(folder / name)) is not None:
            return stored
    with contextlib.ExitStack() as stack:
        # A GPU adds a block's parts in any order: scenes would differ between processes.
        with contextlib.suppress(RuntimeError):  # JAX_PLATFORMS names no CPU
            stack.enter_context(jax.default_device(jax.local_devices(backend="cpu")[0]))
        made = make()
    if cache:
        _write(cache / name, made)
    return made


def _settle(
    world: World, drop: Callable[[], SceneState], fall: Fall, count: int, costly: bool
) -> Iterator[SceneState]:
    """Yields `count` scenes that are at rest after their fall."""
    fields_of = jax.vmap(functools.partial(model.scene_fields, world))
    missing, dropped = count, 0
    while missing:
        num = min(_ROUND, missing) if costly else _ROUND  # a round of piles takes minutes
        drops = [drop() for _ in range(num)]
        fields = jax.device_get(fields_of(_stack(drops)))
        rows = [jax.tree.map(lambda leaf, i=i: leaf[i], fields) for i in range(num)]
        for scene in _first_at_rest(fall, drops, rows, missing):
            missing -= 1
            yield scene
        dropped += num
        if dropped >= 20 * _ROUND and count - missing < dropped / 50:
            settled = f"only {count - missing} of {dropped} dropped scenes came to rest"
            remedy = "lower scene.min_blocks or scene.drop_extent, or raise scene.settle_time"
            raise SceneError(f"{settled} in the workspace; {remedy}")


def _first_at_rest(fall: Fall, drops: list, fields: list, count: int) -> Iterator[SceneState]:
    """Yields the first `count` of these scenes that come to rest; few others fall."""
    with ThreadPoolExecutor() as threads:
        while drops and count:
            some = max(count, len(os.sched_getaffinity(0)))
            for scene in threads.map(fall, drops[:some], fields[:some]):
                if scene is not None and count:
                    count -= 1
                    yield scene
            drops, fields = drops[some:], fields[some:]


def _stack(scenes: list[SceneState]) -> SceneState:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *scenes)


def _drop(
    cfg: SceneConfig,
    rng: np.random.Generator,
    count: int,
    sides: tuple[float, float] = object_slots.ANY_SIDE,
) -> SceneState:
    """Draws a scene of `count` blocks before they fall, one above the other as in VPG."""
    num, num_colours = len(cfg.slots), len(blocks.COLOURS)
    in_play = rng.permutation(num) < count
    quaternion = rng.normal(size=(num, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    spacing = max(_SPACING, 2.0 * object_slots.table(cfg).radius) if cfg.has_objects else _SPACING
    half = 0.5 * rng.uniform(*cfg.drop_extent)
    xy = rng.uniform(-half, half, (num, 2))
    z = cfg.drop_height + spacing * rng.permutation(num)[:, None]
    position = np.where(in_play[:, None], np.concatenate([xy, z], axis=1), scene_state.parking(num))
    scale = blocks.scales(cfg, rng.uniform(-1.0, 1.0, num))[:, None]
    shapes = map(blocks.half_size_choices, cfg.slots)
    half_size = np.stack([choices[rng.integers(len(choices))] for choices in shapes]) * scale
    dropped = scene_state.parked(cfg.slots).replace(
        position=position.astype(np.float32),
        quaternion=quaternion.astype(np.float32),
        half_size=half_size.astype(np.float32),
        density=rng.uniform(*cfg.density, num).astype(np.float32),
        friction=rng.uniform(*cfg.friction, num).astype(np.float32),
        colour=rng.permutation(max(num, num_colours))[:num].astype(np.int32) % num_colours,
        in_play=in_play,
    )
    return object_slots.drawn(rng, cfg, dropped, sides) if cfg.has_objects else dropped


def _stand(
    cfg: SceneConfig, rng: np.random.Generator, count: int, sides: tuple[float, float]
) -> SceneState:
    """Draws a scene of `count` objects that stand side by side; again where there is no room."""
    for _ in range(_DRAWS - 1):
        with contextlib.suppress(SceneError):
            return object_slots.packed(rng, cfg, _drop(cfg, rng, count, sides))
    return object_slots.packed(rng, cfg, _drop(cfg, rng, count, sides))


def _falling(world: World, scene: SceneState, fields: BlockFields) -> mujoco.MjData:
    exact = model.with_blocks(world, fields)
    exact.opt.iterations, exact.opt.ls_iterations = 20, 20  # quality over speed: this runs once
    # Pools of objects, in caches and digests, were settled with friction pyramids.
    exact.opt.cone, exact.opt.impratio = mujoco.mjtCone.mjCONE_PYRAMIDAL, 1.0
    exact.opt.timestep = 0.5 * world.model.opt.timestep
    data = mujoco.MjData(exact)
    data.qpos[world.robot_qpos[2]] = data.ctrl[2] = model.HAND_PARK_HEIGHT
    data.qpos[world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
    return data


def rest(world: World, cfg: Config, scene: SceneState, fields: BlockFields) -> SceneState | None:
    """Drops all blocks; None if one is not at rest then or left the workspace."""
    data = _falling(world, scene, fields)
    data.model.body_gravcomp[world.block_bodies[~scene.in_play]] = 1.0
    mujoco.mj_step(data.model, data, nstep=round(cfg.scene.settle_time / data.model.opt.timestep))
    return _rested(world, cfg, scene, data)


def pour(world: World, cfg: Config, scene: SceneState, fields: BlockFields) -> SceneState | None:
    """Drops blocks one after another, lowest first; those that roll off, again. See `rest`."""
    data = _falling(world, scene, fields)
    num, pause = len(scene.in_play), round(_PAUSE / data.model.opt.timestep)
    waiting = [int(slot) for slot in np.argsort(scene.position[:, 2]) if scene.in_play[slot]]
    rng = np.random.default_rng(np.abs(scene.position * 1e6).astype(np.uint64).ravel())
    half = 0.5 * rng.uniform(*cfg.scene.drop_extent)
    pinned = np.ones(num, bool)  # waiting in the air
    places, quiet, still = scene_state.parking(num), 0.0, round(cfg.scene.settle_time / _PAUSE)
    for _ in range(max(_MAX_PAUSES * len(waiting), 2 * len(waiting) + still)):
        if waiting:
            slot = waiting.pop(0)
            top = data.qpos[world.block_qpos[~pinned, 2]].max(initial=0.0)
            pinned[slot], quiet = False, 0.0
            xy = rng.uniform(-half, half, 2)
            data.qpos[world.block_qpos[slot, :3]] = [*xy, top + cfg.scene.drop_height]
            data.qvel[world.block_dofs[slot]] = 0.0
        for _ in range(0, pause, _PIN_EVERY):
            data.qpos[world.block_qpos[pinned, :3]] = places[pinned]
            data.qvel[world.block_dofs[pinned]] = 0.0
            mujoco.mj_step(data.model, data, nstep=_PIN_EVERY)
        quiet += _PAUSE
        outside = ~pinned & ~_inside(cfg, data.qpos[world.block_qpos[:, :2]])
        waiting += [int(slot) for slot in np.flatnonzero(outside)]
        pinned |= outside
        if not waiting and quiet >= cfg.scene.settle_time:
            return _rested(world, cfg, scene, data)
    return None


def _rested(world: World, cfg: Config, scene: SceneState, data: mujoco.MjData) -> SceneState | None:
    pose = data.qpos[world.block_qpos].astype(np.float32)
    position, quaternion = pose[:, :3], pose[:, 3:]
    speed = np.abs(data.qvel[world.block_dofs]) * [1, 1, 1, 0.03, 0.03, 0.03]
    ok = _inside(cfg, position[:, :2])
    ok &= (speed.max(axis=1) < scene_state.STILL) & (position[:, 2] > 0.0)
    ok &= np.isfinite(pose).all(axis=1)
    if not np.all(ok | ~scene.in_play):
        return None
    in_play, upright = scene.in_play[:, None], np.array([1, 0, 0, 0], np.float32)
    position = np.where(in_play, position, scene.position)
    return scene.replace(position=position, quaternion=np.where(in_play, quaternion, upright))


def _inside(cfg: Config, xy: np.ndarray) -> np.ndarray:
    """Tests which places [N, 2] m lie in the tray, or in the workspace at any yaw; [N] bool."""
    if cfg.scene.tray:
        return np.abs(xy).max(axis=1) <= 0.5 * cfg.scene.tray
    return np.hypot(xy[:, 0], xy[:, 1]) <= 0.5 * cfg.heightmap.extent


def shipped() -> Path:
    """Returns the folder of pools that come with the package; `experiments.pools` makes them."""
    return assets() / "pools"


def _digest(cfg: Config, stream: int, count: int, *how: str) -> str:
    """Hashes all that decides the content of a pool; `how` names the way to make it."""
    scene = dataclasses.replace(cfg.scene, packed_fraction=0.0)
    numbers = (float(cfg.heightmap.extent), stream, count, cfg.sim.timestep)
    if scene.has_objects:  # the content of a library counts, not its place
        scene = dataclasses.replace(scene, objects=object_slots.library(scene).sha256)
    drawn = {name: value for name, value in vars(scene).items() if not name.startswith("certified")}
    settings = repr((_VERSION, mujoco.__version__, drawn, *numbers, *how))
    content = hashlib.sha256(settings.encode())
    code = [arrange.__file__, packings.__file__] if "arranged" in how else []
    for path in ("table.xml", "grippers/rg2/gripper.xml", "blocks.xml", *code):
        content.update((assets() / path).read_bytes())  # an absolute path replaces the folder
    return content.hexdigest()[:32]


def _read(path: Path) -> SceneState | None:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files if name != "sha256"}
            return SceneState(**arrays) if file.zip.testzip() is None else None
    except Exception:  # a damaged archive raises nearly anything, from BadZipFile to KeyError
        return None


def _write(path: Path, scenes: SceneState) -> None:
    arrays: dict[str, Any] = {k: leaf for k, leaf in vars(scenes).items() if leaf is not None}
    temporary = path.with_name(f"{path.stem}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            np.savez(file, **arrays)
        temporary.replace(path)
    except OSError:  # the next run settles them again
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
