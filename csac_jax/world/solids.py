"""Groups of geoms of one kind, for raycasting more than blocks. Needs no MuJoCo.

scene = geoms.read(model)  # on the host, once
scene = solids.place(scene, data.geom_xpos, data.geom_xmat)  # also inside compiled functions
"""

import enum

import jax
import numpy as np
from flax import struct


class Kind(enum.Enum):
    """Kinds of geom, MuJoCo's `mjtGeom`. Sizes are its, m; axes are those of the geom's frame."""

    PLANE = 0  # z = 0, seen from above; half sizes, 0 for no end
    BOX = 6  # half sizes
    SPHERE = 2  # radius
    CAPSULE = 3  # about z: radius, half length without the caps
    CYLINDER = 5  # about z: radius, half length
    POLYTOPE = 7  # convex hull of a mesh, as half-spaces


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


def place(solids: Solids, xpos: jax.Array | np.ndarray, xmat: jax.Array | np.ndarray) -> Solids:
    """Moves the geoms to poses xpos [geoms, 3] m and xmat [geoms, 9 or 3, 3], geom to world."""
    rotation = xmat.reshape(-1, 3, 3)
    poses = ({"position": xpos[g.geom], "rotation": rotation[g.geom]} for g in solids.groups)
    groups = (group.replace(**pose) for group, pose in zip(solids.groups, poses, strict=True))
    return solids.replace(groups=tuple(groups))
