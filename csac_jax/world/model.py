"""MJCF files to one MuJoCo model, and the addresses in it that later stages need."""

import copy
import dataclasses
import functools
import hashlib
import itertools
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from scipy.spatial.transform import Rotation

from csac_jax import grippers
from csac_jax.assets import assets
from csac_jax.config import MESH_KINDS, SceneConfig, SimConfig, SlotKind
from csac_jax.errors import SceneError
from csac_jax.grippers import NUMBERS, Fingers, Grip, Gripper
from csac_jax.robot import mjcf
from csac_jax.section import require
from csac_jax.world import blocks, object_models as objects, object_slots, scene_state, tray
from csac_jax.world.blocks import Parts
from csac_jax.world.object_models import Bodies, ObjectFields
from csac_jax.world.scene_state import SceneState

LARGEST = 1.25  # compiled over nominal block size: C culls pairs by the bounds it was compiled with
HAND_PARK_HEIGHT = 10.0  # m, where the hand waits while blocks settle: above the highest drop
_CONE_IMPEDANCE = 10.0  # of friction over that of the normal force, with objects (ours)
_CONE_EFFORT = 20, 50  # iterations of the solver, of a line search: 20 of these are too few (ours)
_MJX_IGNORES = (  # fields of a model that MJX never reads; 0 unless MJCF sets them
    *("opt.noslip_iterations", "jnt_stiffnesspoly", "dof_dampingpoly"),
    *("tendon_stiffnesspoly", "tendon_dampingpoly", "geom_gap", "geom_fluid", "geom_adhesion"),
    *("geom_surfacevel", "pair_gap", "pair_adhesion", "actuator_actearly", "actuator_armature"),
    *("actuator_damping", "actuator_dampingpoly", "actuator_delay"),
)


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """A compiled model and the addresses in it. N = block slots, G = convex parts of blocks."""

    model: mujoco.MjModel
    slots: tuple[SlotKind, ...]
    parts: Parts
    block_bodies: np.ndarray  # [N] body ids
    block_geoms: np.ndarray  # [G] geom ids
    block_qpos: np.ndarray  # [N, 7] addresses in qpos: position, quaternion
    block_dofs: np.ndarray  # [N, 6] addresses in qvel
    slot_of_geom: np.ndarray  # [geoms] slot that a geom belongs to, -1 if it is no block's
    robot_qpos: np.ndarray  # [Q] addresses in qpos, the gripper's joints last
    gripper: Gripper
    press_qpos: int  # address in qpos of the joint that gives way to more than sim.down_force
    press: int  # its actuator
    grip: int  # actuator of the fingers
    pads: np.ndarray  # [2] geom ids, low and high
    hand_geoms: np.ndarray  # [M] geom ids: palm, low finger's, high finger's
    hand_parts: np.ndarray  # [M] of these: 0, 1 or 2
    mesh_scale: float  # size of compiled meshes of blocks relative to nominal
    objects: Bodies | None = None  # of slots of kind object; None without such slots

    @functools.cached_property
    def digest(self) -> str:
        """Returns a SHA-256 of model, slots and objects' densities, equal in every process."""
        stored = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, stored)
        heaviness = () if self.objects is None else self.objects.tables.heaviness.tolist()
        content = stored.tobytes() + repr((self.slots, heaviness)).encode()
        return hashlib.sha256(content).hexdigest()

    @property
    def finger_qpos(self) -> int:
        """Returns the address in qpos of the joint that the gripper's opening is read from."""
        return int(self.robot_qpos[-len(self.gripper.joints)])


