"""Primitives in MJX: a fixed-length scan of physics steps per scene; callers vmap."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import SimConfig
from csac_jax.errors import SceneError
from csac_jax.scene import layout
from csac_jax.scene.layout import Scene
from csac_jax.scene.model import World, scene_fields
from csac_jax.sim import mjx_step, outcome
from csac_jax.sim.outcome import Substep, Trace
from csac_jax.sim.primitives import JointTrajectory
from csac_jax.sim.quiet_mjx import mjx


@dataclasses.dataclass(frozen=True, eq=False)
class MjxPhysics:
    """A world on the device: closed over by the compiled step."""

    world: World
    cfg: SimConfig
    model: mjx.Model
    data: mjx.Data  # blank state whose arrays fix shapes and dtypes

    def run(self, scene: Scene, joints: JointTrajectory) -> tuple[Scene, Trace]:
        """See `physics.Physics`. Matrix products keep float32: a GPU would cut them to 10 bits."""
        world, model = self.world, scene_model(self, scene)
        initial = initial_data(self, scene, joints)

        def substep(data, control):
            data = mjx_step.step(model, data.replace(ctrl=control))
            data = _restrain(world, ~scene.in_play, initial, data)
            touching, overflow = _touch(world, data)
            rise = data.qpos[world.block_qpos[:, 2]] - scene.position[:, 2]
            gap = world.gripper.gap(data.qpos[world.finger_qpos], jnp)
            return data, Substep(touching, rise, gap, overflow)

        with jax.default_matmul_precision("highest"):
            data, seen = jax.lax.scan(substep, initial, joints.control)
        pose, velocity = data.qpos[world.block_qpos], data.qvel[world.block_dofs]
        moved = scene.replace(position=pose[:, :3], quaternion=pose[:, 3:], velocity=velocity)
        return layout.park(moved, scene.in_play), outcome.trace_of(self.cfg, seen)


def make(world: World, cfg: SimConfig) -> MjxPhysics:
    """Builds the physics of a world: MJX with its JAX implementation.

    Raises SceneError for MJCF that MJX lacks code for.
    """
    try:
        mjx_model = mjx.put_model(world.model, impl="jax")
    except NotImplementedError as error:
        raise SceneError(f"MJX cannot run the MJCF: {error}; take sim.physics c") from None
    return MjxPhysics(world, cfg, mjx_model, mjx.make_data(world.model, impl="jax"))


def scene_model(physics: MjxPhysics, scene: Scene) -> mjx.Model:
    """The model with this scene's block sizes, masses and frictions."""
    world, model = physics.world, physics.model
    fields = scene_fields(world, scene)
    geoms, bodies, dofs = world.block_geoms, world.block_bodies, world.block_dofs
    added_mass = jnp.sum(fields.mass - model.body_mass[bodies])
    subtree = model.body_subtreemass.at[0].add(added_mass)
    meshes = [  # None for a mesh that no slot uses; `face` repeats the corners of the faces
        mesh and mesh.replace(vert=mesh.vert * scale, face=mesh.face * scale)
        for mesh, scale in zip(model._impl.mesh_convex, fields.mesh_scale, strict=True)
    ]
    model = model.replace(_impl=model._impl.replace(mesh_convex=tuple(meshes)))
    model = model.replace(
        geom_size=model.geom_size.at[geoms].set(fields.size),
        geom_pos=model.geom_pos.at[geoms].set(fields.centre),
        geom_rbound=model.geom_rbound.at[geoms].set(fields.rbound),
        geom_friction=model.geom_friction.at[geoms, 0].set(fields.friction),
        body_mass=model.body_mass.at[bodies].set(fields.mass),
        body_subtreemass=subtree.at[bodies].set(fields.mass),
        body_inertia=model.body_inertia.at[bodies].set(fields.inertia),
        body_ipos=model.body_ipos.at[bodies].set(fields.com),
        body_invweight0=model.body_invweight0.at[bodies].set(fields.body_invweight),
        dof_invweight0=model.dof_invweight0.at[dofs].set(fields.dof_invweight),
    )
    if fields.pads is None:
        return model
    pads, (size, position, radius) = world.hand_geoms[1:], fields.pads
    return model.replace(
        geom_size=model.geom_size.at[pads].set(size),
        geom_pos=model.geom_pos.at[pads].set(position),
        geom_rbound=model.geom_rbound.at[pads].set(radius),
    )


def initial_data(physics: MjxPhysics, scene: Scene, joints: JointTrajectory) -> mjx.Data:
    """Data with the scene's blocks, and the robot at rest at its first set-point."""
    world = physics.world
    poses = jnp.concatenate([scene.position, scene.quaternion], axis=1)
    qpos = physics.data.qpos.at[world.robot_qpos].set(joints.start)
    qpos = qpos.at[world.block_qpos].set(poses)
    qvel = physics.data.qvel.at[world.block_dofs].set(scene.velocity)
    return physics.data.replace(qpos=qpos, qvel=qvel, ctrl=joints.control[0])


def _restrain(world: World, parked: jax.Array, initial: mjx.Data, data: mjx.Data) -> mjx.Data:
    """Holds parked blocks [N] where they were, the others to SPEED_LIMIT."""
    address, dofs = world.block_qpos, world.block_dofs
    qpos = jnp.where(parked[:, None], initial.qpos[address], data.qpos[address])
    limited = jnp.clip(data.qvel[dofs], -layout.SPEED_LIMIT, layout.SPEED_LIMIT)
    qvel = jnp.where(parked[:, None], 0.0, limited)
    return data.replace(qpos=data.qpos.at[address].set(qpos), qvel=data.qvel.at[dofs].set(qvel))


def _touch(world: World, data: mjx.Data) -> tuple[jax.Array, jax.Array]:
    """Which of palm and pads touches which block, [3, N] bool, and whether contacts may be missing,
    [] bool: once all slots are in use."""
    active, pair = data._impl.contact.dist < 0.0, data._impl.contact.geom  # [C], [C, 2]
    is_pad = jnp.any(pair[None] == world.hand_geoms[:, None, None], axis=-1)
    is_hand = is_pad & active[None]  # [3, C]
    slots = jnp.asarray(world.slot_of_geom)[pair]  # [C, 2]
    is_block = jnp.any(slots[None] == np.arange(len(world.slots))[:, None, None], axis=-1)  # [N, C]
    return jnp.any(is_hand[:, None] & is_block[None], axis=-1), jnp.all(active)
