"""Primitives in MJX: a fixed-length scan of physics steps per scene; callers vmap."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import SimConfig
from csac_jax.errors import SceneError
from csac_jax.robot.primitives import JointTrajectory
from csac_jax.sim import mjx_step, model_fields, outcome
from csac_jax.sim.outcome import Substep, Trace
from csac_jax.sim.quiet_mjx import mjx
from csac_jax.world import scene_state
from csac_jax.world.model import World, scene_fields
from csac_jax.world.scene_state import SceneState


class MjxPhysics:
    """A world on the device, which the compiled step closes over."""

    def __init__(self, world: World, cfg: SimConfig) -> None:
        """Raises SceneError for MJCF that MJX lacks code for."""
        self.world, self.cfg = world, cfg
        try:
            self.model = mjx.put_model(world.model, impl="jax")
        except NotImplementedError as error:
            raise SceneError(f"MJX cannot run the MJCF: {error}; take sim.physics c") from None
        self.data = mjx.make_data(world.model, impl="jax")  # blank, fixes shapes and dtypes

    def run(self, scene: SceneState, joints: JointTrajectory) -> tuple[SceneState, Trace]:
        """Runs one primitive; matrix products keep float32, which a GPU would cut to 10 bits."""
        world, model = self.world, scene_model(self, scene)
        initial = initial_data(self, scene, joints)

        def substep(data, control):
            data = mjx_step.step(model, data.replace(ctrl=control))
            data = _restrain(world, ~scene.in_play, initial, data)
            touching, overflow = _touch(world, data)
            rise = data.qpos[world.block_qpos[:, 2]] - scene.position[:, 2]
            gap = world.gripper.gap(data.qpos[world.finger_qpos], jnp)
            lag = data.qpos[world.press_qpos] - control[world.press]
            return data, Substep(touching, rise, gap, lag, overflow)

        with jax.default_matmul_precision("highest"):
            data, substeps = jax.lax.scan(substep, initial, joints.control)
        moved = model_fields.moved(world, scene, data.qpos, data.qvel)
        return scene_state.park(moved, scene.in_play), outcome.trace_of(self.cfg, substeps)


def scene_model(physics: MjxPhysics, scene: SceneState) -> mjx.Model:
    """Returns the model with this scene's blocks."""
    world, model = physics.world, physics.model
    fields = scene_fields(world, scene)
    meshes = [  # None for a mesh that no slot uses; `face` repeats the corners of the faces
        mesh and mesh.replace(vert=mesh.vert * scale, face=mesh.face * scale)
        for mesh, scale in zip(model._impl.mesh_convex, fields.mesh_scale, strict=True)
    ]
    base = functools.partial(getattr, model)
    return model.replace(
        _impl=model._impl.replace(mesh_convex=tuple(meshes)),
        body_subtreemass=model_fields.subtree_mass(world, fields.mass, base),
        **model_fields.of_scene(world, fields, base),
    )


def initial_data(physics: MjxPhysics, scene: SceneState, joints: JointTrajectory) -> mjx.Data:
    """Returns data with the scene's blocks, and the robot at rest at its first set-point."""
    blank = physics.data
    qpos, qvel = model_fields.start(physics.world, scene, joints, blank.qpos, blank.qvel)
    return blank.replace(qpos=qpos, qvel=qvel, ctrl=joints.control[0])


def _restrain(world: World, parked: jax.Array, initial: mjx.Data, data: mjx.Data) -> mjx.Data:
    """Holds parked blocks [N] where they were, the others to SPEED_LIMIT."""
    address, dofs = world.block_qpos, world.block_dofs
    qpos = jnp.where(parked[:, None], initial.qpos[address], data.qpos[address])
    limited = jnp.clip(data.qvel[dofs], -scene_state.SPEED_LIMIT, scene_state.SPEED_LIMIT)
    qvel = jnp.where(parked[:, None], 0.0, limited)
    return data.replace(qpos=data.qpos.at[address].set(qpos), qvel=data.qvel.at[dofs].set(qvel))


def _touch(world: World, data: mjx.Data) -> tuple[jax.Array, jax.Array]:
    """Returns [3, N] bool, palm or finger touches block, and [] bool, all contacts are in use."""
    active, pair = data._impl.contact.dist < 0.0, data._impl.contact.geom  # [C], [C, 2]
    part_of_geom = np.full(world.model.ngeom, -1, np.int32)
    part_of_geom[world.hand_geoms] = world.hand_parts
    parts = jnp.asarray(part_of_geom)[pair]  # [C, 2]
    of_part = jnp.any(parts[None] == np.arange(outcome.PARTS)[:, None, None], axis=-1)
    is_hand = of_part & active[None]  # [3, C]
    slots = jnp.asarray(world.slot_of_geom)[pair]  # [C, 2]
    is_block = jnp.any(slots[None] == np.arange(len(world.slots))[:, None, None], axis=-1)  # [N, C]
    return jnp.any(is_hand[:, None] & is_block[None], axis=-1), jnp.all(active)