def _spec(scene: SceneConfig, sim: SimConfig, gripper: Gripper) -> mujoco.MjSpec:
    spec = mjcf.read(assets() / "table.xml")
    mjcf.add(spec, sim, gripper)
    # Warp's meshes have one size in all scenes.
    _add_block_assets(spec, 1.0 if sim.physics == "warp" else LARGEST)
    library = object_slots.library(scene) if scene.has_objects else None
    if library is not None:
        objects.add_meshes(spec, library)
        # Faster, measured: objects have few parts, and most of them sleep.
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        # With friction pyramids, as blocks have them, a held object creeps out of the hand.
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = _CONE_IMPEDANCE
    if scene.tray:
        _add_walls(spec, scene.tray)
    for slot, place in enumerate(scene_state.parking(len(scene.slots))):
        body = spec.worldbody.add_body(name=f"block{slot}", pos=place)
        body.add_freejoint(name=f"block{slot}")
        if library is not None and scene.slots[slot] == "object":
            objects.add_geoms(spec, body, library)
        else:
            _add_parts(spec, body, scene.slots[slot])
    if sim.physics == "c":  # the others read their contacts instead
        _add_touch_sensors(spec, gripper, len(scene.slots))
    spec.option.timestep = sim.timestep
    effort = (sim.iterations, sim.line_search) if library is None else _CONE_EFFORT
    spec.option.iterations, spec.option.ls_iterations = effort
    # MJX sorts pairs by bounding spheres: those of the long walls are always near.
    extra = tray.NUMBER * (len(scene.slots) + 1) if scene.tray else 0
    spec.add_numeric(name="max_geom_pairs", data=[sim.geom_pairs + extra])
    spec.add_numeric(name="max_contact_points", data=[sim.contacts])
    return spec


def _add_walls(spec: mujoco.MjSpec, side: float) -> None:
    for number, (centre, half) in enumerate(zip(*tray.walls(side), strict=True)):
        wall = spec.worldbody.add_geom(name=f"wall{number}", type=mujoco.mjtGeom.mjGEOM_BOX)
        wall.pos, wall.size, wall.rgba = centre, half, [*tray.COLOUR, 1.0]
        wall.contype, wall.conaffinity = 1, 3  # against blocks and hand
        wall.friction = spec.geom("table").friction


def _add_block_assets(spec: mujoco.MjSpec, mesh_scale: float) -> None:
    path = assets() / "blocks.xml"
    part = mjcf.read(path)
    mjcf.require(path, "mesh", MESH_KINDS, part.meshes)
    if part.find_default("block") is None:
        raise SceneError(f"{path}: default class 'block' is missing")
    for mesh in part.meshes:
        mesh.scale = [mesh_scale] * 3
    spec.attach(part, prefix="blocks/", frame=spec.worldbody.add_frame())


def _add_touch_sensors(spec: mujoco.MjSpec, gripper: Gripper, slots: int) -> None:
    """Adds a sensor of the number of contacts for each of the hand's geoms x slots, in order."""
    for geom in itertools.chain(*mjcf.hand_geoms(spec, gripper)):
        for slot in range(slots):
            sensor = spec.add_sensor(type=mujoco.mjtSensor.mjSENS_CONTACT)
            sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_GEOM, geom
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, f"block{slot}"
            sensor.intprm[:3] = [1, 0, 1]  # data `found`, no reduction, one contact


def _add_parts(spec: mujoco.MjSpec, body: mujoco.MjsBody, kind: SlotKind) -> None:
    """Adds the geoms of one slot, at the largest size of its kind."""
    largest = LARGEST * blocks.half_size_choices(kind).max(axis=0)
    if kind == "box":  # it may lie on any side
        largest = np.full(3, largest.max())
    for _, centre, half in zip(*blocks.parts((kind,)), strict=True):
        geom = body.add_geom(spec.find_default("blocks/block"))
        if kind in MESH_KINDS:
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, f"blocks/{kind}"
        else:
            geom.type = mujoco.mjtGeom.mjGEOM_BOX
            geom.size, geom.pos = half * largest, centre * largest


def to_mjcf(scene: SceneConfig, sim: SimConfig) -> str:
    """Returns the world that `build` compiles as MJCF text, blocks at their largest size."""
    spec = _spec(scene, sim, grippers.load(sim.gripper))
    spec.compile()
    text: str = spec.to_xml()
    return text


