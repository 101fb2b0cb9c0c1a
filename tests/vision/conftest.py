"""One scene as a MuJoCo model, the reference, and as half-spaces for the raycaster."""

from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from csac_jax.vision import raycast
from tests.vision import mujoco_rays

_OCTAGON = [(np.cos(a), np.sin(a)) for a in np.pi / 4 * (np.arange(8) + 0.5)]
_MESHES = {
    "prism": [
        (x, 0.025 * side, z)
        for x, z in ((-0.0467, -0.0243), (0.0467, -0.0243), (0.0, 0.0243))
        for side in (-1, 1)
    ],
    "octagon": [(0.0242 * x, 0.0242 * y, z) for x, y in _OCTAGON for z in (-0.025, 0.025)],
}
_GEOMS = (  # attributes, position, rotation vector in degrees
    ('type="box" size="0.05 0.025 0.025"', "0.02 0.01 0.025", "0 0 30"),
    ('type="box" size="0.025 0.025 0.025"', "0.03 0.015 0.085", "20 35 10"),
    ('type="mesh" mesh="prism"', "-0.08 0.05 0.0243", "0 0 -50"),
    ('type="mesh" mesh="prism"', "-0.06 -0.09 0.05", "70 20 15"),
    ('type="mesh" mesh="octagon"', "0.11 -0.07 0.025", "0 0 12"),
    ('type="mesh" mesh="octagon"', "-0.14 -0.02 0.04", "80 10 40"),
)
_FACES = 10


class Reference(NamedTuple):
    """A scene for C MuJoCo (geom 0 is the table) and for the raycaster (geom i is C's i + 1)."""

    model: mujoco.MjModel
    data: mujoco.MjData
    polytopes: raycast.Polytopes

    def rays(self, origins: np.ndarray, directions: np.ndarray) -> mujoco_rays.Rays:
        """Hits of rays from C MuJoCo, -1 for the table and -2 for a miss."""
        hits = mujoco_rays.cast(self.model, self.data, origins, directions)
        return hits._replace(geom=hits.geom - 1)

    def near_edge(self, origins: np.ndarray, directions: np.ndarray, shift: float) -> np.ndarray:
        """[R] bool, a ray `shift` m beside this one meets another face or nothing."""
        _, geom, normal = self.rays(origins, directions)
        helper = np.where(np.abs(directions[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        side = np.cross(directions, helper)
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        edge = np.zeros(len(origins), bool)
        for step in (side, -side, np.cross(directions, side), -np.cross(directions, side)):
            _, other_geom, other_normal = self.rays(origins + shift * step, directions)
            # both 0 for a miss
            edge |= (other_geom != geom) | (np.abs(other_normal - normal).max(1) > 0.01)
        return edge


def _half_spaces(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Normals [F, 3] and offsets [F] of one geom, own frame, from its corners' convex hull."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        corners = model.geom_size[geom] * np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    else:
        mesh = model.geom_dataid[geom]
        start = model.mesh_vertadr[mesh]
        corners = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
    equations = ConvexHull(corners).equations
    _, kept = np.unique(equations.round(4), axis=0, return_index=True)  # the hull is triangulated
    return equations[kept, :3], -equations[kept, 3]


@pytest.fixture(scope="session")
def reference() -> Reference:
    """Two boxes, two triangular and two octagonal prisms in several poses on the table."""
    meshes = "".join(
        f'<mesh name="{name}" vertex="{" ".join(str(v) for p in points for v in p)}"/>'
        for name, points in _MESHES.items()
    )
    geoms = "".join(f'<geom {kind} pos="{pos}" euler="{euler}"/>' for kind, pos, euler in _GEOMS)
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{meshes}</asset><worldbody>"
        f'<geom type="plane" size="0 0 1"/>{geoms}</worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    normal, offset = np.zeros((len(_GEOMS), _FACES, 3)), np.ones((len(_GEOMS), _FACES))
    for geom in range(len(_GEOMS)):
        faces, offsets = _half_spaces(model, geom + 1)
        normal[geom, : len(faces)], offset[geom, : len(faces)] = faces, offsets
    colour = np.random.default_rng(0).uniform(size=(len(_GEOMS), 3))
    pose = data.geom_xpos[1:], data.geom_xmat[1:].reshape(-1, 3, 3)
    leaves = (jnp.asarray(leaf, jnp.float32) for leaf in (normal, offset, *pose, colour))
    polytopes = raycast.Polytopes(*leaves)
    return Reference(model, data, polytopes)


def cubes(*places: tuple[float, float, float]) -> raycast.Polytopes:
    """White cubes with sides of 5 cm, middles at these places, m."""
    count = len(places)
    normal = np.concatenate([np.eye(3), -np.eye(3)])
    return raycast.Polytopes(
        normal=jnp.asarray(np.tile(normal, (count, 1, 1)), jnp.float32),
        offset=jnp.full((count, 6), 0.025),
        position=jnp.array(places, jnp.float32),
        rotation=jnp.tile(jnp.eye(3), (count, 1, 1)),
        colour=jnp.ones((count, 3)),
    )
