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
from mujoco import mjtGeom
from scipy.spatial import ConvexHull

from csac_jax.scene import blocks


class Kind(enum.Enum):
    """Kinds of geom. Sizes are MuJoCo's, m; axes are those of the geom's frame."""

    PLANE = int(mjtGeom.mjGEOM_PLANE)  # z = 0, seen from above; half sizes, 0 for no end
    BOX = int(mjtGeom.mjGEOM_BOX)  # half sizes
    SPHERE = int(mjtGeom.mjGEOM_SPHERE)  # radius
    CAPSULE = int(mjtGeom.mjGEOM_CAPSULE)  # about z: radius, half length without the caps
    CYLINDER = int(mjtGeom.mjGEOM_CYLINDER)  # about z: radius, half length
    POLYTOPE = int(mjtGeom.mjGEOM_MESH)  # convex hull of a mesh, as half-spaces


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


def read(model: mujoco.MjModel) -> Solids:
    """The visible geoms of a model at rest, NumPy leaves, numbered as there.

    Geoms of opacity 0 are left out. A mesh is its convex hull. Raises ValueError with the name of a
    geom of another type.
    """
    materials = np.concatenate([model.mat_rgba, np.zeros((1, 4), np.float32)])
    own = model.geom_matid[:, None] < 0  # has no material: -1, the last row
    rgba: Any = np.where(own, model.geom_rgba, materials[model.geom_matid])
    geoms_of: dict[Kind, list[int]] = {}
    for geom in map(int, np.flatnonzero(rgba[:, 3] > 0.0)):
        geoms_of.setdefault(_kind(model, geom), []).append(geom)
    groups = [_group(model, kind, np.array(geoms, np.int32)) for kind, geoms in geoms_of.items()]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solids = Solids(tuple(groups), rgba[:, :3])
    return place(solids, data.geom_xpos.astype(np.float32), data.geom_xmat.astype(np.float32))


def _kind(model: mujoco.MjModel, geom: int) -> Kind:
    try:
        return Kind(model.geom_type[geom])
    except ValueError:
        name, found = model.geom(geom).name or geom, _type_name(model.geom_type[geom])
        known = ", ".join(_type_name(kind.value) for kind in Kind)
        raise ValueError(f"geom {name}: rays do not meet type {found}; use: {known}") from None


def _type_name(geom_type: int) -> str:
    return mjtGeom(geom_type).name.removeprefix("mjGEOM_").lower()


def _group(model: mujoco.MjModel, kind: Kind, geoms: Any) -> GeomGroup:
    is_mesh, unplaced = kind is Kind.POLYTOPE, np.zeros(0, np.float32)
    shape = _half_spaces(model, geoms) if is_mesh else model.geom_size[geoms].astype(np.float32)
    leaves: tuple[Any, ...] = (shape, unplaced, unplaced, geoms)
    return GeomGroup(kind, *leaves)


def _half_spaces(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray:
    """Faces [G, F, 4] of the convex hulls of mesh geoms; padding faces have a zero normal."""
    corners = np.split(model.mesh_vert, model.mesh_vertadr[1:])  # of every mesh
    hulls = []
    for mesh in model.geom_dataid[geoms]:
        equations = ConvexHull(corners[mesh]).equations
        _, kept = np.unique(equations.round(5), axis=0, return_index=True)  # of the triangles
        hulls.append(equations[kept] * [1.0, 1.0, 1.0, -1.0])
    faces = np.zeros((len(hulls), max(map(len, hulls)), 4), np.float32)
    faces[:, :, 3] = blocks.PADDING_OFFSET
    for row, hull in zip(faces, hulls, strict=True):
        row[: len(hull)] = hull
    return faces


def place(solids: Solids, xpos: jax.Array | np.ndarray, xmat: jax.Array | np.ndarray) -> Solids:
    """The same geoms at other poses: xpos [geoms, 3] m; xmat [geoms, 9 or 3, 3], geom to world."""
    rotation = xmat.reshape(-1, 3, 3)
    return solids.replace(
        groups=tuple(
            group.replace(position=xpos[group.geom], rotation=rotation[group.geom])
            for group in solids.groups
        )
    )