def build(scene: SceneConfig, sim: SimConfig) -> World:
    """Builds the world of table, robot and block slots; blocks parked, at their largest size.

    Raises SceneError for MJCF that lacks a named element, does not compile, or that MJX ignores,
    and SettingsError for a grip force of a gripper that does not say its own.
    """
    gripper = grippers.load(sim.gripper)
    knows_force = sim.grip_force[1] == 0.0 or gripper.force is not None
    require(knows_force, f"sim.grip_force: '{gripper.name}' has no 'force' in its {NUMBERS}")
    with mjcf.errors_of(assets()):
        spec = _spec(scene, sim, gripper)
        model = spec.compile()
    for field in _MJX_IGNORES if sim.physics == "mjx" else ():  # `put_model` raises for others
        if np.any(operator.attrgetter(field)(model)):
            raise SceneError(f"MJX ignores {field}; leave it at 0, or take sim.physics c")
    _align_inertia(model)
    bodies = np.array([model.body(f"block{slot}").id for slot in range(len(scene.slots))])
    free_joints = model.body_jntadr[bodies]
    slot_of_body = np.full(model.nbody, -1)
    slot_of_body[bodies] = np.arange(len(bodies))
    slot_of_geom = slot_of_body[model.geom_bodyid]
    joints, hand = mjcf.joint_names(sim, gripper), mjcf.hand_geoms(spec, gripper)
    objects_at, bodies_of = np.flatnonzero(blocks.is_object(scene.slots)), None
    if scene.has_objects:
        library = object_slots.library(scene)
        bodies_of = objects.read(model, objects_at, bodies[objects_at], library)
    return World(
        model=model,
        slots=scene.slots,
        parts=blocks.parts(scene.slots),
        block_bodies=bodies,
        block_geoms=np.flatnonzero((slot_of_geom >= 0) & ~np.isin(slot_of_geom, objects_at)),
        block_qpos=model.jnt_qposadr[free_joints][:, None] + np.arange(7),
        block_dofs=model.jnt_dofadr[free_joints][:, None] + np.arange(6),
        slot_of_geom=slot_of_geom,
        robot_qpos=np.array([model.joint(name).qposadr[0] for name in joints]),
        gripper=gripper,
        press_qpos=int(model.joint(mjcf.PRESS).qposadr[0]),
        press=model.actuator(mjcf.PRESS).id,
        grip=model.actuator(mjcf.PREFIX + gripper.actuator).id,
        pads=np.array([model.geom(name).id for name in mjcf.pads(gripper)]),
        hand_geoms=np.array([model.geom(name).id for names in hand for name in names]),
        hand_parts=np.repeat(np.arange(len(hand)), [len(names) for names in hand]),
        mesh_scale=float(model.mesh_scale[model.mesh("blocks/prism").id, 0]),
        objects=bodies_of,
    )


def _align_inertia(model: mujoco.MjModel) -> None:
    """Restores the order of axes, which the compiler sorts, for inertial frames along the body."""
    rotation = Rotation.from_quat(model.body_iquat, scalar_first=True).as_matrix()
    is_swap = np.isclose(np.abs(rotation).max(axis=1), 1.0).all(axis=1)
    swapped = np.abs(rotation.round()) @ model.body_inertia[:, :, None]
    model.body_inertia[is_swap] = swapped[is_swap, :, 0]
    model.body_iquat[is_swap] = [1.0, 0.0, 0.0, 0.0]
    mujoco.mj_setConst(model, mujoco.MjData(model))


class PadFields(NamedTuple):
    """The boxes at the finger tips: size, place and bounding sphere."""

    size: jax.Array  # [2, 3] m, half sizes
    position: jax.Array  # [2, 3] m, in the finger's frame, which lies on the inner face
    radius: jax.Array  # [2] m


class GripFields(NamedTuple):
    """Friction and force of the fingers."""

    friction: jax.Array  # [] sliding friction of the pads
    force: jax.Array  # [2] most of the fingers' actuator, each way, in its unit


@struct.dataclass
class BlockFields:
    """Model fields that differ per scene. N = slots, G = parts, M = meshes."""

    size: jax.Array  # [G, 3] m, half sizes of boxes; of meshes as MuJoCo keeps them
    centre: jax.Array  # [G, 3] m, geom in body frame
    rbound: jax.Array  # [G] m, radius of the bounding sphere
    friction: jax.Array  # [G] sliding friction
    mass: jax.Array  # [N] kg
    inertia: jax.Array  # [N, 3] kg m^2, about the centre of mass
    com: jax.Array  # [N, 3] m, centre of mass in body frame
    body_invweight: jax.Array  # [N, 2] 1/kg, 1/(kg m^2)
    dof_invweight: jax.Array  # [N, 6] the same for the six dofs
    mesh_scale: jax.Array  # [M] relative to the compiled mesh
    objects: ObjectFields | None = None  # rows of such slots in the other leaves have no meaning
    pads: PadFields | None = None  # where the fingers vary
    grip: GripFields | None = None  # where the grip varies


