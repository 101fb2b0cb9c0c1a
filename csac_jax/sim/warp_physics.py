"""Primitives on MuJoCo Warp: all substeps of many scenes are one call, see `warp_action`.

Meshes of blocks have one size in all scenes. Results are not repeatable bit for bit.
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
from csac_jax.robot.primitives import JointTrajectory
from csac_jax.sim import model_fields
from csac_jax.sim.outcome import Trace
from csac_jax.world import scene_state
from csac_jax.world.model import World, scene_fields
from csac_jax.world.object_models import Bodies, ObjectFields, PartFields
from csac_jax.world.scene_state import SceneState


@dataclasses.dataclass(frozen=True, eq=False)
class WarpPhysics:
    """A world on Warp; a batch of scenes stays on the device after its first use."""

    world: World
    simulator: Any  # `warp_action.WarpSimulator`

    @functools.cached_property
    def _simulate(self) -> Callable[[dict[str, jax.Array]], dict[str, jax.Array]]:
        return _flat_vmap(lambda inputs: self.simulator(**inputs))

    @functools.cached_property
    def _start(self) -> Callable[[dict[str, jax.Array]], jax.Array]:
        return _flat_vmap(lambda inputs: self.simulator.start(**inputs))

    @functools.cached_property
    def _finish(self) -> Callable[[tuple[jax.Array, jax.Array]], dict[str, jax.Array]]:
        return _flat_vmap(lambda inputs: self.simulator.finish(*inputs))

    def run(self, scene: SceneState, joints: JointTrajectory) -> tuple[SceneState, Trace]:
        """Runs one primitive, see `physics.Physics`."""
        return self._result(scene, self._simulate(_batch(inputs(self, _parked(scene), joints))))

    def start(self, scene: SceneState, joints: JointTrajectory) -> jax.Array:
        """Starts one primitive on a stream of its own; returns a token [] for `finish`."""
        return self._start(_batch(inputs(self, _parked(scene), joints)))[0]

    def finish(
        self, scene: SceneState, token: jax.Array, after: jax.Array
    ) -> tuple[SceneState, Trace]:
        """Waits for the primitive of a token [] once `after` [] was computed; results of `run`."""
        return self._result(scene, self._finish(_batch((token, after))))

    def _result(self, scene: SceneState, results: dict) -> tuple[SceneState, Trace]:
        results = jax.tree.map(lambda leaf: leaf[0], results)
        for name in ("gap_closed", "gap_end"):
            results[name] = self.world.gripper.gap(results[name], jnp)
        # XLA runs a call twice on a GPU if a scan stores one of its results unchanged.
        results["contact_overflow"] = results["contact_overflow"].astype(jnp.int32)
        state = results.pop("qpos"), results.pop("qvel")
        return model_fields.moved(self.world, _parked(scene), *state), Trace(**results)


def _parked(scene: SceneState) -> SceneState:
    """Returns the scene with blocks out of play where nothing meets them."""
    return scene_state.park(scene, scene.in_play)


def _batch(tree: Any) -> Any:
    """Returns leaves [1, ...] of a scene's [...]."""
    return jax.tree.map(lambda leaf: leaf[None], tree)


def make(world: World, cfg: SimConfig) -> WarpPhysics:
    """Makes the physics of a world on Warp. Raises SceneError where Warp is not installed."""
    if importlib.util.find_spec("warp") is None:
        raise SceneError("sim.physics: warp is an extra; run: pip install 'csac-jax[warp]'")
    from csac_jax.sim import warp_action

    return WarpPhysics(world, warp_action.WarpSimulator(world, cfg))


def inputs(
    physics: WarpPhysics, scene: SceneState, joints: JointTrajectory
) -> dict[str, jax.Array]:
    """Returns a simulator's arguments for a scene whose blocks out of play are parked."""
    world = physics.world
    control = _resampled(joints.control, physics.simulator.substeps)
    blank = jnp.asarray(world.model.qpos0, jnp.float32), jnp.zeros(world.model.nv)
    qpos, qvel = model_fields.start(world, scene, joints, *blank)
    state = {"qpos": qpos, "qvel": qvel, "control": control, "in_play": scene.in_play}
    return _model_fields(world, scene) | state


