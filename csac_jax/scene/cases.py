"""Case files: arrangements written by hand, shipped in `scenes/cases/` or brought by the user.

    {"name": "pair", "blocks": [
        {"shape": "cube", "colour": "red", "position": [0.03, 0, 0.025],
         "quaternion": [1, 0, 0, 0], "target": true},
        {"shape": "tile", "colour": "blue", "position": [-0.03, 0, 0.0125],
         "quaternion": [1, 0, 0, 0]}]}

Shapes and colours are the names in `blocks`. A position, in metres, is that of the centre of the
bounding box. A quaternion (w, x, y, z) is normalised. `target` is optional. Sizes, densities and
frictions are nominal.
"""

import copy
import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from csac_jax.config import HeightmapConfig, SceneConfig, SimConfig, SlotKind
from csac_jax.scene import blocks, layout, model, overlap
from csac_jax.scene.layout import Scene
from csac_jax.scene.model import World

MAX_OVERLAP = 0.002  # m, between two blocks or with the table
MAX_BLOCKS = 32
_HIGHEST = 0.5  # m, that any part of a block may reach
_ROUNDING = 1e-6  # m, of float32
_REQUIRED = ("shape", "colour", "position", "quaternion")


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """An arrangement read from a file. Its N slots are the file's blocks in order, all in play."""

    name: str
    slots: tuple[SlotKind, ...]
    scene: Scene  # NumPy leaves, at rest


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
        case = _parse(_read(path))
        _check_places(case, extent)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return case


def require_target(case: Case) -> None:
    """Raises ValueError unless one block of the case is marked as the one to get."""
    if int(case.scene.target) == layout.ANY:
        raise ValueError(
            f"case '{case.name}' marks no block as the target; give one of them \"target\": true"
        )


def seat(case: Case, slots: tuple[SlotKind, ...]) -> Scene:
    """The case's scene in other slots: each block in the first free one of its kind, the rest
    parked."""
    free, seats = list(range(len(slots))), []
    for kind in case.slots:
        seats.append(next(slot for slot in free if slots[slot] == kind))
        free.remove(seats[-1])

    def put(parked: np.ndarray, placed: np.ndarray) -> np.ndarray:
        leaf = parked.copy()
        if leaf.ndim:  # all but the target
            leaf[seats] = placed
        return leaf

    scene = jax.tree.map(put, layout.parked(slots), case.scene)
    target = int(case.scene.target)
    return scene.replace(target=np.int32(target if target == layout.ANY else seats[target]))


# From text to a scene.


def _read(path: Path) -> dict[str, Any]:
    """The JSON object in the file."""
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"), object_pairs_hook=_unique)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ValueError("is not a JSON file: it is no UTF-8 text") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"is not a JSON file: {error}") from None
    except RecursionError:
        raise ValueError("is not a case file: it is nested too deeply") from None
    if not isinstance(content, dict):
        raise ValueError('is not a case file: it must be an object {"name": ..., "blocks": [...]}')
    return content


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The object of these keys and values. Raises ValueError for a key given twice."""
    keys = [key for key, _ in pairs]
    for key in keys:
        if keys.count(key) > 1:
            raise ValueError(f"key {_short(key)} is given twice in one object; remove one")
    return dict(pairs)


def _parse(content: dict[str, Any]) -> Case:
    """The case of a file's content; places are not checked yet."""
    _check_keys(content, ("name", "blocks"), ())
    name, entries = content["name"], content["blocks"]
    if not (isinstance(name, str) and name.isprintable() and 1 <= len(name) <= 100):
        raise ValueError('"name" must be a text of 1 to 100 printable characters')
    if not (isinstance(entries, list) and 1 <= len(entries) <= MAX_BLOCKS):
        raise ValueError(f'"blocks" must be a list of 1 to {MAX_BLOCKS} blocks')
    parsed = []
    for number, entry in enumerate(entries, 1):
        try:
            parsed.append(_parse_block(entry))
        except ValueError as error:
            raise ValueError(f"block {number}: {error}") from None
    return _assemble(name, parsed)


@dataclasses.dataclass(frozen=True)
class _Block:
    """One entry of the list."""

    shape: blocks.Shape
    colour: int  # row of blocks.COLOURS
    position: list[float]  # [3] m
    quaternion: np.ndarray  # [4] unit
    target: bool


def _parse_block(entry: Any) -> _Block:
    if not isinstance(entry, dict):
        raise ValueError("must be an object with the keys " + ", ".join(_REQUIRED))
    _check_keys(entry, _REQUIRED, ("target",))
    if not isinstance(entry.get("target", False), bool):
        raise ValueError('"target" must be true or false')
    quaternion = np.array(_numbers(entry, "quaternion", 4))
    length = float(np.linalg.norm(quaternion))
    if length < 1e-6:
        raise ValueError('"quaternion" must not be zero; [1, 0, 0, 0] leaves the block unturned')
    return _Block(
        shape=blocks.SHAPES[_choice(entry, "shape", tuple(blocks.SHAPES))],
        colour=blocks.COLOUR_NAMES.index(_choice(entry, "colour", blocks.COLOUR_NAMES)),
        position=_numbers(entry, "position", 3),
        quaternion=quaternion / length,
        target=entry.get("target", False),
    )


def _check_keys(
    content: dict[str, Any], required: tuple[str, ...], optional: tuple[str, ...]
) -> None:
    for key in required:
        if key not in content:
            raise ValueError(f'key "{key}" is missing')
    for key in content:
        if key not in required + optional:
            known = ", ".join(required + optional)
            raise ValueError(f"unknown key {_short(key)}; known are: {known}")


