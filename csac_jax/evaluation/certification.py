"""The search for certificates: does a scene need a push before a grasp lifts?

A scene is kept if hardly any grasp of a grid lifts a wanted block, and if a push is found after
which many do. C MuJoCo's certificate counts; Warp only tells which scenes are worth it.
"""

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from csac_jax.baselines import planner, trials
from csac_jax.config import Config
from csac_jax.constants import Primitive
from csac_jax.robot.primitives import Action
from csac_jax.runtime import provenance
from csac_jax.scenes.certify import Certificate
from csac_jax.world import scene_state
from csac_jax.world.scene_state import SceneState

GRID = 0.012  # m between grasps
YAWS = 8  # over half a turn
MOST_BEFORE = 0.01  # share of grasps that may lift before a push
LEAST_AFTER = 0.10  # share of grasps that must lift after it
PUSHES = 64
GRASPS_AFTER = 100  # each push, of the grid
TASTE = 16  # of them; the push is given up if none of these lifts (ours)
_ROWS = {"warp": 2048}  # actions in a batch; else
_FEW = 32  # C MuJoCo gains nothing by more
_VERSION = 2  # raise when the meaning of a certificate changes


class Lab(NamedTuple):
    """Compiled programs of a config and the size of their batches. K = actions."""

    cfg: Config
    height: Any  # scene [N, ...] -> [H, W] m
    trial: Any  # scenes, heights and actions [K, ...] -> wanted lifted [K], lost [K], scenes
    rows: int  # K


@functools.lru_cache(maxsize=2)
def make_lab(cfg: Config) -> Lab:
    """Makes the programs that candidates of a config are judged by, on its physics."""
    physics = planner.make_physics(cfg)

    def trial(scene: SceneState, height: jax.Array, action: Action) -> tuple:
        gripped = scene_state.with_grip(jax.random.key(0), scene, cfg.sim)
        tried = trials.trial(cfg, physics, gripped, height, action)
        wanted = jnp.any(tried.lifted & scene_state.is_target(scene))
        return wanted, jnp.any(tried.lost), tried.scene.replace(grip=scene.grip)

    height = jax.jit(functools.partial(trials.height_map, cfg))
    return Lab(cfg, height, jax.jit(jax.vmap(trial)), _ROWS.get(cfg.sim.physics, _FEW))


def settings(cfg: Config) -> str:
    """Describes all that a certificate's numbers depend on, but the scene."""
    world = planner.make_physics(cfg).world.digest
    search = (GRID, YAWS, MOST_BEFORE, LEAST_AFTER, PUSHES, GRASPS_AFTER, TASTE)
    view = (cfg.heightmap.size, cfg.heightmap.extent, cfg.heightmap.view)
    grip = (cfg.sim.pad_friction, cfg.sim.grip_force)
    return repr((_VERSION, provenance.versions().get("mujoco"), world, view, grip, search))


