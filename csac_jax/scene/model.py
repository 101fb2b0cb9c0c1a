"""MJCF files to one MuJoCo model, with the index of what later stages address in it."""

import copy
import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from csac_jax.config import MESH_KINDS, RobotKind, SceneConfig, SimConfig, SlotKind
from csac_jax.errors import SceneError
from csac_jax.scene import blocks, layout, lint
from csac_jax.scene.blocks import Parts
from csac_jax.scene.layout import Scene

HAND_GEOMS = ("palm", "pad_low", "pad_high")
MAX_OPENING = 0.110  # m, RG2 data sheet
LARGEST = 1.25  # compiled over nominal block size: C culls pairs by the bounds it was compiled with
HAND_PARK_HEIGHT = 10.0  # m, where the hand waits while blocks settle: above the highest drop


class RobotPart(NamedTuple):
    """A MJCF file of a robot, and the elements that it must have."""

    file: str
    prefix: str  # of its names in the model
    joints: tuple[str, ...]
    actuators: tuple[str, ...]  # no others, in the order of set-points
    geoms: tuple[str, ...] = ()
    sites: tuple[str, ...] = ()
    mount: str | None = None  # site of an earlier part that this one is attached to


_FINGERS = ("finger_low", "finger_high")
_FLOAT = ("x", "y", "z", "yaw")
_ARM = ("shoulder_pan", "shoulder_lift", "elbow", "wrist1", "wrist2", "wrist3")
ROBOTS: dict[RobotKind, tuple[RobotPart, ...]] = {
    "hand": (
        RobotPart("hand.xml", "hand/", (*_FLOAT, *_FINGERS), (*_FLOAT, "finger"), HAND_GEOMS),
    ),
    "ur5": (
        RobotPart("ur5.xml", "ur5/", _ARM, _ARM, sites=("tip",)),
        RobotPart("rg2.xml", "hand/", _FINGERS, ("finger",), HAND_GEOMS, mount="ur5/tip"),
    ),
}


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """A compiled model and the addresses in it. N = block slots, G = their convex parts."""

    model: mujoco.MjModel
    slots: tuple[SlotKind, ...]
    parts: Parts
    block_bodies: np.ndarray  # [N] body ids
    block_geoms: np.ndarray  # [G] geom ids
    block_qpos: np.ndarray  # [N, 7] addresses in qpos: position, quaternion
    block_dofs: np.ndarray  # [N, 6] addresses in qvel
    slot_of_geom: np.ndarray  # [geoms] slot that a geom belongs to, -1 if it is no block's
    robot_qpos: np.ndarray  # [Q] addresses in qpos, order of ROBOTS; the last two are the fingers
    hand_geoms: np.ndarray  # [3] geom ids: palm, low pad, high pad
    mesh_scale: float  # size of compiled meshes relative to nominal