def scene_fields(world: World, scene: SceneState) -> BlockFields:
    """Computes what MuJoCo's compiler derives from sizes, densities and frictions of one scene.

    Boxes: m = 8 rho a b c, I_x = m (b^2 + c^2) / 3, parts about their common centre of mass by the
    parallel axis theorem. Meshes by their scale s: m ~ rho s^3, I ~ rho s^5.
    """
    scene = jax.tree.map(jnp.asarray, scene)
    fields = _with_meshes(world, scene, _box_fields(world, scene))
    if scene.fingers is not None:
        fields = fields.replace(pads=_pads(world, scene.fingers))
    if scene.grip is not None:
        fields = fields.replace(grip=_grip(world, scene.grip))
    if world.objects is None:
        return fields
    leaves = (scene.numbers, scene.density, scene.friction)
    return fields.replace(objects=ObjectFields(*(leaf[world.objects.slots] for leaf in leaves)))


def _pads(world: World, fingers: Fingers) -> PadFields:
    """Computes pads of these sizes; their inner faces stay in place."""
    model, pads = world.model, world.pads
    length = jnp.full(2, model.geom_size[pads, 2], jnp.float32)
    half = (jnp.full(2, 0.5 * side) for side in (fingers.thickness, fingers.width))
    size = jnp.column_stack([*half, length])
    along = np.sign(model.geom_pos[pads, 0]) * size[:, 0]
    position = jnp.asarray(model.geom_pos[pads], jnp.float32).at[:, 0].set(along)
    return PadFields(size, position, jnp.linalg.norm(size, axis=1))


def _grip(world: World, grip: Grip) -> GripFields:
    model, own = world.model, world.gripper.force or 1.0
    share = jnp.where(grip.force > 0.0, grip.force / own, 1.0)
    friction = np.float32(model.geom_friction[world.pads[0], 0])
    return GripFields(
        friction=jnp.where(grip.friction > 0.0, grip.friction, friction),
        force=share * np.float32(model.actuator_forcerange[world.grip]),
    )


def _box_fields(world: World, scene: SceneState) -> BlockFields:
    slot = world.parts.slot
    half_size = scene.half_size[slot]
    half, centre = half_size * world.parts.half, half_size * world.parts.centre
    part_mass = 8.0 * scene.density[slot] * jnp.prod(half, axis=1)

    # An object has no boxes: 1 kg and 1 kg m^2 stand in for 0, which has no inverse.
    is_object, num = blocks.is_object(world.slots), len(world.slots)

    def add(values: jax.Array) -> jax.Array:
        blank = np.broadcast_to(is_object, (*values.shape[:0:-1], num)).T.astype(np.float32)
        return jnp.asarray(blank).at[slot].add(values)

    mass = add(part_mass)
    com = add(part_mass[:, None] * centre) / mass[:, None]
    # [G, 3], second moment of a part along each axis, per mass
    square = half**2 / 3.0 + (centre - com[slot]) ** 2
    inertia = add(part_mass[:, None] * (jnp.sum(square, axis=1, keepdims=True) - square))
    turning = jnp.mean(1.0 / inertia, axis=1)
    # A free joint sits at the body's origin: a push there also rotates the block.
    lever = jnp.sum(com**2, axis=1, keepdims=True) - com**2
    moving = 1.0 / mass + jnp.sum(lever / inertia, axis=1) / 3.0
    return BlockFields(
        size=half,
        centre=centre,
        rbound=jnp.sqrt(jnp.sum(half**2, axis=1)),
        friction=scene.friction[slot],
        mass=mass,
        inertia=inertia,
        com=com,
        body_invweight=jnp.stack([1.0 / mass, turning], axis=1),
        dof_invweight=jnp.repeat(jnp.stack([moving, turning], axis=1), 3, axis=1),
        mesh_scale=jnp.zeros(0),
    )


