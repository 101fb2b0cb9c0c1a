"""Case files, see `case_file`: arrangements written by hand, of nominal sizes and materials."""

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation

from csac_jax.assets import assets
from csac_jax.config import MESH_KINDS, HeightmapConfig, SlotKind
from csac_jax.errors import SettingsError
from csac_jax.objects import tables
from csac_jax.objects.library import LibraryError
from csac_jax.section import require
from csac_jax.world import blocks, object_slots, scene_state
from csac_jax.world.scene_state import SceneState

if TYPE_CHECKING:
    from csac_jax.scenes.case_file import CaseBlock, CaseFile

MAX_OVERLAP = 0.002  # m, between two blocks or with the table
_HIGHEST = 0.5  # m, that any part of a block may reach
_ROUNDING = 1e-6  # m, of float32


class Case(NamedTuple):
    """An arrangement read from a file. Its N slots are the file's blocks in order, all in play."""

    name: str
    slots: tuple[SlotKind, ...]
    scene: SceneState  # NumPy leaves, at rest
    objects: str = ""  # library of its objects, as in SceneConfig


def names() -> tuple[str, ...]:
    """Lists the names of the shipped cases."""
    return tuple(sorted(path.stem for path in (assets() / "cases").glob("*.json")))


def shipped(name: str) -> Path:
    """Returns the file of a shipped case. Raises SettingsError with all names for an unknown."""
    if name not in names():
        raise SettingsError(f"unknown case '{name}'; choose one of: {', '.join(names())}")
    return assets() / "cases" / f"{name}.json"


def load(path: Path, extent: float = HeightmapConfig.extent) -> Case:
    """Loads a case whose blocks lie inside the square of side `extent` m. Raises SettingsError, one
    line with the file, the block (the first is 1) and what to change."""
    from csac_jax.scenes import case_file

    try:
        case = _case(case_file.parse(path.read_text(encoding="utf-8")), path.parent)
        _check_places(case, extent)
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, LibraryError, RecursionError) as error:
        raise SettingsError(f"{path}: {error}") from None
    return case


def require_target(case: Case) -> None:
    """Raises SettingsError unless one block of the case is marked as the one to get."""
    if case.scene.target == scene_state.ANY:
        raise SettingsError(f"case '{case.name}' marks no target; give one block \"target\": true")


def seat(case: Case, slots: tuple[SlotKind, ...]) -> SceneState:
    """Moves the blocks in play of a case to other slots: each to the first free one of its kind.

    Raises SettingsError where there is none.
    """
    used = np.flatnonzero(case.scene.in_play)
    places = {kind: [i for i, other in enumerate(slots) if other == kind] for kind in case.slots}
    for kind, free in places.items():
        if (count := [case.slots[i] for i in used].count(kind)) > len(free):
            raise SettingsError(f"scene.slots: {case.name} needs {count} of kind {kind}")
    seats = {int(i): places[case.slots[i]].pop(0) for i in used}

    def put(parked: np.ndarray, placed: np.ndarray) -> Any:
        if parked.ndim == 0:  # the target
            return placed if placed == scene_state.ANY else np.int32(seats[int(placed)])
        leaf = parked.copy()
        leaf[list(seats.values())] = placed[used]
        return leaf

    parked, scene = scene_state.parked(slots), case.scene
    if scene.object_id is None and parked.object_id is not None:
        scene = scene.replace(object_id=np.zeros(len(case.slots), np.int32))
    return jax.tree.map(put, parked, scene)


def _case(content: "CaseFile", folder: Path) -> Case:
    entries = content.blocks
    targets = [slot for slot, entry in enumerate(entries) if entry.target]
    if len(targets) > 1:
        first, second = targets[0] + 1, targets[1] + 1
        raise SettingsError(f"block {second}: block {first} is the target already; mark only one")
    unknown = blocks.Shape("object", blocks.OBJECT_HALF)
    shapes = [blocks.SHAPES[entry.shape] if entry.shape else unknown for entry in entries]
    slots = tuple(shape.kind for shape in shapes)
    quaternions = [np.array(entry.quaternion) for entry in entries]
    scene = scene_state.parked(slots).replace(
        position=np.array([entry.position for entry in entries], np.float32),
        quaternion=np.array([q / np.linalg.norm(q) for q in quaternions], np.float32),
        half_size=np.array([shape.half_size for shape in shapes], np.float32),
        colour=np.array([blocks.COLOUR_NAMES.index(entry.colour) for entry in entries], np.int32),
        in_play=np.ones(len(slots), bool),
        target=np.int32(targets[0] if targets else scene_state.ANY),
    )
    case = Case(content.name, slots, scene)
    return _with_objects(case, entries, folder) if "object" in slots else case


