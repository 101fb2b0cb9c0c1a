"""Primitives on MuJoCo Warp: all substeps of many scenes are one call, see `warp_action`.

The meshes of blocks have one size in all scenes; those of objects differ between scenes. Results
are not repeatable bit for bit. The set-points of a primitive are read at Warp's own times, see
`warp_action.STEP`.
"""

import dataclasses
import functools
import importlib.util
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import MESH_KINDS, SimConfig
from csac_jax.errors import SceneError
from csac_jax.scene import layout
from csac_jax.scene.bodies import Bodies, ObjectFields, PartFields
from csac_jax.scene.layout import Scene
from csac_jax.scene.model import World, scene_fields
from csac_jax.sim.outcome import Trace
from csac_jax.sim.primitives import JointTrajectory


@dataclasses.dataclass(frozen=True, eq=False)
class WarpPhysics:
    """A world on Warp; every batch of scenes lies on the device once it has been used."""

    world: World
    simulator: Any
    """`warp_action.Simulator`"""

    @functools.cached_property
    def _simulate(self) -> Callable[[dict[str, jax.Array]], dict[str, jax.Array]]:
        return _flat_vmap(lambda inputs: self.simulator(**inputs))

    def run(self, scene: Scene, joints: JointTrajectory) -> tuple[Scene, Trace]:
        """See `physics.Physics`."""
        world = self.world
        scene = layout.park(scene, scene.in_play)  # where nothing meets them
        given = inputs(self, scene, joints)
        results = self._simulate(jax.tree.map(lambda leaf: leaf[None], given))
        results = jax.tree.map(lambda leaf: leaf[0], results)
        for name in ("gap_closed", "gap_end"):
            results[name] = world.gripper.gap(results[name], jnp)
        # XLA runs a call twice on a GPU if a scan stores one of its results unchanged.
        results["contact_overflow"] = results["contact_overflow"].astype(jnp.int32)
        pose, velocity = results.pop("qpos")[world.block_qpos], results.pop("qvel")
        moved = scene.replace(
            position=pose[:, :3], quaternion=pose[:, 3:], velocity=velocity[world.block_dofs]
        )
        return moved, Trace(**results)


def make(world: World, cfg: SimConfig) -> WarpPhysics:
    """Physics of a world on Warp. Raises SceneError where Warp is not installed."""
    if importlib.util.find_spec("warp") is None:
        raise SceneError("sim.physics: warp is an extra; run: pip install 'csac-jax[warp]'")
    from csac_jax.sim import warp_action

    return WarpPhysics(world, warp_action.Simulator(world, cfg))


def inputs(physics: WarpPhysics, scene: Scene, joints: JointTrajectory) -> dict[str, jax.Array]:
    """What a simulator is given of a scene whose blocks out of play are parked."""
    world = physics.world
    control = _resampled(joints.control, physics.simulator.substeps)
    start = _start(world, scene, joints)
    return {**_model_fields(world, scene), **start, "control": control, "in_play": scene.in_play}


