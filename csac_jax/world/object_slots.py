"""The objects that the slots of a scene hold. Needs no MuJoCo."""

import hashlib
import itertools

import numpy as np
from scipy.spatial import ConvexHull

from csac_jax.config import SceneConfig
from csac_jax.errors import SceneError
from csac_jax.objects import tables
from csac_jax.objects.body import DENSITY
from csac_jax.objects.library import Library
from csac_jax.objects.tables import Tables
from csac_jax.world import blocks
from csac_jax.world.scene_state import SceneState


def library(cfg: SceneConfig) -> Library:
    """Finds the objects that scenes of this config draw from. Raises LibraryError."""
    return tables.find(cfg.objects, cfg.split)


def table(cfg: SceneConfig) -> Tables:
    """Returns the same objects as arrays."""
    return tables.from_library(library(cfg))


ANY_SIDE = (0.0, np.inf)  # m


def drawn(
    rng: np.random.Generator,
    cfg: SceneConfig,
    scene: SceneState,
    sides: tuple[float, float] = ANY_SIDE,
) -> SceneState:
    """Draws the objects of a scene; none repeats before all have been drawn.

    Only objects are drawn whose bounding box has a middle side in the range `sides`, m. Raises
    SceneError where there is none.
    """
    slots, objects = np.flatnonzero(blocks.is_object(cfg.slots)), table(cfg)
    (low, high), middle = sides, 2.0 * np.sort(objects.half, axis=1)[:, 1]
    fitting = np.flatnonzero((middle >= low) & (middle <= high))
    if not fitting.size:
        none = f"none of {len(middle)} objects has a middle side of {low:g} to {high:g} m"
        raise SceneError(f"{none}; take another library, or raise its number of objects")
    order = [rng.permutation(fitting.size) for _ in range(0, len(slots), fitting.size)]
    return hold(scene, slots, fitting[np.concatenate(order)[: len(slots)]], objects)


def hold(scene: SceneState, slots: np.ndarray, numbers: np.ndarray, objects: Tables) -> SceneState:
    """Puts the objects `numbers` [M] of a library into `slots` [M]."""
    object_id, half_size = np.array(scene.numbers), np.array(scene.half_size)
    object_id[slots], half_size[slots] = numbers, objects.half[numbers]
    return scene.replace(object_id=object_id, half_size=half_size)


GAP = 0.005  # m, least distance of the outlines of packed objects
_TRIES = 200  # random places tried for each


def packed(rng: np.random.Generator, cfg: SceneConfig, scene: SceneState) -> SceneState:
    """Places the objects in play at random, upright, outlines GAP apart, within `drop_extent`.

    Raises SceneError where there is no room.
    """
    half = 0.5 * rng.uniform(*cfg.drop_extent)
    position, quaternion = np.array(scene.position), np.array(scene.quaternion)
    outlines: list[np.ndarray] = []
    for slot in np.flatnonzero(scene.in_play):
        member = library(cfg).objects[int(scene.numbers[slot])]
        corners = np.concatenate([part.vertices for part in member.parts])
        for _ in range(_TRIES):
            yaw, xy = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-half, half, 2)
            cos, sin = np.cos(yaw), np.sin(yaw)
            outline = np.einsum("ni,ij->nj", corners[:, :2], [[cos, sin], [-sin, cos]]) + xy
            outline = outline[ConvexHull(outline).vertices]
            if np.abs(outline).max() <= half and all(_apart(outline, other) for other in outlines):
                break
        else:
            raise SceneError(
                f"no room for '{member.name}' among {len(outlines)} objects in a square of "
                f"{2.0 * half:g} m; take smaller objects"
            )
        outlines.append(outline)
        position[slot] = *xy, -corners[:, 2].min()
        quaternion[slot] = np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)
    return scene.replace(position=position, quaternion=quaternion)


def _apart(one: np.ndarray, two: np.ndarray) -> bool:
    for first, second in itertools.permutations((one, two)):  # along the normals of the sides
        side = np.roll(first, -1, axis=0) - first
        normal = np.column_stack([side[:, 1], -side[:, 0]])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        near, far = (np.einsum("ni,mi->nm", outline, normal) for outline in (second, first))
        if (near.min(axis=0) - far.max(axis=0)).max() >= GAP:
            return True
    return False


def fingerprint(cfg: SceneConfig, scenes: SceneState) -> str:
    """Returns a SHA-256 of all in scenes [P, N, ...] that physics leaves alone."""
    objects = library(cfg).objects
    content = hashlib.sha256()
    for number, in_play in zip(scenes.numbers.ravel(), scenes.in_play.ravel(), strict=True):
        member = objects[number]
        weight = f"{member.volume * member.density / DENSITY:.4e}"
        content.update(f"{member.name} {member.source_sha256} {weight} {in_play};".encode())
    for leaf in (scenes.density, scenes.friction, scenes.colour):
        content.update(np.ascontiguousarray(leaf).tobytes())
    return content.hexdigest()