def assets() -> Path:
    """Folder of the MJCF files: `scenes/` of a checkout, `_scenes/` of an installed package.

    Raises FileNotFoundError where neither exists.
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package.parent / "scenes", package / "_scenes"):
        if (folder / "table.xml").is_file():
            return folder
    raise FileNotFoundError(
        f"the MJCF files of csac_jax are missing beside {package}; install the package again"
    )


def _read(file: str) -> mujoco.MjSpec:
    """A MJCF file of `assets`. Raises SceneError where MuJoCo cannot read it."""
    path = assets() / file
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise SceneError(f"{path}: {' '.join(str(error).split())}") from None


def _require(file: str, kind: str, required: tuple[str, ...], present: list[str]) -> None:
    """Raises SceneError where an element that the package addresses by name is missing."""
    for name in required:
        if name not in present:
            known = ", ".join(present) or "none"
            raise SceneError(f"{assets() / file}: {kind} '{name}' is missing; it has: {known}")


def _spec(scene: SceneConfig, sim: SimConfig) -> mujoco.MjSpec:
    spec = _read("table.xml")
    for part in ROBOTS[sim.robot]:
        _add_robot_part(spec, part)
    _add_block_assets(spec, _mesh_scale(sim))
    places = layout.parking(len(scene.slots))
    for slot, (kind, place) in enumerate(zip(scene.slots, places, strict=True)):
        body = spec.worldbody.add_body(name=f"block{slot}", pos=place)
        body.add_freejoint(name=f"block{slot}")
        _add_parts(spec, body, kind)
    if sim.physics != "mjx":  # which reads its contacts instead
        _add_touch_sensors(spec, len(scene.slots))
    spec.option.timestep = sim.timestep
    spec.option.iterations = sim.iterations
    spec.option.ls_iterations = sim.line_search
    spec.add_numeric(name="max_geom_pairs", data=[sim.geom_pairs])
    spec.add_numeric(name="max_contact_points", data=[sim.contacts])
    return spec


def _add_robot_part(spec: mujoco.MjSpec, part: RobotPart) -> None:
    robot = _read(part.file)
    _require(part.file, "joint", part.joints, [joint.name for joint in robot.joints])
    _require(part.file, "geom", part.geoms, [geom.name for geom in robot.geoms if geom.name])
    _require(part.file, "site", part.sites, [site.name for site in robot.sites])
    actuators = [actuator.name for actuator in robot.actuators]
    if tuple(actuators) != part.actuators:
        required, present = ", ".join(part.actuators), ", ".join(actuators)
        raise SceneError(f"{assets() / part.file}: actuators must be {required}, not {present}")
    # `attach` silently drops an element that refers to a missing one, which this refuses.
    mujoco.MjModel.from_xml_path(str(assets() / part.file))
    if part.mount:
        spec.attach(robot, prefix=part.prefix, site=spec.site(part.mount))
    else:
        spec.attach(robot, prefix=part.prefix, frame=spec.worldbody.add_frame())


def _add_block_assets(spec: mujoco.MjSpec, mesh_scale: float) -> None:
    """The block material and the meshes, at this scale."""
    file = "blocks.xml"
    part = _read(file)
    _require(file, "mesh", MESH_KINDS, [mesh.name for mesh in part.meshes])
    if part.find_default("block") is None:
        raise SceneError(f"{assets() / file}: default class 'block' is missing")
    for mesh in part.meshes:
        mesh.scale = [mesh_scale] * 3
    spec.attach(part, prefix="blocks/", frame=spec.worldbody.add_frame())


def _mesh_scale(sim: SimConfig) -> float:
    """Size of compiled meshes relative to nominal; Warp's have one size in all scenes."""
    return 1.0 if sim.physics == "warp" else LARGEST


def _add_touch_sensors(spec: mujoco.MjSpec, slots: int) -> None:
    """A sensor [1] of the number of contacts for each of HAND_GEOMS x slots, in that order."""
    for geom in HAND_GEOMS:
        for slot in range(slots):
            sensor = spec.add_sensor(type=mujoco.mjtSensor.mjSENS_CONTACT)
            sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_GEOM, f"hand/{geom}"
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, f"block{slot}"
            found, unreduced, one = 1, 0, 1
            sensor.intprm[:3] = [found, unreduced, one]


def _add_parts(spec: mujoco.MjSpec, body: mujoco.MjsBody, kind: SlotKind) -> None:
    """The geoms of one slot, at the largest size of its kind."""
    largest = LARGEST * blocks.half_size_choices(kind).max(axis=0)
    every = blocks.parts((kind,))
    for centre, half in zip(every.centre, every.half, strict=True):
        geom = body.add_geom(spec.find_default("blocks/block"))
        if kind in MESH_KINDS:
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, f"blocks/{kind}"
        else:
            geom.type = mujoco.mjtGeom.mjGEOM_BOX
            geom.size, geom.pos = half * largest, centre * largest


