"""One primitive of one scene in MJX: a fixed-length scan of physics steps."""

import dataclasses

import jax
import jax.numpy as jnp
from mujoco import mjx

from csac_jax.config import HeightmapConfig, SimConfig
from csac_jax.scene import layout
from csac_jax.scene.layout import Scene
from csac_jax.scene.model import World, box_fields, box_slots
from csac_jax.sim import primitives
from csac_jax.sim.outcome import Trace
from csac_jax.sim.primitives import Action

MAX_SPEED = 20.0  # m/s and rad/s / 10; a faster block has left physics behind
MAX_HEIGHT = 1.0  # m, likewise


@dataclasses.dataclass(frozen=True, eq=False)
class Physics:
    """A world on the device: closed over by the compiled step."""

    world: World
    model: mjx.Model
    data: mjx.Data  # blank state whose arrays fix shapes and dtypes


def make(world: World) -> Physics:
    """Physics of a world, MJX with its JAX implementation."""
    return Physics(world, mjx.put_model(world.model, impl="jax"), mjx.make_data(world.model, impl="jax"))


def _scene_model(physics: Physics, scene: Scene) -> mjx.Model:
    """The model with this scene's box sizes, masses and inertias."""
    world, model = physics.world, physics.model
    slots = box_slots(world)
    if slots.size == 0:
        return model
    fields = box_fields(scene.half_size[slots])
    geoms, bodies, dofs = world.block_geoms[slots], world.block_bodies[slots], world.block_dofs[slots]
    return model.replace(
        geom_size=model.geom_size.at[geoms].set(fields.size),
        geom_rbound=model.geom_rbound.at[geoms].set(fields.rbound),
        body_mass=model.body_mass.at[bodies].set(fields.mass),
        body_inertia=model.body_inertia.at[bodies].set(fields.inertia),
        body_invweight0=model.body_invweight0.at[bodies].set(fields.invweight),
        dof_invweight0=model.dof_invweight0.at[dofs].set(jnp.repeat(fields.invweight, 3, axis=1)),
    )


def _initial_data(physics: Physics, scene: Scene, start: jax.Array) -> mjx.Data:
    """Data with the scene's blocks and the hand at `start` [5], at rest."""
    world = physics.world
    poses = jnp.concatenate([scene.position, scene.quaternion], axis=1)
    qpos = physics.data.qpos.at[world.hand_qpos].set(jnp.append(start, start[4]))
    qpos = qpos.at[world.block_qpos].set(poses)
    qvel = physics.data.qvel.at[world.block_dofs].set(scene.velocity)
    return physics.data.replace(qpos=qpos, qvel=qvel, ctrl=start)


def _pin(world: World, parked: jax.Array, initial: mjx.Data, data: mjx.Data) -> mjx.Data:
    """Holds parked blocks [N] where they were."""
    address, dofs = world.block_qpos, world.block_dofs
    qpos = jnp.where(parked[:, None], initial.qpos[address], data.qpos[address])
    qvel = jnp.where(parked[:, None], 0.0, data.qvel[dofs])
    return data.replace(qpos=data.qpos.at[address].set(qpos), qvel=data.qvel.at[dofs].set(qvel))


def _pad_contacts(world: World, data: mjx.Data) -> tuple[jax.Array, jax.Array]:
    """Which hand geom touches which block [3, N] bool (palm, low pad, high pad), and if all contact slots are full."""
    contact = data._impl.contact
    active = contact.dist < 0.0  # [C]
    pair = contact.geom  # [C, 2]
    is_hand = jnp.any(pair[None] == world.hand_geoms[:, None, None], axis=-1) & active[None]  # [3, C]
    is_block = jnp.any(pair[None] == world.block_geoms[:, None, None], axis=-1)  # [N, C]
    return jnp.any(is_hand[:, None] & is_block[None], axis=-1), jnp.all(active)


def execute(
    physics: Physics, cfg: SimConfig, heightmap: HeightmapConfig, scene: Scene, height: jax.Array, action: Action
) -> tuple[Scene, Trace, primitives.Plan]:
    """Runs one primitive; blocks that end up in the hand are still in play, hanging where the hand is.

    Args: height [H, W] m, the map the action was chosen from.
    """
    world = physics.world
    model = _scene_model(physics, scene)
    motion = primitives.plan(cfg, heightmap, height, action)
    initial = _initial_data(physics, scene, motion.start)
    z_address = world.block_qpos[:, 2]
    finger = world.hand_qpos[4]
    close_end = sum(cfg.grasp_phases[:2])

    def substep(carry, x):
        data, trace = carry
        index, control = x
        data = _pin(world, ~scene.in_play, initial, mjx.step(model, data.replace(ctrl=control)))
        touching, full = _pad_contacts(world, data)
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
            saturated=trace.saturated + full.astype(jnp.int32),
        )
        return (data, trace), None

    zeros = jnp.zeros_like(scene.position[:, 2])
    blank = Trace(
        touched=jnp.zeros((), bool),
        held_rise=zeros,
        held=jnp.zeros_like(scene.in_play),
        rise=zeros,
        gap_closed=jnp.zeros(()),
        gap_end=jnp.zeros(()),
        saturated=jnp.zeros((), jnp.int32),
    )
    (data, trace), _ = jax.lax.scan(substep, (initial, blank), (jnp.arange(cfg.substeps), motion.control))
    pose = data.qpos[world.block_qpos]
    moved = scene.replace(position=pose[:, :3], quaternion=pose[:, 3:], velocity=data.qvel[world.block_dofs])
    return layout.park(moved, scene.in_play), trace, motion


def healthy(scene: Scene) -> jax.Array:
    """True where every block is finite, slow enough and near the table, [] bool. Bounds, since a lane may explode and
    stay finite."""
    speed = jnp.abs(scene.velocity) * jnp.array([1, 1, 1, 0.1, 0.1, 0.1])
    finite = jnp.all(jnp.isfinite(scene.position)) & jnp.all(jnp.isfinite(scene.quaternion))
    bounded = jnp.all(speed < MAX_SPEED) & jnp.all(
        jnp.where(scene.in_play[:, None], jnp.abs(scene.position), 0) < MAX_HEIGHT
    )
    return finite & bounded