def _flat_vmap(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A function of leaves [E, ...], whose vmap gives it leaves [S * E, ...]."""
    flat = jax.custom_batching.custom_vmap(function)

    @flat.def_vmap
    def _(size: int, batched: Any, inputs: Any) -> tuple[Any, Any]:
        def join(leaf: jax.Array, is_batched: bool) -> jax.Array:
            every = leaf if is_batched else jnp.broadcast_to(leaf[None], (size, *leaf.shape))
            return every.reshape(-1, *every.shape[2:])

        results = flat(jax.tree.map(join, inputs, *batched))
        split = jax.tree.map(lambda leaf: leaf.reshape(size, -1, *leaf.shape[1:]), results)
        return split, jax.tree.map(lambda _: True, split)

    return flat


def _model_fields(world: World, scene: Scene) -> dict[str, jax.Array]:
    """The model's fields with this scene's block sizes, masses and frictions."""
    model, fields = world.model, scene_fields(world, scene)
    geoms, bodies, dofs = world.block_geoms, world.block_bodies, world.block_dofs
    is_mesh = np.array([kind in MESH_KINDS for kind in world.slots])[world.parts.slot]
    bounds = jnp.stack([jnp.zeros_like(fields.size), fields.size], axis=1)  # centre, half size
    bounds = jnp.where(is_mesh[:, None, None], model.geom_aabb[geoms].reshape(-1, 2, 3), bounds)
    mass = jnp.asarray(model.body_mass, jnp.float32)

    def base(name: str) -> jax.Array:
        return jnp.asarray(getattr(model, name), jnp.float32)

    found = {
        "geom_size": base("geom_size").at[geoms].set(fields.size),
        "geom_pos": base("geom_pos").at[geoms].set(fields.centre),
        "geom_aabb": base("geom_aabb").reshape(-1, 2, 3).at[geoms].set(bounds),
        "geom_rbound": base("geom_rbound").at[geoms].set(fields.rbound),
        "geom_friction": base("geom_friction").at[geoms, 0].set(fields.friction),
        "body_mass": mass.at[bodies].set(fields.mass),
        "body_inertia": base("body_inertia").at[bodies].set(fields.inertia),
        "body_ipos": base("body_ipos").at[bodies].set(fields.com),
        "body_invweight0": base("body_invweight0").at[bodies].set(fields.body_invweight),
        "dof_invweight0": base("dof_invweight0").at[dofs].set(fields.dof_invweight),
    }
    if fields.pads is not None:
        pads, (size, position, radius) = world.hand_geoms[1:], fields.pads
        found["geom_size"] = found["geom_size"].at[pads].set(size)
        found["geom_pos"] = found["geom_pos"].at[pads].set(position)
        found["geom_rbound"] = found["geom_rbound"].at[pads].set(radius)
        bounds = jnp.stack([jnp.zeros_like(size), size], axis=1)
        found["geom_aabb"] = found["geom_aabb"].at[pads].set(bounds)
    if world.objects is not None and fields.objects is not None:
        found |= {name: base(name) for name in ("geom_quat", "body_iquat")}
        found["geom_dataid"] = jnp.asarray(model.geom_dataid)
        for name, index, values in _of_objects(world, world.objects, fields.objects):
            found[name] = found[name].at[index].set(values)
    own = base("body_subtreemass").at[bodies].set(found["body_mass"][bodies])
    added = jnp.sum(found["body_mass"][bodies] - mass[bodies])
    return found | {"body_subtreemass": own.at[0].add(added)}


def _of_objects(world: World, own: Bodies, fields: ObjectFields) -> Iterator[tuple[str, Any, Any]]:
    """Fields of the model, where objects have theirs, and what is there in a scene.

    Parts that an object lacks have no mesh. A body's frame is at its centre of mass, so that a push
    there turns it no way: its inverse weights are 1/m and the mean of 1/I.
    """
    number, (bodies, geoms) = fields.number, (own.bodies, own.geoms)

    def known(rows: np.ndarray) -> jax.Array:
        return jnp.asarray(rows, rows.dtype if rows.dtype == bool else jnp.float32)[number]

    part: PartFields = jax.tree.map(known, own.parts)
    meshes = jnp.asarray(own.meshes, jnp.int32)[number]
    yield "geom_dataid", geoms, jnp.where(known(own.tables.present), meshes, -1)
    yield "geom_pos", geoms, part.position
    yield "geom_quat", geoms, part.quaternion
    yield "geom_size", geoms, part.size
    yield "geom_rbound", geoms, part.radius
    yield "geom_aabb", geoms, part.box
    yield "geom_friction", (geoms, 0), fields.friction[:, None]
    mass = fields.density * known(own.tables.volume)
    inertia = fields.density[:, None] * known(own.tables.moments)
    yield "body_mass", bodies, mass
    yield "body_inertia", bodies, inertia
    yield "body_iquat", bodies, known(own.tables.axes)
    yield "body_ipos", bodies, 0.0
    weights = jnp.stack([1.0 / mass, jnp.mean(1.0 / inertia, axis=1)], axis=1)
    yield "body_invweight0", bodies, weights
    yield "dof_invweight0", world.block_dofs[own.slots], jnp.repeat(weights, 3, axis=1)


def _resampled(control: jax.Array, substeps: int) -> jax.Array:
    """Set-points [T, U] at as many times as there are `substeps`, the last time the same."""
    given = len(control)
    time = np.arange(1, substeps + 1) * (given / substeps) - 1.0  # in rows of the set-points
    before = np.minimum(time.astype(int), given - 1)
    after, share = np.minimum(before + 1, given - 1), (time - before)[:, None]
    return control[before] + jnp.asarray(share, jnp.float32) * (control[after] - control[before])


def _start(world: World, scene: Scene, joints: JointTrajectory) -> dict[str, jax.Array]:
    """The blocks of the scene, and the robot at rest at its first set-point."""
    poses = jnp.concatenate([scene.position, scene.quaternion], axis=1)
    qpos = jnp.asarray(world.model.qpos0, jnp.float32).at[world.robot_qpos].set(joints.start)
    qvel = jnp.zeros(world.model.nv).at[world.block_dofs].set(scene.velocity)
    return {"qpos": qpos.at[world.block_qpos].set(poses), "qvel": qvel}