def build(scene: SceneConfig, sim: SimConfig) -> World:
    """The world of table, robot and block slots; blocks parked, at the largest size of their kind.

    Raises SceneError where the MJCF files lack an element that is addressed by name, where they do
    not compile, and where MJX lacks or would ignore something in them that it is to run.
    """
    try:
        model = _spec(scene, sim).compile()
    except ValueError as error:
        raise SceneError(f"{assets()}: {' '.join(str(error).split())}") from None
    if sim.physics == "mjx":
        lint.check(model)
    _align_inertia(model)
    names = [f"block{slot}" for slot in range(len(scene.slots))]
    bodies = np.array([model.body(name).id for name in names])
    block_joints = [model.joint(name) for name in names]
    slot_of_body = np.full(model.nbody, -1)
    slot_of_body[bodies] = np.arange(len(names))
    slot_of_geom = slot_of_body[model.geom_bodyid]
    joints = [part.prefix + name for part in ROBOTS[sim.robot] for name in part.joints]
    return World(
        model=model,
        slots=scene.slots,
        parts=blocks.parts(scene.slots),
        block_bodies=bodies,
        block_geoms=np.flatnonzero(slot_of_geom >= 0),
        block_qpos=np.array([joint.qposadr[0] + np.arange(7) for joint in block_joints]),
        block_dofs=np.array([joint.dofadr[0] + np.arange(6) for joint in block_joints]),
        slot_of_geom=slot_of_geom,
        robot_qpos=np.array([model.joint(name).qposadr[0] for name in joints]),
        hand_geoms=np.array([model.geom(f"hand/{name}").id for name in HAND_GEOMS]),
        mesh_scale=_mesh_scale(sim),
    )


def _align_inertia(model: mujoco.MjModel) -> None:
    """Undoes the compiler's swap of axes, by size, where inertial frames are body frames."""
    for body in range(model.nbody):
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
        if np.allclose(np.abs(rotation).max(axis=0), 1.0):
            swap = np.abs(rotation.reshape(3, 3).round())
            model.body_inertia[body] = swap @ model.body_inertia[body]
            model.body_iquat[body] = [1.0, 0.0, 0.0, 0.0]
    mujoco.mj_setConst(model, mujoco.MjData(model))


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


def block_fields(
    world: World, half_size: jax.Array, density: jax.Array, friction: jax.Array
) -> BlockFields:
    """Fields that follow from half sizes [N, 3] m, densities [N] kg/m^3 and sliding frictions [N].

    Closed forms of what MuJoCo's compiler derives. Boxes: m = 8 rho a b c, I_x = m (b^2 + c^2) / 3,
    parts about their common centre of mass by the parallel axis theorem. Meshes by their scale s:
    m ~ rho s^3, I ~ rho s^5. Blocks of one mesh kind in a scene share their size.
    """
    boxes = _box_fields(world, half_size, density, friction)
    meshes = _mesh_fields(world, half_size, density, friction)
    is_mesh = np.array([kind in MESH_KINDS for kind in world.slots])

    def choose(mesh: jax.Array, box: jax.Array) -> jax.Array:
        which = is_mesh if len(box) == len(is_mesh) else is_mesh[world.parts.slot]  # [N] or [G]
        return jnp.where(which.reshape(-1, *[1] * (box.ndim - 1)), mesh, box)

    chosen = jax.tree.map(choose, meshes.replace(mesh_scale=None), boxes.replace(mesh_scale=None))
    return chosen.replace(mesh_scale=meshes.mesh_scale)


def _box_fields(
    world: World, half_size: jax.Array, density: jax.Array, friction: jax.Array
) -> BlockFields:
    """As if every slot were made of boxes."""
    slot, num = world.parts.slot, len(world.slots)
    half = jnp.asarray(world.parts.half) * half_size[slot]
    centre = jnp.asarray(world.parts.centre) * half_size[slot]
    part_mass = 8.0 * density[slot] * jnp.prod(half, axis=1)

    def add(values: jax.Array) -> jax.Array:
        return jnp.zeros((num, *values.shape[1:])).at[slot].add(values)

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
        friction=friction[slot],
        mass=mass,
        inertia=inertia,
        com=com,
        body_invweight=jnp.stack([1.0 / mass, turning], axis=1),
        dof_invweight=jnp.repeat(jnp.stack([moving, turning], axis=1), 3, axis=1),
        mesh_scale=jnp.zeros(0),
    )


