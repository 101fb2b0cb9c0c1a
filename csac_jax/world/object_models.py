"""Objects of a library in a MuJoCo model.

The model has the meshes of all objects. For a scene, the geoms of a body get those of its object,
with all fields that the compiler derives from a mesh. `mj_setConst` must follow: without it, search
trees over a body's geoms are stale, and contacts are missed silently.
"""

import dataclasses
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from csac_jax.objects import tables
from csac_jax.objects.library import Library
from csac_jax.objects.tables import Tables


class ObjectFields(NamedTuple):
    """Model fields of slots of kind object that differ per scene. M = such slots."""

    number: jax.Array  # [M] int32, object of the library
    density: jax.Array  # [M] kg/m^3
    friction: jax.Array  # [M] sliding friction


class PartFields(NamedTuple):
    """Fields that MuJoCo derives from the meshes of objects, in the frames of their inertias."""

    position: np.ndarray  # [O, P, 3] m, of the frame in the body
    quaternion: np.ndarray  # [O, P, 4] (w, x, y, z) of the frame in the body
    size: np.ndarray  # [O, P, 3] m, from the frame's origin to the farthest corner
    radius: np.ndarray  # [O, P] m, norm of the size
    box: np.ndarray  # [O, P, 2, 3] m, centre and half size of the bounding box in the frame


@dataclasses.dataclass(frozen=True, eq=False)
class Bodies:
    """The bodies of objects in a compiled model. M = slots, O = objects, P = parts of one."""

    tables: Tables
    slots: np.ndarray  # [M] slots of kind object
    bodies: np.ndarray  # [M] body ids
    geoms: np.ndarray  # [M, P] geom ids
    meshes: np.ndarray  # [O, P] mesh ids; that of the first part where an object has fewer parts
    parts: PartFields


def add_meshes(spec: mujoco.MjSpec, objects: Library) -> None:
    """Adds a mesh for every part of every object."""
    for number, member in enumerate(objects.objects):
        for part, solid in enumerate(member.parts):
            mesh = spec.add_mesh(name=_mesh(number, part))
            mesh.uservert = solid.vertices.ravel()
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX


def _mesh(number: int, part: int) -> str:
    return f"object{number}/{part}"


def add_geoms(spec: mujoco.MjSpec, body: mujoco.MjsBody, objects: Library) -> None:
    """Adds the geoms of one slot, all with the first mesh, and an inertia that scenes replace."""
    for _ in range(tables.from_library(objects).present.shape[1]):
        geom = body.add_geom(spec.find_default("blocks/block"))
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, _mesh(0, 0)
    body.mass, body.explicitinertial, body.simple = 0.1, True, False
    body.ipos = [0.0, 0.0, 0.0]  # without a place the compiler drops the axes of `fullinertia`
    body.fullinertia = [1e-4, 2e-4, 2.5e-4, 1e-5, 2e-5, 3e-5]


def read(model: mujoco.MjModel, slots: np.ndarray, bodies: np.ndarray, objects: Library) -> Bodies:
    """Finds the objects in a compiled model, of which they are the last meshes, in order."""
    table = tables.from_library(objects)
    geoms = model.body_geomadr[bodies][:, None] + np.arange(table.present.shape[1])
    counts = table.present.sum(axis=1)  # [O]
    first = model.mesh(_mesh(0, 0)).id + np.cumsum(counts) - counts
    meshes = first[:, None] + np.where(table.present, np.arange(geoms.shape[1]), 0)
    starts = model.mesh_vertadr[meshes[0, 0] :]
    corners = model.mesh_vert.astype(np.float64)
    low, high = (bound.reduceat(corners, starts) for bound in (np.minimum, np.maximum))
    boxes = np.stack([low, high], axis=1)[meshes - meshes[0, 0]]  # [O, P, 2, 3]
    size = np.abs(boxes).max(axis=2)
    parts = PartFields(
        model.mesh_pos[meshes],
        model.mesh_quat[meshes],
        size,
        np.linalg.norm(size, axis=2),
        np.stack([boxes.mean(axis=2), 0.5 * np.ptp(boxes, axis=2)], axis=2),
    )
    return Bodies(table, slots, bodies, geoms, meshes, parts)


def put(model: mujoco.MjModel, objects: Bodies, fields: ObjectFields) -> None:
    """Writes the objects of a scene into a model; `mj_setConst` must follow."""
    number, table = np.asarray(fields.number), objects.tables
    geoms, present = objects.geoms, table.present[number]
    part = PartFields(*(leaf[number] for leaf in objects.parts))
    model.geom_dataid[geoms] = objects.meshes[number]
    model.geom_pos[geoms], model.geom_quat[geoms] = part.position, part.quaternion
    model.geom_size[geoms], model.geom_rbound[geoms] = part.size, part.radius
    model.geom_aabb[geoms] = part.box.reshape(*geoms.shape, 6)
    model.geom_friction[geoms, 0] = np.asarray(fields.friction)[:, None]
    model.geom_contype[geoms[~present]] = model.geom_conaffinity[geoms[~present]] = 0
    density = np.asarray(fields.density, np.float64) * table.heaviness[number]
    model.body_mass[objects.bodies] = density * table.volume[number]
    model.body_inertia[objects.bodies] = density[:, None] * table.moments[number]
    model.body_iquat[objects.bodies], model.body_ipos[objects.bodies] = table.axes[number], 0.0
