"""Any MuJoCo model as groups of geoms of one kind, for rays that meet more than blocks.

scene = solids.read(model)  # on the host, once
scene = solids.place(scene, data.geom_xpos, data.geom_xmat)  # also inside compiled functions
"""

import enum
from typing import Any

import jax
import mujoco
import numpy as np
from flax import struct
from scipy.spatial import ConvexHull

from csac_jax.scene import blocks


class Kind(enum.Enum):
    """Kinds of geom. Sizes are MuJoCo's, m; axes are those of the geom's frame."""

    PLANE = "plane"  # z = 0, seen from above; half sizes along x and y, 0 for no end
    BOX = "box"  # half sizes
    SPHERE = "sphere"  # radius
    CAPSULE = "capsule"  # about z: radius, half length without the caps
    CYLINDER = "cylinder"  # about z: radius, half length
    POLYTOPE = "polytope"  # convex hull of a mesh, as half-spaces


_KIND_OF_TYPE = {
    mujoco.mjtGeom.mjGEOM_PLANE: Kind.PLANE,
    mujoco.mjtGeom.mjGEOM_BOX: Kind.BOX,
    mujoco.mjtGeom.mjGEOM_SPHERE: Kind.SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE: Kind.CAPSULE,
    mujoco.mjtGeom.mjGEOM_CYLINDER: Kind.CYLINDER,
    mujoco.mjtGeom.mjGEOM_MESH: Kind.POLYTOPE,
}


@struct.dataclass
class GeomGroup:
    """The geoms of one kind in one scene. G = geoms, F = faces of the polytope with most."""

    kind: Kind = struct.field(pytree_node=False)
    shape: jax.Array  # [G, 3] size, m; of polytopes [G, F, 4] outward unit normal and offset m
    position: jax.Array  # [G, 3] m, origin of the geom's frame in the world
    rotation: jax.Array  # [G, 3, 3] geom to world
    geom: jax.Array  # [G] int32, the geom's number


@struct.dataclass
class Solids:
    """All visible geoms of one scene."""

    groups: tuple[GeomGroup, ...]  # one per kind
    colour: jax.Array  # [geoms, 3] red, green, blue in 0 .. 1, by the geom's number


def read(
    model: mujoco.MjModel, xpos: np.ndarray | None = None, xmat: np.ndarray | None = None
) -> Solids:
    """The visible geoms of a model, NumPy leaves, numbered as there.

    Geoms of opacity 0 are left out. A mesh is its convex hull. Args: poses as in `place`, those of
    the model's rest state by default. Raises ValueError with the name of a geom of another type.
    """
    rgba: Any = np.where(model.geom_matid[:, None] >= 0, _material(model), model.geom_rgba)
    geoms_of: dict[Kind, list[int]] = {}
    for geom in map(int, np.flatnonzero(rgba[:, 3] > 0.0)):
        geoms_of.setdefault(_kind(model, geom), []).append(geom)
    groups = [_group(model, kind, np.array(geoms, np.int32)) for kind, geoms in geoms_of.items()]
    solids = Solids(tuple(groups), rgba[:, :3].astype(np.float32))
    if xpos is None or xmat is None:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        xpos, xmat = data.geom_xpos, data.geom_xmat
    return place(solids, np.asarray(xpos, np.float32), np.asarray(xmat, np.float32))


def _kind(model: mujoco.MjModel, geom: int) -> Kind:
    geom_type = mujoco.mjtGeom(model.geom_type[geom])
    if geom_type not in _KIND_OF_TYPE:
        name = model.geom(geom).name or geom
        known = ", ".join(map(_type_name, _KIND_OF_TYPE))
        raise ValueError(
            f"geom {name}: rays do not meet type {_type_name(geom_type)}; use: {known}"
        )
    return _KIND_OF_TYPE[geom_type]


def _type_name(geom_type: mujoco.mjtGeom) -> str:
    return geom_type.name.removeprefix("mjGEOM_").lower()


def _group(model: mujoco.MjModel, kind: Kind, geoms: np.ndarray) -> GeomGroup:
    is_mesh = kind is Kind.POLYTOPE
    leaves: dict[str, Any] = {
        "shape": _half_spaces(model, geoms) if is_mesh else np.float32(model.geom_size[geoms]),
        "position": np.zeros((len(geoms), 3), np.float32),
        "rotation": np.zeros((len(geoms), 3, 3), np.float32),
        "geom": geoms,
    }
    return GeomGroup(kind=kind, **leaves)


def _half_spaces(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray:
    """Faces [G, F, 4] of the convex hulls of mesh geoms; padding faces have a zero normal."""
    hulls = []
    for mesh in model.geom_dataid[geoms]:
        start = model.mesh_vertadr[mesh]
        equations = ConvexHull(model.mesh_vert[start : start + model.mesh_vertnum[mesh]]).equations
        _, kept = np.unique(equations.round(5), axis=0, return_index=True)  # of the triangles
        hulls.append(equations[kept] * [1.0, 1.0, 1.0, -1.0])
    faces = np.zeros((len(hulls), max(map(len, hulls)), 4), np.float32)
    faces[:, :, 3] = blocks.PADDING_OFFSET
    for row, hull in zip(faces, hulls, strict=True):
        row[: len(hull)] = hull
    return faces


def _material(model: mujoco.MjModel) -> np.ndarray:
    """Colour and opacity [geoms, 4] of every geom's material; zero where it has none."""
    rows = np.concatenate([model.mat_rgba, np.zeros((1, 4), np.float32)])
    return rows[model.geom_matid]  # -1 is the last row


def place(solids: Solids, xpos: jax.Array | np.ndarray, xmat: jax.Array | np.ndarray) -> Solids:
    """The same geoms at other poses: xpos [geoms, 3] m; xmat [geoms, 9 or 3, 3], geom to world."""
    rotation = xmat.reshape(-1, 3, 3)
    moved = [
        group.replace(position=xpos[group.geom], rotation=rotation[group.geom])
        for group in solids.groups
    ]
    return solids.replace(groups=tuple(moved))