def _with_objects(case: Case, entries: list["CaseBlock"], folder: Path) -> Case:
    name, *others = {entry.library for entry in entries if entry.library}
    require(not others, f"objects of {1 + len(others)} libraries; take all from one")
    source = name if tables.PROCEDURAL.fullmatch(name) else str(folder / name)
    library, slots = tables.find(source, "all"), np.flatnonzero(blocks.is_object(case.slots))
    numbers = np.array([library.number(entries[slot].object or "") for slot in slots])
    objects = tables.from_library(library)
    scene = object_slots.hold(case.scene, slots, numbers, objects)
    # The origin of an object is its centre of mass.
    rotation = Rotation.from_quat(scene.quaternion[slots], scalar_first=True)
    position = scene.position.copy()
    position[slots] -= rotation.apply(objects.centre[numbers]).astype(np.float32)
    return Case(case.name, case.slots, scene.replace(position=position), source)


def _check_places(case: Case, extent: float) -> None:
    placed: list[list[np.ndarray]] = []  # corners of the parts of the blocks so far
    for number, parts in enumerate(_corners(case), 1):
        fault = _outside(np.concatenate(parts), extent) or _overlapping(parts, placed)
        require(not fault, f"block {number}: {fault}")
        placed.append(parts)


def _corners(case: Case) -> list[list[np.ndarray]]:
    """Computes corners [V, 3] m in the world of every part of every block."""
    scene, cube = case.scene, np.array([*itertools.product((-1.0, 1.0), repeat=3)])
    rotations = Rotation.from_quat(scene.quaternion, scalar_first=True)
    corners: list[list[np.ndarray]] = [[] for _ in case.slots]
    for slot, centre, half in zip(*blocks.parts(case.slots), strict=True):
        if case.slots[slot] in MESH_KINDS:
            normals, offsets = blocks.FACES[case.slots[slot]]
            faces = np.column_stack([normals, -offsets])
            local = HalfspaceIntersection(faces, np.zeros(3)).intersections
        else:
            local = scene.half_size[slot] * (centre + half * cube)
        corners[slot].append(rotations[slot].apply(local) + scene.position[slot])
    for slot in np.flatnonzero(blocks.is_object(case.slots)):
        member = tables.find(case.objects, "all").objects[int(scene.numbers[slot])]
        for part in member.parts:
            corners[slot].append(rotations[slot].apply(part.vertices) + scene.position[slot])
    return corners


def _outside(corners: np.ndarray, extent: float) -> str | None:
    beyond = np.abs(corners[:, :2]).max() - 0.5 * extent
    below, top = -corners[:, 2].min(), corners[:, 2].max()
    if beyond > _ROUNDING:
        return f"reaches {1e3 * beyond:.1f} mm beyond the square of {extent:g} m; move it inwards"
    if below > MAX_OVERLAP:
        return f"reaches {1e3 * below:.1f} mm below the table; raise its z by as much"
    if top > _HIGHEST:
        return f"reaches {top:.3f} m above the table; keep it below {_HIGHEST:g} m"
    return None


def _overlapping(parts: list[np.ndarray], placed: list[list[np.ndarray]]) -> str | None:
    for number, others in enumerate(placed, 1):
        depth = max(overlap(*pair) for pair in itertools.product(parts, others))
        if depth > MAX_OVERLAP:
            by = f"{1e3 * depth:.1f} mm, more than the {1e3 * MAX_OVERLAP:g} mm allowed"
            return f"overlaps block {number} by {by}; increase their distance"
    return None


def overlap(one: np.ndarray, two: np.ndarray) -> float:
    """Computes the shortest shift, m, that separates convex bodies of corners [V, 3] m.

    It is the depth of the origin in their Minkowski difference, <= 0 for bodies apart.
    """
    difference = (one[:, None] - two[None]).reshape(-1, 3)
    return -float(ConvexHull(difference).equations[:, 3].max())