def _mesh_fields(
    world: World, half_size: jax.Array, density: jax.Array, friction: jax.Array
) -> BlockFields:
    """As if every slot held a mesh: the compiled fields, scaled."""
    model, slot = world.model, world.parts.slot
    scale = blocks.mesh_scale(world.slots, half_size) / world.mesh_scale  # [N]
    heavier = density / layout.NOMINAL_DENSITY  # that of scenes/blocks.xml
    of_part, of_slot = scale[slot][:, None], scale[:, None]
    by_mass, by_inertia = heavier[:, None] * of_slot**3, heavier[:, None] * of_slot**5
    inverse = [jnp.repeat(1.0 / by, 3, axis=1) for by in (by_mass, by_inertia)]
    powers = jnp.concatenate(inverse, axis=1)

    def base(field: np.ndarray) -> jax.Array:
        return jnp.asarray(field, jnp.float32)

    return BlockFields(
        size=base(model.geom_size[world.block_geoms]) * of_part,
        centre=base(model.geom_pos[world.block_geoms]) * of_part,
        rbound=base(model.geom_rbound[world.block_geoms]) * of_part[:, 0],
        friction=friction[slot],
        mass=base(model.body_mass[world.block_bodies]) * by_mass[:, 0],
        inertia=base(model.body_inertia[world.block_bodies]) * by_inertia,
        com=base(model.body_ipos[world.block_bodies]) * of_slot,
        body_invweight=base(model.body_invweight0[world.block_bodies]) * powers[:, [0, 3]],
        dof_invweight=base(model.dof_invweight0[world.block_dofs]) * powers,
        mesh_scale=_scale_of_meshes(world, scale),
    )


def _scale_of_meshes(world: World, scale: jax.Array) -> jax.Array:
    """Scale of every mesh of the model [M]: that of its first slot, 1 where no slot uses it."""
    mesh_of_part, one = world.model.geom_dataid[world.block_geoms], jnp.ones(())
    users = [np.flatnonzero(mesh_of_part == mesh) for mesh in range(world.model.nmesh)]
    each = [scale[world.parts.slot[parts[0]]] if parts.size else one for parts in users]
    return jnp.stack(each or [one])


def with_blocks(
    world: World,
    fields: BlockFields,
    scratch: mujoco.MjData | None = None,
    into: mujoco.MjModel | None = None,
) -> mujoco.MjModel:
    """The world's model with blocks of these fields (NumPy): a copy, or `into`, an earlier copy.

    MuJoCo derives the rest: C takes the mass matrix of a free body from `dof_M0`, not from its
    mass. It works in `scratch` if given: allocation, like a copy, takes longer than all the rest.
    """
    model = into or copy.copy(world.model)
    geoms, bodies = world.block_geoms, world.block_bodies
    model.geom_size[geoms], model.geom_rbound[geoms] = fields.size, fields.rbound
    model.geom_pos[geoms], model.geom_friction[geoms, 0] = fields.centre, fields.friction
    model.body_mass[bodies], model.body_inertia[bodies] = fields.mass, fields.inertia
    model.body_ipos[bodies] = fields.com
    for mesh, scale in zip(range(model.nmesh), fields.mesh_scale, strict=False):
        start = model.mesh_vertadr[mesh]
        corners = slice(start, start + model.mesh_vertnum[mesh])
        model.mesh_vert[corners] = world.model.mesh_vert[corners] * scale
    mujoco.mj_setConst(model, scratch or mujoco.MjData(model))
    return model


def scene_fields(world: World, scene: Scene) -> BlockFields:
    """The fields of one scene."""
    leaves = (scene.half_size, scene.density, scene.friction)
    return block_fields(world, *(jnp.asarray(leaf) for leaf in leaves))
