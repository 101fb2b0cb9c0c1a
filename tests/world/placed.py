"""Scenes in C MuJoCo, for tests: model, state and corners of blocks."""

import jax
import mujoco
import numpy as np

from csac_jax.config import SceneConfig, SimConfig
from csac_jax.scenes import cases
from csac_jax.world import model
from csac_jax.world.scene_state import SceneState

_fields = jax.jit(model.scene_fields, static_argnums=0)


def fields_of(world: model.World, scene: SceneState) -> model.BlockFields:
    """Computes the fields of a scene's blocks, compiled once for a world."""
    return jax.device_get(_fields(world, scene))


def in_c(
    world: model.World,
    scene: SceneState,
    fields: model.BlockFields | None = None,
    iterations: int = 50,
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Builds one scene and its contacts; the hand high above, parked blocks weightless."""
    fields = fields or fields_of(world, scene)
    exact = model.with_blocks(world, fields)
    exact.opt.iterations, exact.opt.ls_iterations = iterations, iterations
    exact.body_gravcomp[world.block_bodies[~scene.in_play]] = 1.0
    data = mujoco.MjData(exact)
    data.qpos[world.robot_qpos[2]] = data.ctrl[2] = model.HAND_PARK_HEIGHT
    data.qpos[world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
    mujoco.mj_forward(exact, data)
    return exact, data


def case_in_c(case: cases.Case) -> tuple[model.World, mujoco.MjModel, mujoco.MjData]:
    """Builds the blocks of a case."""
    world = model.build(SceneConfig(slots=case.slots, min_blocks=1), SimConfig())
    return world, *in_c(world, case.scene)


def corners(exact: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Returns corners [V, 3] m of a geom in the world."""
    if exact.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = exact.geom_dataid[geom]
        start = exact.mesh_vertadr[mesh]
        local = exact.mesh_vert[start : start + exact.mesh_vertnum[mesh]]
    else:
        local = exact.geom_size[geom] * np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    return data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T