def _with_meshes(world: World, scene: SceneState, boxes: BlockFields) -> BlockFields:
    """Replaces the fields of slots that hold a mesh by the compiled ones, scaled."""
    model, slot = world.model, world.parts.slot
    geoms, bodies = world.block_geoms, world.block_bodies
    is_mesh = blocks.is_mesh(world.slots)  # [N]
    of_part = is_mesh[slot]  # [G]
    scale = (blocks.mesh_scale(world.slots, scene.half_size) / world.mesh_scale)[:, None]  # [N, 1]
    heavier = (scene.density / scene_state.NOMINAL_DENSITY)[:, None]  # that of scenes/blocks.xml
    by_mass, by_inertia = heavier * scale**3, heavier * scale**5
    by_weight = jnp.concatenate([1.0 / by_mass, 1.0 / by_inertia], axis=1)  # [N, 2]

    def choose(
        box: jax.Array, compiled: np.ndarray, by: jax.Array, which: np.ndarray = is_mesh
    ) -> jax.Array:
        scaled = jnp.asarray(compiled, jnp.float32) * by
        return jnp.where(which.reshape(-1, *[1] * (box.ndim - 1)), scaled, box)

    # The first slot that uses each mesh; -1, of boxes, is the last row.
    meshes, first = np.unique(model.geom_dataid[geoms], return_index=True)
    own_meshes = model.nmesh if world.objects is None else world.objects.meshes[0, 0]
    user = np.full(own_meshes + 1, len(scale))
    user[meshes] = slot[first]
    by_dof = jnp.repeat(by_weight, 3, axis=1)
    return boxes.replace(
        size=choose(boxes.size, model.geom_size[geoms], scale[slot], of_part),
        centre=choose(boxes.centre, model.geom_pos[geoms], scale[slot], of_part),
        rbound=choose(boxes.rbound, model.geom_rbound[geoms], scale[slot, 0], of_part),
        mass=choose(boxes.mass, model.body_mass[bodies], by_mass[:, 0]),
        inertia=choose(boxes.inertia, model.body_inertia[bodies], by_inertia),
        com=choose(boxes.com, model.body_ipos[bodies], scale),
        body_invweight=choose(boxes.body_invweight, model.body_invweight0[bodies], by_weight),
        dof_invweight=choose(boxes.dof_invweight, model.dof_invweight0[world.block_dofs], by_dof),
        mesh_scale=jnp.append(scale, 1.0)[user[:-1]],
    )


def with_blocks(
    world: World, fields: BlockFields, into: tuple[mujoco.MjModel, mujoco.MjData] | None = None
) -> mujoco.MjModel:
    """Writes blocks of these fields (NumPy) into a copy of the world's model, or into `into`.

    `into` is an earlier copy and data of it: to allocate them takes longer than all the rest.
    """
    model, scratch = into or (copy.copy(world.model), mujoco.MjData(world.model))
    geoms, bodies = world.block_geoms, world.block_bodies
    model.geom_size[geoms], model.geom_rbound[geoms] = fields.size, fields.rbound
    model.geom_pos[geoms], model.geom_friction[geoms, 0] = fields.centre, fields.friction
    model.body_mass[bodies], model.body_inertia[bodies] = fields.mass, fields.inertia
    model.body_ipos[bodies] = fields.com
    counts = model.mesh_vertnum[: len(fields.mesh_scale)]  # the blocks' meshes come first
    scales = np.repeat(fields.mesh_scale, counts)  # of corners, mesh by mesh
    model.mesh_vert[: len(scales)] = world.model.mesh_vert[: len(scales)] * scales[:, None]
    if fields.pads is not None:
        pads = world.pads
        model.geom_size[pads], model.geom_pos[pads], model.geom_rbound[pads] = fields.pads
    if fields.grip is not None:
        model.geom_friction[world.pads, 0] = fields.grip.friction
        model.actuator_forcerange[world.grip] = fields.grip.force
    if world.objects is not None and fields.objects is not None:
        objects.put(model, world.objects, fields.objects)
    mujoco.mj_setConst(model, scratch)  # C takes a free body's mass matrix from `dof_M0`
    return model
