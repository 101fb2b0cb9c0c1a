"""One scene of blocks in C MuJoCo, the reference, and as half-spaces for the raycaster."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from csac_jax.config import SceneConfig, SimConfig, SlotKind
from csac_jax.vision import observe, raycast
from csac_jax.world import blocks, model, scene_state
from tests.vision import mujoco_rays

_BLOCKS = (  # shape, position, Euler angles in degrees
    ("cuboid", (0.02, 0.01, 0.025), (0, 0, 30)),
    ("cube", (0.03, 0.015, 0.085), (20, 35, 10)),
    ("prism", (-0.08, 0.05, 0.0243), (0, 0, -50)),
    ("prism", (-0.06, -0.09, 0.05), (70, 20, 15)),
    ("cylinder", (0.11, -0.07, 0.025), (0, 0, 12)),
    ("cylinder", (-0.14, -0.02, 0.04), (80, 10, 40)),
)


class Reference(NamedTuple):
    """A scene for C MuJoCo and for the raycaster."""

    world: model.World
    data: mujoco.MjData
    polytopes: raycast.Polytopes

    def rays(self, origins: np.ndarray, directions: np.ndarray) -> mujoco_rays.Rays:
        """Hits of rays from C MuJoCo; geoms are slots, -1 the table and -2 a miss."""
        hits = mujoco_rays.cast(self.data.model, self.data, origins, directions)
        return hits._replace(geom=np.where(hits.geom < 0, -2, self.world.slot_of_geom[hits.geom]))

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


@pytest.fixture(scope="session")
def reference() -> Reference:
    """Two boxes, two triangular and two octagonal prisms in several poses on the table."""
    names, position, angles = zip(*_BLOCKS, strict=True)
    slots: tuple[SlotKind, ...] = tuple(blocks.SHAPES[name].kind for name in names)
    quaternion = Rotation.from_euler("XYZ", angles, degrees=True).as_quat(scalar_first=True)
    scene = scene_state.parked(slots).replace(
        position=np.float32(position),
        quaternion=np.float32(quaternion),
        half_size=np.float32([blocks.SHAPES[name].half_size for name in names]),
        in_play=np.ones(len(slots), bool),
        colour=np.arange(len(slots), dtype=np.int32),
    )
    with mujoco_rays.nominal_meshes():
        world = model.build(SceneConfig(slots=slots, min_blocks=1), SimConfig(physics="c"))
    polytopes = jax.jit(observe.polytopes, static_argnums=0)(slots, scene)
    return Reference(world, mujoco_rays.placed(world, scene).data, polytopes)


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
