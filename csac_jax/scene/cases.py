"""Case files: arrangements written by hand, shipped in `scenes/cases/` or brought by the user.

    {"name": "pair", "blocks": [
        {"shape": "cube", "colour": "red", "position": [0.03, 0, 0.025],
         "quaternion": [1, 0, 0, 0], "target": true}, ...]}

Shapes and colours are the names in `blocks`. In place of a shape stands `"object": "NAME",
"library": "LIB"` for an object of a library, the folder as seen from that of the file, or
made:SEED:COUNT, or mixed:SEED:COUNT. A position, in metres, is that of the centre of the bounding
box. A quaternion (w, x, y, z) is normalised. `target` is optional. Sizes, densities and frictions
are nominal.
"""

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation

from csac_jax.config import MESH_KINDS, HeightmapConfig, SlotKind
from csac_jax.objects import tables
from csac_jax.objects.library import LibraryError
from csac_jax.scene import blocks, layout, model, stock
from csac_jax.scene.layout import Scene

MAX_OVERLAP = 0.002  # m, between two blocks or with the table
MAX_BLOCKS = 32
_HIGHEST = 0.5  # m, that any part of a block may reach
_ROUNDING = 1e-6  # m, of float32


class Case(NamedTuple):
    """An arrangement read from a file. Its N slots are the file's blocks in order, all in play."""

    name: str
    slots: tuple[SlotKind, ...]
    scene: Scene  # NumPy leaves, at rest
    objects: str = ""  # library of its objects, as in SceneConfig


def names() -> tuple[str, ...]:
    """Names of the shipped cases."""
    return tuple(sorted(path.stem for path in (model.assets() / "cases").glob("*.json")))


def shipped(name: str) -> Path:
    """File of the shipped case `name`. Raises ValueError with all names if there is none."""
    if name not in names():
        raise ValueError(f"unknown case '{name}'; choose one of: {', '.join(names())}")
    return model.assets() / "cases" / f"{name}.json"


def load(path: Path, extent: float = HeightmapConfig.extent) -> Case:
    """The case in the file `path`, its blocks inside the square of side `extent` m.

    Raises ValueError, one line with the file, the block (the first is 1) and what to change.
    """
    try:
        case = _parse(_read(path), path.parent)
        _check_places(case, extent)
    except (ValueError, LibraryError) as error:
        raise ValueError(f"{path}: {error}") from None
    except RecursionError:
        raise ValueError(f"{path}: is nested too deeply for a case file") from None
    return case


def require_target(case: Case) -> None:
    """Raises ValueError unless one block of the case is marked as the one to get."""
    if case.scene.target == layout.ANY:
        raise ValueError(f"case '{case.name}' marks no target; give one block \"target\": true")


def seat(case: Case, slots: tuple[SlotKind, ...]) -> Scene:
    """The case in other slots: each block in the first free one of its kind, the rest parked."""
    places = {kind: [i for i, own in enumerate(slots) if own == kind] for kind in case.slots}
    seats = [places[kind].pop(0) for kind in case.slots]

    def put(parked: np.ndarray, placed: np.ndarray) -> Any:
        if parked.ndim == 0:
            return placed if placed == layout.ANY else np.int32(seats[placed])  # the target
        leaf = parked.copy()
        leaf[seats] = placed
        return leaf

    return jax.tree.map(put, layout.parked(slots), case.scene)


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=_unique)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"is not a JSON file: {error}") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The object of these keys and values. Raises ValueError for a key given twice."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"key {_short(key)} is given twice in one object; remove one")
        found[key] = value
    return found


def _are_numbers(value: Any, count: int) -> bool:
    """Whether the value is a list of numbers up to 10, more than any place needs; not NaN."""
    is_list = isinstance(value, list) and len(value) == count
    return is_list and all(type(item) in (int, float) and abs(item) <= 10 for item in value)


Keys = dict[str, tuple[Callable[[Any], bool], str]]  # key: whether a value is good, and what is
_CASE: Keys = {
    "name": (
        lambda value: isinstance(value, str) and value.isprintable() and 1 <= len(value) <= 100,
        "a text of 1 to 100 printable characters",
    ),
    "blocks": (
        lambda value: isinstance(value, list) and 1 <= len(value) <= MAX_BLOCKS,
        f"a list of 1 to {MAX_BLOCKS} blocks",
    ),
}
_TEXT = (lambda value: isinstance(value, str) and 1 <= len(value) <= 1000, "a text")
_PLACED: Keys = {
    "colour": (blocks.COLOUR_NAMES.__contains__, f"one of: {', '.join(blocks.COLOUR_NAMES)}"),
    "position": (
        lambda value: _are_numbers(value, 3),
        "a list of 3 numbers in metres, each from -10 to 10",
    ),
    "quaternion": (
        lambda value: _are_numbers(value, 4) and bool(np.linalg.norm(value) > 1e-6),
        "a list of 4 numbers, each from -10 to 10 and not all zero",
    ),
    "target": (lambda value: isinstance(value, bool), "true or false"),
}
_SHAPE = (lambda value: value in [*blocks.SHAPES], f"one of: {', '.join(blocks.SHAPES)}")
_BLOCK: Keys = {"shape": _SHAPE, **_PLACED}
_OBJECT: Keys = {"object": _TEXT, "library": _TEXT, **_PLACED}


