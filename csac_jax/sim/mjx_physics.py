"""Primitives in MJX: a fixed-length scan of physics steps per scene; callers vmap."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from csac_jax.config import SimConfig
from csac_jax.scene import layout
from csac_jax.scene.layout import Scene
from csac_jax.scene.model import World, scene_fields
from csac_jax.sim import mjx_step, outcome
from csac_jax.sim.outcome import Trace
from csac_jax.sim.robot import Drive


@dataclasses.dataclass(frozen=True, eq=False)
class MjxPhysics:
    """A world on the device: closed over by the compiled step."""

    world: World
    cfg: SimConfig
    model: mjx.Model
    data: mjx.Data  # blank state whose arrays fix shapes and dtypes
    touch: Callable[[World, mjx.Data], tuple[jax.Array, jax.Array]]
    """Which of HAND_GEOMS touches which block, [3, N] bool, and whether contacts may be missing, []
    bool."""
    step: Callable[[mjx.Model, mjx.Data], mjx.Data] = mjx.step

    def run(self, scene: Scene, drive: Drive) -> tuple[Scene, Trace]:
        """See `physics.Physics`. Products of matrices keep float32's precision: a GPU would cut
        them to 10 bits."""
        with jax.default_matmul_precision("highest"):
            return _run(self, scene, drive)


def make(world: World, cfg: SimConfig) -> MjxPhysics:
    """Physics of a world, MJX with its JAX implementation."""
    mjx_model, data = mjx.put_model(world.model, impl="jax"), mjx.make_data(world.model, impl="jax")
    return MjxPhysics(world, cfg, mjx_model, data, _pad_contacts, mjx_step.step)


def scene_model(physics: MjxPhysics, scene: Scene) -> mjx.Model:
    """The model with this scene's block sizes, masses and frictions."""
    world, model = physics.world, physics.model
    fields = scene_fields(world, scene)
    geoms, bodies, dofs = world.block_geoms, world.block_bodies, world.block_dofs
    subtree = model.body_subtreemass.at[0].add(
        jnp.sum(fields.mass - model.body_mass[bodies])
    )  # all; then each block
    if model.impl == mjx.Impl.JAX:
        meshes = [  # None for a mesh that no slot uses; `face` holds the corners of the faces once more
            mesh and mesh.replace(vert=mesh.vert * scale, face=mesh.face * scale)
            for mesh, scale in zip(model._impl.mesh_convex, fields.mesh_scale, strict=True)
        ]
        model = model.replace(_impl=model._impl.replace(mesh_convex=tuple(meshes)))
    return model.replace(
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


def initial_data(physics: MjxPhysics, scene: Scene, drive: Drive) -> mjx.Data:
    """Data with the scene's blocks and the robot where the drive starts, at rest."""
    world = physics.world
    poses = jnp.concatenate([scene.position, scene.quaternion], axis=1)
    qpos = physics.data.qpos.at[world.robot_qpos].set(drive.start)
    qpos = qpos.at[world.block_qpos].set(poses)
    qvel = physics.data.qvel.at[world.block_dofs].set(scene.velocity)
    return physics.data.replace(qpos=qpos, qvel=qvel, ctrl=drive.control[0])


def _restrain(world: World, parked: jax.Array, initial: mjx.Data, data: mjx.Data) -> mjx.Data:
    """Holds parked blocks [N] where they were, the others to SPEED_LIMIT."""
    address, dofs = world.block_qpos, world.block_dofs
    qpos = jnp.where(parked[:, None], initial.qpos[address], data.qpos[address])
    limited = jnp.clip(data.qvel[dofs], -layout.SPEED_LIMIT, layout.SPEED_LIMIT)
    qvel = jnp.where(parked[:, None], 0.0, limited)
    return data.replace(qpos=data.qpos.at[address].set(qpos), qvel=data.qvel.at[dofs].set(qvel))


def _pad_contacts(world: World, data: mjx.Data) -> tuple[jax.Array, jax.Array]:
    """See `MjxPhysics.touch`; contacts may be missing once all slots are full."""
    contact = data._impl.contact
    active = contact.dist < 0.0  # [C]
    pair = contact.geom  # [C, 2]
    is_hand = (
        jnp.any(pair[None] == world.hand_geoms[:, None, None], axis=-1) & active[None]
    )  # [3, C]
    slots = jnp.asarray(world.slot_of_geom)[pair]  # [C, 2]
    is_block = jnp.any(slots[None] == np.arange(len(world.slots))[:, None, None], axis=-1)  # [N, C]
    return jnp.any(is_hand[:, None] & is_block[None], axis=-1), jnp.all(active)


def _run(physics: MjxPhysics, scene: Scene, drive: Drive) -> tuple[Scene, Trace]:
    """The primitive's substeps; blocks that end up in the hand are still in play, hanging where the
    hand is."""
    world, cfg = physics.world, physics.cfg
    model = scene_model(physics, scene)
    initial = initial_data(physics, scene, drive)
    z_address = world.block_qpos[:, 2]
    finger = world.robot_qpos[-2]
    close_end = sum(cfg.grasp_phases[:2])

    def substep(carry, x):
        data, trace = carry
        index, control = x
        data = _restrain(
            world, ~scene.in_play, initial, physics.step(model, data.replace(ctrl=control))
        )
        touching, full = physics.touch(world, data)
        held = touching[1] & touching[2]
        rise = data.qpos[z_address] - scene.position[:, 2]
        gap = 2.0 * data.qpos[finger]
        trace = Trace(
            touched=trace.touched | jnp.any(touching),
            held_rise=jnp.maximum(trace.held_rise, jnp.where(held, rise, 0.0)),
            held=held,
            rise=rise,
            gap_closed=jnp.where(index == close_end - 1, gap, trace.gap_closed),
            gap_end=gap,
            contact_overflow=trace.contact_overflow + full.astype(jnp.int32),
        )
        return (data, trace), None

    (data, trace), _ = jax.lax.scan(
        substep,
        (initial, outcome.blank(len(world.slots))),
        (jnp.arange(cfg.substeps), drive.control),
    )
    pose = data.qpos[world.block_qpos]
    moved = scene.replace(
        position=pose[:, :3], quaternion=pose[:, 3:], velocity=data.qvel[world.block_dofs]
    )
    return layout.park(moved, scene.in_play), trace