def _choice(entry: dict[str, Any], key: str, choices: tuple[str, ...]) -> str:
    value = entry[key]
    if not (isinstance(value, str) and value in choices):
        raise ValueError(f"unknown {key} {_short(value)}; choose one of: {', '.join(choices)}")
    return value


def _numbers(entry: dict[str, Any], key: str, count: int) -> list[float]:
    """`count` numbers up to 10, more than any place needs."""
    values = entry[key]
    if isinstance(values, list) and len(values) == count and all(map(_is_number, values)):
        return [float(value) for value in values]
    unit = " in metres" if key == "position" else ""
    wanted = f"a list of {count} numbers{unit}, each from -10 to 10"
    raise ValueError(f'"{key}" must be {wanted}, not {_short(values)}')


def _is_number(value: Any) -> bool:
    """Whether the value lies in -10 .. 10; false for NaN, and for true and false themselves."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 10


def _short(value: Any) -> str:
    """A value of the file on one line."""
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _assemble(name: str, parsed: list[_Block]) -> Case:
    """The case of these blocks."""
    targets = [slot for slot, block in enumerate(parsed) if block.target]
    if len(targets) > 1:
        first, second = targets[0] + 1, targets[1] + 1
        raise ValueError(f"block {second}: block {first} is the target already; mark only one")
    slots = tuple(block.shape.kind for block in parsed)
    leaves: dict[str, Any] = {
        "position": np.array([block.position for block in parsed], np.float32),
        "quaternion": np.array([block.quaternion for block in parsed], np.float32),
        "half_size": np.array([block.shape.half_size for block in parsed], np.float32),
        "colour": np.array([block.colour for block in parsed], np.int32),
        "in_play": np.ones(len(parsed), bool),
        "target": np.int32(targets[0] if targets else layout.ANY),
    }
    return Case(name, slots, dataclasses.replace(layout.parked(slots), **leaves))


# Where the blocks lie: corners as C MuJoCo places them.


def _check_places(case: Case, extent: float) -> None:
    """Raises ValueError where blocks overlap one another or the table, or one leaves the square."""
    world = model.build(SceneConfig(slots=case.slots, min_blocks=1), SimConfig())
    exact = _nominal(world, np.asarray(case.scene.half_size))
    data = mujoco.MjData(exact)
    poses = np.concatenate([case.scene.position, case.scene.quaternion], axis=1)
    data.qpos[world.block_qpos] = poses
    mujoco.mj_kinematics(exact, data)
    placed: list[list[_Part]] = []  # of the blocks so far
    for slot, kind in enumerate(case.slots):
        geoms = world.block_geoms[world.parts.slot == slot]
        normals = blocks.normals(kind) @ data.xmat[world.block_bodies[slot]].reshape(3, 3).T
        own = [_Part(_corners(exact, data, geom), normals) for geom in geoms]
        try:
            _check_corners(np.concatenate([part.corners for part in own]), extent)
            _check_overlaps(own, placed)
        except ValueError as error:
            raise ValueError(f"block {slot + 1}: {error}") from None
        placed.append(own)


class _Part(NamedTuple):
    """A convex part in the world."""

    corners: np.ndarray  # [V, 3] m
    normals: np.ndarray  # [F, 3]


def _nominal(world: World, half_size: np.ndarray) -> mujoco.MjModel:
    """A copy of the world's model with block surfaces of half sizes [N, 3] m, masses unchanged.

    `model.with_blocks` would do too, but compiles for seconds first.
    """
    exact = copy.copy(world.model)
    size = half_size[world.parts.slot]  # [G, 3]
    mesh = exact.geom_type[world.block_geoms][:, None] == mujoco.mjtGeom.mjGEOM_MESH
    compiled = exact.geom_pos[world.block_geoms] / model.LARGEST
    exact.geom_pos[world.block_geoms] = np.where(mesh, compiled, world.parts.centre * size)
    exact.geom_size[world.block_geoms] = world.parts.half * size
    exact.mesh_vert[:] /= model.LARGEST
    return exact


def _check_corners(corners: np.ndarray, extent: float) -> None:
    """Raises ValueError where the corners [V, 3] m of a block lie outside what is allowed."""
    beyond = np.abs(corners[:, :2]).max() - 0.5 * extent
    below, top = -corners[:, 2].min(), corners[:, 2].max()
    if beyond > _ROUNDING:
        where = f"beyond the square of {extent:g} m"
        raise ValueError(f"reaches {1e3 * beyond:.1f} mm {where}; move it inwards")
    if below > MAX_OVERLAP:
        raise ValueError(f"reaches {1e3 * below:.1f} mm below the table; raise its z by as much")
    if top > _HIGHEST:
        raise ValueError(f"reaches {top:.3f} m above the table; keep it below {_HIGHEST:g} m")


def _corners(exact: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Corners [V, 3] m of a geom in the world."""
    if exact.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = exact.geom_dataid[geom]
        start = exact.mesh_vertadr[mesh]
        local = exact.mesh_vert[start : start + exact.mesh_vertnum[mesh]]
    else:
        local = exact.geom_size[geom] * np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    return data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T


def _check_overlaps(own: list[_Part], placed: list[list[_Part]]) -> None:
    """Raises ValueError where the parts of a block overlap those of one placed before."""
    for number, others in enumerate(placed, 1):
        pairs = itertools.product(own, others)
        depth = max(overlap.depth((a.corners, b.corners), (a.normals, b.normals)) for a, b in pairs)
        if depth > MAX_OVERLAP:
            raise ValueError(
                f"overlaps block {number} by {1e3 * depth:.1f} mm, more than the "
                f"{1e3 * MAX_OVERLAP:g} mm allowed; increase their distance"
            )