def _check(values: Any, keys: Keys) -> None:
    """Raises ValueError unless `values` has these keys, no others, and good values."""
    known = ", ".join(keys)
    if not isinstance(values, dict):
        raise ValueError(f"must be an object with the keys {known}")
    for key in values:
        if key not in keys:
            raise ValueError(f"unknown key {_short(key)}; known are: {known}")
    for key, (is_good, must_be) in keys.items():
        if key not in values and key != "target":
            raise ValueError(f'key "{key}" is missing')
        if key in values and not is_good(values[key]):
            raise ValueError(f'"{key}" must be {must_be}, not {_short(values[key])}')


def _short(value: Any) -> str:
    """A value of the file on one line."""
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _parse(content: Any, folder: Path) -> Case:
    """The case of the content of a file in this folder; places are not checked yet."""
    _check(content, _CASE)
    entries = content["blocks"]
    for number, entry in enumerate(entries, 1):
        try:
            _check(entry, _OBJECT if isinstance(entry, dict) and "object" in entry else _BLOCK)
        except ValueError as error:
            raise ValueError(f"block {number}: {error}") from None
    targets = [slot for slot, entry in enumerate(entries) if entry.get("target")]
    if len(targets) > 1:
        first, second = targets[0] + 1, targets[1] + 1
        raise ValueError(f"block {second}: block {first} is the target already; mark only one")
    quaternions = [np.array(entry["quaternion"]) for entry in entries]
    shapes = [blocks.SHAPES.get(entry.get("shape", "")) for entry in entries]
    slots: tuple[SlotKind, ...] = tuple(shape.kind if shape else "object" for shape in shapes)
    half_size = [shape.half_size if shape else blocks.OBJECT_HALF for shape in shapes]
    scene = layout.parked(slots).replace(
        position=np.array([entry["position"] for entry in entries], np.float32),
        quaternion=np.array([each / np.linalg.norm(each) for each in quaternions], np.float32),
        half_size=np.array(half_size, np.float32),
        colour=np.array(
            [blocks.COLOUR_NAMES.index(entry["colour"]) for entry in entries], np.int32
        ),
        in_play=np.ones(len(slots), bool),
        target=np.int32(targets[0] if targets else layout.ANY),
    )
    case = Case(content["name"], slots, scene)
    return _with_objects(case, entries, folder) if "object" in slots else case


def _with_objects(case: Case, entries: list[dict[str, Any]], folder: Path) -> Case:
    """The case with the objects that its entries name."""
    libraries = {entry["library"] for entry in entries if "object" in entry}
    if len(libraries) > 1:
        raise ValueError(f"objects of {len(libraries)} libraries; take all from one")
    (name,) = libraries
    source = name if name.startswith(("made:", "mixed:")) else str(folder / name)
    objects, slots = tables.find(source, "all"), np.flatnonzero(blocks.is_object(case.slots))
    numbers = [objects.number(entries[slot]["object"]) for slot in slots]
    known = tables.of(objects)
    scene = stock.hold(case.scene, slots, np.array(numbers), known)
    # The origin of an object is its centre of mass.
    rotation = Rotation.from_quat(scene.quaternion[slots], scalar_first=True)
    position = scene.position.copy()
    position[slots] -= rotation.apply(known.centre[numbers]).astype(np.float32)
    return Case(case.name, case.slots, scene.replace(position=position), source)


def _check_places(case: Case, extent: float) -> None:
    """Raises ValueError where blocks overlap one another or the table, or one leaves the square."""
    placed: list[list[np.ndarray]] = []  # corners of the parts of the blocks so far
    for number, own in enumerate(_corners(case), 1):
        try:
            _check_corners(np.concatenate(own), extent)
            _check_overlaps(own, placed)
        except ValueError as error:
            raise ValueError(f"block {number}: {error}") from None
        placed.append(own)


def _corners(case: Case) -> list[list[np.ndarray]]:
    """Corners [V, 3] m of every part of every block in the world."""
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
        one = tables.find(case.objects, "all").objects[int(scene.numbers[slot])]
        for part in one.parts:
            corners[slot].append(rotations[slot].apply(part.vertices) + scene.position[slot])
    return corners


def _check_corners(corners: np.ndarray, extent: float) -> None:
    """Raises ValueError where the corners [V, 3] m of a block lie outside what is allowed."""
    beyond = np.abs(corners[:, :2]).max() - 0.5 * extent
    below, top = -corners[:, 2].min(), corners[:, 2].max()
    if beyond > _ROUNDING:
        by = f"{1e3 * beyond:.1f} mm beyond the square of {extent:g} m"
        raise ValueError(f"reaches {by}; move it inwards")
    if below > MAX_OVERLAP:
        raise ValueError(f"reaches {1e3 * below:.1f} mm below the table; raise its z by as much")
    if top > _HIGHEST:
        raise ValueError(f"reaches {top:.3f} m above the table; keep it below {_HIGHEST:g} m")


def _check_overlaps(own: list[np.ndarray], placed: list[list[np.ndarray]]) -> None:
    """Raises ValueError where the parts of a block overlap those of one placed before."""
    for number, others in enumerate(placed, 1):
        depth = max(overlap(*pair) for pair in itertools.product(own, others))
        if depth > MAX_OVERLAP:
            by = f"{1e3 * depth:.1f} mm, more than the {1e3 * MAX_OVERLAP:g} mm allowed"
            raise ValueError(f"overlaps block {number} by {by}; increase their distance")


def overlap(one: np.ndarray, two: np.ndarray) -> float:
    """Shortest shift, m, that separates convex bodies of these corners [V, 3] m; <= 0 if none does.

    The depth of the origin in their Minkowski difference. Contacts of C MuJoCo would give the same,
    but none at all for two meshes in one place.
    """
    difference = (one[:, None] - two[None]).reshape(-1, 3)
    return -float(ConvexHull(difference).equations[:, 3].max())