def _flat_vmap(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Returns a function of leaves [E, ...], whose vmap calls it with leaves [S * E, ...]."""
    flat = jax.custom_batching.custom_vmap(function)

    @flat.def_vmap
    def _(size: int, batched: Any, inputs: Any) -> tuple[Any, Any]:
        def join(leaf: jax.Array, is_batched: bool) -> jax.Array:
            full = leaf if is_batched else jnp.broadcast_to(leaf[None], (size, *leaf.shape))
            return full.reshape(-1, *full.shape[2:])

        results = flat(jax.tree.map(join, inputs, *batched))
        split = jax.tree.map(lambda leaf: leaf.reshape(size, -1, *leaf.shape[1:]), results)
        return split, jax.tree.map(lambda _: True, split)

    return flat


def _model_fields(world: World, scene: SceneState) -> dict[str, jax.Array]:
    model, fields = world.model, scene_fields(world, scene)
    geoms, bodies = world.block_geoms, world.block_bodies

    def base(name: str) -> jax.Array:
        return jnp.asarray(getattr(model, name), jnp.float32)

    changed = model_fields.of_scene(world, fields, base)
    is_mesh = np.array([kind in MESH_KINDS for kind in world.slots])[world.parts.slot]
    compiled = model.geom_aabb[geoms].reshape(-1, 2, 3)
    bounds = jnp.where(is_mesh[:, None, None], compiled, _bounds(fields.size))
    changed["geom_aabb"] = base("geom_aabb").reshape(-1, 2, 3).at[geoms].set(bounds)
    if fields.pads is not None:
        pads = _bounds(fields.pads.size)
        changed["geom_aabb"] = changed["geom_aabb"].at[world.pads].set(pads)
    if world.objects is not None and fields.objects is not None:
        changed |= {name: base(name) for name in ("geom_quat", "body_iquat")}
        changed["geom_dataid"] = jnp.asarray(model.geom_dataid)
        for name, index, values in _of_objects(world, world.objects, fields.objects):
            changed[name] = changed[name].at[index].set(values)
    subtree = model_fields.subtree_mass(world, changed["body_mass"][bodies], base)
    return changed | {"body_subtreemass": subtree}


def _bounds(half: jax.Array) -> jax.Array:
    """Returns bounding boxes [G, 2, 3] m, centre and half sizes, of boxes of half sizes [G, 3]."""
    return jnp.stack([jnp.zeros_like(half), half], axis=1)


def _of_objects(
    world: World, objects: Bodies, fields: ObjectFields
) -> Iterator[tuple[str, Any, Any]]:
    """Yields names of the model's fields, the places of objects in them and a scene's values."""
    number, (bodies, geoms) = fields.number, (objects.bodies, objects.geoms)

    def known(rows: np.ndarray) -> jax.Array:
        return jnp.asarray(rows, rows.dtype if rows.dtype == bool else jnp.float32)[number]

    part: PartFields = jax.tree.map(known, objects.parts)
    meshes = jnp.asarray(objects.meshes, jnp.int32)[number]
    yield "geom_dataid", geoms, jnp.where(known(objects.tables.present), meshes, -1)
    yield "geom_pos", geoms, part.position
    yield "geom_quat", geoms, part.quaternion
    yield "geom_size", geoms, part.size
    yield "geom_rbound", geoms, part.radius
    yield "geom_aabb", geoms, part.box
    yield "geom_friction", (geoms, 0), fields.friction[:, None]
    mass = fields.density * known(objects.tables.volume)
    inertia = fields.density[:, None] * known(objects.tables.moments)
    yield "body_mass", bodies, mass
    yield "body_inertia", bodies, inertia
    yield "body_iquat", bodies, known(objects.tables.axes)
    yield "body_ipos", bodies, 0.0  # so a push there does not turn it: 1/m and the mean of 1/I
    weights = jnp.stack([1.0 / mass, jnp.mean(1.0 / inertia, axis=1)], axis=1)
    yield "body_invweight0", bodies, weights
    yield "dof_invweight0", world.block_dofs[objects.slots], jnp.repeat(weights, 3, axis=1)


def _resampled(control: jax.Array, substeps: int) -> jax.Array:
    """Interpolates set-points [T, U] at `substeps` times; the last time is the same."""
    rows = len(control)
    time = np.arange(1, substeps + 1) * (rows / substeps) - 1.0  # in rows of the set-points
    before = np.minimum(time.astype(int), rows - 1)
    after, share = np.minimum(before + 1, rows - 1), (time - before)[:, None]
    return control[before] + jnp.asarray(share, jnp.float32) * (control[after] - control[before])
