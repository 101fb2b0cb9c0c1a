"""A scene as fields and state of MuJoCo's model, and back: what the engines share."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from csac_jax.robot.primitives import JointTrajectory
from csac_jax.world.model import BlockFields, World
from csac_jax.world.scene_state import SceneState

Base = Callable[[str], jax.Array]  # name of a model's field -> its values as compiled


def of_scene(world: World, fields: BlockFields, base: Base) -> dict[str, jax.Array]:
    """Returns fields of the model with this scene's blocks and fingers, by name."""
    geoms, bodies, dofs = world.block_geoms, world.block_bodies, world.block_dofs
    values: dict[str, tuple[Any, jax.Array]] = {
        "geom_size": (geoms, fields.size),
        "geom_pos": (geoms, fields.centre),
        "geom_rbound": (geoms, fields.rbound),
        "geom_friction": ((geoms, 0), fields.friction),
        "body_mass": (bodies, fields.mass),
        "body_inertia": (bodies, fields.inertia),
        "body_ipos": (bodies, fields.com),
        "body_invweight0": (bodies, fields.body_invweight),
        "dof_invweight0": (dofs, fields.dof_invweight),
    }
    changed = {name: base(name).at[index].set(rows) for name, (index, rows) in values.items()}
    if fields.grip is not None:
        of_pads = changed["geom_friction"].at[world.pads, 0]
        changed["geom_friction"] = of_pads.set(fields.grip.friction)
        force = base("actuator_forcerange").at[world.grip].set(fields.grip.force)
        changed["actuator_forcerange"] = force
    if fields.pads is not None:
        names = "geom_size", "geom_pos", "geom_rbound"
        for name, pads in zip(names, fields.pads, strict=True):
            changed[name] = changed[name].at[world.pads].set(pads)
    return changed


def subtree_mass(world: World, mass: jax.Array, base: Base) -> jax.Array:
    """Returns the field `body_subtreemass`, kg, where the blocks weigh `mass` [N] kg."""
    bodies = world.block_bodies
    added = jnp.sum(mass - base("body_mass")[bodies])
    return base("body_subtreemass").at[0].add(added).at[bodies].set(mass)


def start(
    world: World, scene: SceneState, joints: JointTrajectory, qpos: jax.Array, qvel: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns qpos and qvel with the scene's blocks, the robot at rest at its first set-point."""
    poses = jnp.concatenate([scene.position, scene.quaternion], axis=1)
    qpos = qpos.at[world.robot_qpos].set(joints.start).at[world.block_qpos].set(poses)
    return qpos, qvel.at[world.block_dofs].set(scene.velocity)


def moved(world: World, scene: SceneState, qpos: jax.Array, qvel: jax.Array) -> SceneState:
    """Returns the scene with its blocks at qpos [nq] and qvel [nv]."""
    pose, velocity = qpos[world.block_qpos], qvel[world.block_dofs]
    return scene.replace(position=pose[:, :3], quaternion=pose[:, 3:], velocity=velocity)