def judge(lab: Lab, scene: SceneState, generator: str, seed: int) -> Certificate:
    """Judges one candidate, NumPy leaves [N, ...]; the same seed gives the same certificate."""
    rng, scene = np.random.default_rng([seed, 640]), jax.tree.map(np.asarray, scene)
    grasps = grid(rng, scene)
    lifts, tried = 0, 0
    for lifted, _, _ in _batches(lab, [(scene, grasps)]):
        lifts, tried = lifts + int(lifted.sum()), tried + lifted.size
        if lifts > MOST_BEFORE * len(grasps):
            return Certificate(generator, seed, lifts / len(grasps), 0.0, -1)
    before, best = lifts / max(tried, 1), 0.0
    pushes = planner.sample_pushes(jax.random.key(seed), lab.cfg, scene, PUSHES)
    results = list(_batches(lab, [(scene, np.asarray(pushes.pose))], Primitive.PUSH))
    lost = np.concatenate([part[1] for part in results])
    pushed = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(part[2] for part in results))
    sound = np.flatnonzero(~lost & pushed.in_play.any(axis=1))
    sound = sound[np.argsort(-_spread(scene, pushed)[sound], kind="stable")]
    together = max(1, lab.rows // TASTE)
    for some in np.split(sound, np.arange(together, len(sound), together)):
        scenes = [jax.tree.map(lambda leaf, i=i: leaf[i], pushed) for i in some]
        for push, share in zip(some, _shares(lab, rng, scenes), strict=True):
            if share >= LEAST_AFTER:
                return Certificate(generator, seed, before, share, int(push))
            best = max(best, share)
    return Certificate(generator, seed, before, best, -1)


def _spread(scene: SceneState, pushed: SceneState) -> np.ndarray:
    """Returns how far blocks move from each other by each push, [K] m; the best come first so."""
    moved = (pushed.position - scene.position)[:, scene.in_play]
    return np.linalg.norm(moved - moved.mean(axis=1, keepdims=True), axis=2).sum(axis=1)


def _shares(lab: Lab, rng: np.random.Generator, scenes: list[SceneState]) -> list[float]:
    """Returns the shares of random grasps that lift a wanted block of each scene."""
    grasps = [grid(rng, scene)[:GRASPS_AFTER] for scene in scenes]
    counts = np.zeros(len(scenes), int)
    for part in (slice(0, TASTE), slice(TASTE, None)):
        poses = [
            g[part] if n or not part.start else g[:0] for g, n in zip(grasps, counts, strict=True)
        ]
        lifted = [one[0] for one in _batches(lab, list(zip(scenes, poses, strict=True)))]
        owner = np.repeat(np.arange(len(scenes)), [len(some) for some in poses])
        counts = counts + np.bincount(owner, np.concatenate([*lifted, []]), len(scenes)).astype(int)
    return [int(n) / len(poses) for n, poses in zip(counts, grasps, strict=True)]


def grid(rng: np.random.Generator, scene: SceneState) -> np.ndarray:
    """Returns all grasps [n, 3] m, m, rad of the area of the wanted blocks, in random order.

    A target's area is wider by GRID on all sides: a finger may fit there alone.
    """
    has_target = scene.target != scene_state.ANY
    wanted = np.flatnonzero(scene.in_play & np.asarray(scene_state.is_target(scene)))
    reach = np.linalg.norm(scene.half_size, axis=1)[wanted, None] + GRID
    middle = scene.position[wanted, :2]
    low, high = (middle - reach).min(axis=0), (middle + reach).max(axis=0)
    axes = [np.arange(start, end, GRID) for start, end in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    inside = np.zeros(len(places), bool)
    for slot in wanted:
        turn = Rotation.from_quat(scene.quaternion[slot], scalar_first=True)
        away = np.column_stack([places - scene.position[slot, :2], np.zeros(len(places))])
        room = scene.half_size[slot] + (GRID if has_target else 0.0)
        inside |= (np.abs(turn.inv().apply(away)) <= room).all(axis=1)
    yaws = np.arange(YAWS) * np.pi / YAWS
    places = places[inside]
    poses = np.column_stack([np.repeat(places, YAWS, axis=0), np.tile(yaws, len(places))])
    return rng.permutation(poses).astype(np.float32)


def _batches(
    lab: Lab, some: list[tuple[SceneState, np.ndarray]], kind: Primitive = Primitive.GRASP
) -> Iterator[tuple[np.ndarray, np.ndarray, SceneState]]:
    """Tries poses [n, 3] in each of some scenes, batch by batch; yields wanted blocks lifted [k],
    blocks lost [k] and the scenes after, leaves [k, ...]."""
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *(scene for scene, _ in some))
    heights = np.stack([lab.height(scene) for scene, _ in some])
    owner = np.repeat(np.arange(len(some)), [len(poses) for _, poses in some])
    poses = np.concatenate([poses for _, poses in some])
    for begin in range(0, len(poses), lab.rows):
        rows = slice(begin, begin + lab.rows)
        count = len(poses[rows])
        missing = ((0, lab.rows - count),)
        here = np.pad(owner[rows], missing)
        pose = np.pad(poses[rows], (*missing, (0, 0)), constant_values=np.nan)  # nothing moves
        actions = Action(jnp.full(lab.rows, kind, jnp.int32), jnp.asarray(pose))
        scenes = jax.tree.map(lambda leaf, here=here: leaf[here], stacked)
        results = lab.trial(scenes, heights[here], actions)
        yield jax.tree.map(lambda leaf, n=count: np.asarray(leaf)[:n], results)
