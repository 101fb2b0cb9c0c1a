"""Any MuJoCo model as solids for raycasting."""

from typing import Any

import mujoco
import numpy as np
from mujoco import mjtGeom
from scipy.spatial import ConvexHull

from csac_jax.world import blocks, solids
from csac_jax.world.solids import GeomGroup, Kind, Solids


def read(model: mujoco.MjModel) -> Solids:
    """Reads the geoms of a model at rest, NumPy leaves; a mesh as its hull, not those of opacity 0.

    Raises ValueError with the name of a geom of another type.
    """
    materials = np.concatenate([model.mat_rgba, np.zeros((1, 4), np.float32)])
    no_material = model.geom_matid[:, None] < 0  # -1: the last row
    rgba: Any = np.where(no_material, model.geom_rgba, materials[model.geom_matid])
    geoms_of: dict[Kind, list[int]] = {}
    for geom in map(int, np.flatnonzero(rgba[:, 3] > 0.0)):
        geoms_of.setdefault(_kind(model, geom), []).append(geom)
    groups = [_group(model, kind, np.array(geoms, np.int32)) for kind, geoms in geoms_of.items()]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    scene = Solids(tuple(groups), rgba[:, :3])
    return solids.place(scene, data.geom_xpos.astype(np.float32), data.geom_xmat.astype(np.float32))


def _kind(model: mujoco.MjModel, geom: int) -> Kind:
    kind = model.geom_type[geom]
    if kind not in {known.value for known in Kind}:
        unknown, *known = (mjtGeom(k).name[7:].lower() for k in (kind, *(k.value for k in Kind)))
        name = model.geom(geom).name or geom
        raise ValueError(f"geom {name}: rays do not meet type {unknown}; use: {', '.join(known)}")
    return Kind(kind)


def _group(model: mujoco.MjModel, kind: Kind, geoms: Any) -> GeomGroup:
    size, unplaced = model.geom_size[geoms].astype(np.float32), np.zeros(0, np.float32)
    shape: Any = _half_spaces(model, geoms) if kind is Kind.POLYTOPE else size
    return GeomGroup(kind, shape, unplaced, unplaced, geoms)  # type: ignore[arg-type]


def _half_spaces(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray:
    """Computes faces [G, F, 4] of the hulls of mesh geoms; padding faces have a zero normal."""
    corners = np.split(model.mesh_vert, model.mesh_vertadr[1:])  # of every mesh
    hulls = []
    for mesh in model.geom_dataid[geoms]:
        equations = ConvexHull(corners[mesh]).equations
        _, distinct = np.unique(equations.round(5), axis=0, return_index=True)  # of the triangles
        hulls.append(equations[distinct] * [1.0, 1.0, 1.0, -1.0])
    faces = np.zeros((len(hulls), max(map(len, hulls)), 4), np.float32)
    faces[:, :, 3] = blocks.PADDING_OFFSET
    for row, hull in zip(faces, hulls, strict=True):
        row[: len(hull)] = hull
    return faces
