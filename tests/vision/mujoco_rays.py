"""Scenes of blocks for C MuJoCo, and many rays through them."""

import contextlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pytest

from csac_jax.world import model as models, scene_state
from tests.world.placed import fields_of


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
        fields = fields_of(world, scene)
    model = models.with_blocks(world, fields)
    model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] = 0.0
    data = mujoco.MjData(model)
    data.qpos[world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
    data.qpos[world.robot_qpos[2]] = 3.0
    mujoco.mj_kinematics(model, data)
    return Placed(model, data)


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
