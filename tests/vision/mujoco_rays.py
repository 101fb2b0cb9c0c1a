"""Models with every kind of geom, and many rays through them by C MuJoCo."""

import contextlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
import pytest

from csac_jax.config import SceneConfig, SimConfig, SlotKind
from csac_jax.world import blocks, geoms, model as models, scene_state, solids

SHAPES = tuple(blocks.SHAPES)
SLOTS: tuple[SlotKind, ...] = tuple(blocks.SHAPES[name].kind for name in SHAPES)


class Placed(NamedTuple):
    """A model at a pose."""

    model: mujoco.MjModel
    data: mujoco.MjData


class Rays(NamedTuple):
    """Hits of R rays."""

    distance: np.ndarray  # [R] in lengths of the direction, -1 for a miss
    geom: np.ndarray  # [R] -1 for a miss
    normal: np.ndarray  # [R, 3]


@contextlib.contextmanager
def nominal_meshes() -> Iterator[None]:
    """Worlds whose meshes C's rays see: its search trees follow neither rescaling nor turns."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(models, "LARGEST", 1.0)
        patch.setattr(models, "_align_inertia", lambda model: None)
        yield


def placed(world: models.World, scene: scene_state.SceneState) -> Placed:
    """A scene of a world that was built by `nominal_meshes`; hand high above, table endless."""
    with nominal_meshes():
        fields = jax.device_get(models.scene_fields(world, scene))
    model = models.with_blocks(world, fields)
    model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] = 0.0
    data = mujoco.MjData(model)
    data.qpos[world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
    data.qpos[world.robot_qpos[2]] = 3.0
    mujoco.mj_kinematics(model, data)
    return Placed(model, data)


def blocks_and_arm(rng: np.random.Generator) -> Placed:
    """The eight blocks in random poses under and about the UR5 with its hand, on the table."""
    scene = scene_state.parked(SLOTS)
    half_size = np.array([blocks.SHAPES[name].half_size for name in SHAPES], np.float32)
    with nominal_meshes():
        world = models.build(SceneConfig(slots=SLOTS, min_blocks=1), SimConfig(robot="ur5"))
        fields = jax.device_get(models.scene_fields(world, scene.replace(half_size=half_size)))
    model = models.with_blocks(world, fields)
    data = mujoco.MjData(model)
    quaternion = rng.normal(size=(len(SHAPES), 4))
    data.qpos[world.robot_qpos] = rng.uniform(-1.5, 1.5, len(world.robot_qpos))
    data.qpos[world.robot_qpos[-2:]] = rng.uniform(0.0, 0.05)
    low, high = [-0.2, -0.2, 0.02], [0.2, 0.2, 0.2]
    data.qpos[world.block_qpos[:, :3]] = rng.uniform(low, high, (len(SHAPES), 3))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    data.qpos[world.block_qpos[:, 3:]] = quaternion
    mujoco.mj_kinematics(model, data)
    return Placed(model, data)


def every_type(rng: np.random.Generator) -> Placed:
    """Two of each type of the raycaster, of random sizes and poses; one plane has an end."""
    geoms = (
        '<geom type="plane" size="0 0 1" pos="0 0 -0.3"/>'
        '<geom type="plane" size="0.3 0.2 1" euler="10 20 30"/>'
    )
    meshes = ""
    for number, kind in enumerate(("box", "sphere", "capsule", "cylinder", "mesh") * 2):
        size, place, turn = (
            " ".join(f"{value:.6f}" for value in rng.uniform(low, high, 3))
            for low, high in ((0.02, 0.08), (-0.25, 0.25), (-180, 180))
        )
        if kind == "mesh":  # the convex hull of 12 points
            corners = " ".join(f"{value:.6f}" for value in rng.normal(scale=0.04, size=36))
            meshes += f'<mesh name="{number}" vertex="{corners}"/>'
        shape = f'mesh="{number}"' if kind == "mesh" else f'size="{size}"'
        geoms += f'<geom type="{kind}" {shape} pos="{place}" euler="{turn}"/>'
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{meshes}</asset><worldbody>{geoms}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return Placed(model, data)


def read(model: mujoco.MjModel, data: mujoco.MjData) -> solids.Solids:
    """The model at the pose of its data."""
    poses = np.float32(data.geom_xpos), np.float32(data.geom_xmat)
    return solids.place(geoms.read(model), *poses)


def cast(model: mujoco.MjModel, data: mujoco.MjData, origin: Any, direction: Any) -> Rays:
    """R rays along `direction` [R, 3] from `origin` [3] or [R, 3] by C, one by one: `mj_multiRay`
    loses some at edges."""
    num, found, surface = len(direction), np.zeros((1, 1), np.int32), np.zeros((3, 1))
    start = np.array(np.broadcast_to(origin, (num, 3)), np.float64)[:, :, None]
    along = np.array(direction, np.float64)[:, :, None]
    distance, geom, normal = np.zeros(num), np.zeros(num, np.int32), np.zeros((num, 3))
    for ray in range(num):
        at = start[ray], along[ray]
        distance[ray] = mujoco.mj_ray(model, data, *at, None, 1, -1, found, surface)
        geom[ray], normal[ray] = found[0, 0], surface[:, 0]
    return Rays(distance, geom, normal)


def bundle(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """An origin [3], 0.7 m off the scene, and unit directions [R, 3] to points in it; float32."""
    origin = rng.normal(size=3)
    origin *= 0.7 / np.linalg.norm(origin)
    origin[2] = abs(origin[2])
    direction = rng.uniform([-0.25, -0.25, -0.1], [0.25, 0.25, 0.25], (count, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return origin.astype(np.float32), direction.astype(np.float32)
