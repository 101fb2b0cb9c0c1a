"""MJCF pieces to one MuJoCo model, with the index of what later stages address in it."""

import copy
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from csac_jax.config import MESH_KINDS, RobotKind, SceneConfig, SimConfig, SlotKind
from csac_jax.scene import blocks, layout, lint
from csac_jax.scene.blocks import Parts
from csac_jax.scene.layout import Scene

FINGERS = ("hand/finger_low", "hand/finger_high")
HAND_GEOMS = ("palm", "pad_low", "pad_high")
ROBOT_JOINTS: dict[RobotKind, tuple[str, ...]] = {
    "hand": ("hand/x", "hand/y", "hand/z", "hand/yaw", *FINGERS),
    "ur5": tuple(
        f"ur5/{name}"
        for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist1", "wrist2", "wrist3")
    )
    + FINGERS,
}
LARGEST = 1.25  # size of compiled blocks relative to nominal: C culls pairs by the bounds it was compiled with
MAX_OPENING = 0.110  # m, RG2 data sheet
HAND_PARK_HEIGHT = (
    10.0  # m, where the hand waits while blocks settle: above all drops, or it catches the highest
)


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
    robot_qpos: (
        np.ndarray
    )  # [Q] addresses in qpos, order of ROBOT_JOINTS; the last two are the fingers
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


def _spec(scene: SceneConfig, sim: SimConfig) -> mujoco.MjSpec:
    folder = assets()
    spec = mujoco.MjSpec.from_file(str(folder / "table.xml"))
    _add_robot(spec, sim.robot)
    part = mujoco.MjSpec.from_file(str(folder / "blocks.xml"))
    for mesh in part.meshes:
        mesh.scale = [_mesh_scale(sim)] * 3
    spec.attach(part, prefix="blocks/", frame=spec.worldbody.add_frame())
    for slot, (kind, place) in enumerate(
        zip(scene.slots, layout.parking(len(scene.slots)), strict=True)
    ):
        body = spec.worldbody.add_body(name=f"block{slot}", pos=place)
        body.add_freejoint(name=f"block{slot}")
        _add_parts(spec, body, kind)
    if sim.physics != "mjx":  # which looks its contacts up
        _add_touch_sensors(spec, len(scene.slots))
    spec.option.timestep = sim.timestep
    spec.option.iterations = sim.iterations
    spec.option.ls_iterations = sim.line_search
    spec.add_numeric(name="max_geom_pairs", data=[sim.geom_pairs])
    spec.add_numeric(name="max_contact_points", data=[sim.contacts])
    return spec


def _mesh_scale(sim: SimConfig) -> float:
    """Size of compiled meshes relative to nominal; Warp's have one size in all scenes."""
    return 1.0 if sim.physics == "warp" else LARGEST


def _add_touch_sensors(spec: mujoco.MjSpec, slots: int) -> None:
    """A sensor [1] of how many contacts a hand geom has with a block, for each of HAND_GEOMS x
    slots, in that order."""
    for geom in HAND_GEOMS:
        for slot in range(slots):
            sensor = spec.add_sensor(type=mujoco.mjtSensor.mjSENS_CONTACT)
            sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_GEOM, f"hand/{geom}"
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, f"block{slot}"
            found, unreduced, one = 1, 0, 1
            sensor.intprm[:3] = [found, unreduced, one]


def _add_robot(spec: mujoco.MjSpec, kind: RobotKind) -> None:
    """The floating hand, or the arm with the same hand at its flange."""

    def part(name: str) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(assets() / f"{name}.xml"))

    if kind == "ur5":
        spec.attach(part("ur5"), prefix="ur5/", frame=spec.worldbody.add_frame())
        spec.attach(part("rg2"), prefix="hand/", site=spec.site("ur5/tip"))
    else:
        spec.attach(part("hand"), prefix="hand/", frame=spec.worldbody.add_frame())


def _add_parts(spec: mujoco.MjSpec, body: mujoco.MjsBody, kind: SlotKind) -> None:
    """The geoms of one slot, at the largest size of its kind."""
    largest = LARGEST * blocks.half_size_choices(kind).max(axis=0)
    every = blocks.parts((kind,))
    for centre, half in zip(every.centre, every.half, strict=True):
        geom = body.add_geom(spec.find_default("blocks/block"))
        if kind in MESH_KINDS:
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, f"blocks/{kind}"
        else:
            geom.type, geom.size, geom.pos = (
                mujoco.mjtGeom.mjGEOM_BOX,
                half * largest,
                centre * largest,
            )


def build(scene: SceneConfig, sim: SimConfig) -> World:
    """The world of table, robot and block slots; blocks parked, at the largest size of their kind.

    Raises SceneError where the physics is MJX and the MJCF has something that MJX lacks or would
    ignore.
    """
    model = _spec(scene, sim).compile()
    if sim.physics == "mjx":
        lint.check(model)
    _align_inertia(model)
    names = [f"block{slot}" for slot in range(len(scene.slots))]
    bodies = np.array([model.body(name).id for name in names])
    block_joints = [model.joint(name) for name in names]
    slot_of_body = np.full(model.nbody, -1)
    slot_of_body[bodies] = np.arange(len(names))
    slot_of_geom = slot_of_body[model.geom_bodyid]
    return World(
        model=model,
        slots=scene.slots,
        parts=blocks.parts(scene.slots),
        block_bodies=bodies,
        block_geoms=np.flatnonzero(slot_of_geom >= 0),
        block_qpos=np.array([joint.qposadr[0] + np.arange(7) for joint in block_joints]),
        block_dofs=np.array([joint.dofadr[0] + np.arange(6) for joint in block_joints]),
        slot_of_geom=slot_of_geom,
        robot_qpos=np.array([model.joint(name).qposadr[0] for name in ROBOT_JOINTS[sim.robot]]),
        hand_geoms=np.array([model.geom(f"hand/{name}").id for name in HAND_GEOMS]),
        mesh_scale=_mesh_scale(sim),
    )


def _align_inertia(model: mujoco.MjModel) -> None:
    """Turns inertial frames that are body frames with their axes swapped (the compiler sorts by
    size) back."""
    for body in range(model.nbody):
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_iquat[body])
        if np.allclose(np.abs(turn).max(axis=0), 1.0):
            model.body_inertia[body] = np.abs(turn.reshape(3, 3).round()) @ model.body_inertia[body]
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
    parts about their common centre of mass by the parallel axis theorem. Meshes by their scale s: m
    ~ rho s^3, I ~ rho s^5. Blocks of one mesh kind in a scene share their size.
    """
    boxes, meshes = (
        _box_fields(world, half_size, density, friction),
        _mesh_fields(world, half_size, density, friction),
    )
    is_mesh = np.array([kind in MESH_KINDS for kind in world.slots])

    def choose(mesh: jax.Array, box: jax.Array, which: np.ndarray) -> jax.Array:
        return jnp.where(which.reshape(-1, *[1] * (box.ndim - 1)), mesh, box)

    per_part = ("size", "centre", "rbound", "friction")
    chosen = {
        field.name: choose(
            getattr(meshes, field.name),
            getattr(boxes, field.name),
            is_mesh[world.parts.slot] if field.name in per_part else is_mesh,
        )
        for field in dataclasses.fields(BlockFields)
        if field.name != "mesh_scale"
    }
    return BlockFields(**chosen, mesh_scale=meshes.mesh_scale)


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
    square = (
        half**2 / 3.0 + (centre - com[slot]) ** 2
    )  # [G, 3], second moment of a part along each axis, per mass
    inertia = add(part_mass[:, None] * (jnp.sum(square, axis=1, keepdims=True) - square))
    turning = jnp.mean(1.0 / inertia, axis=1)
    # A free joint sits at the body's origin: pushing there also turns the block, about axes square
    # to its lever.
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
    powers = jnp.concatenate(
        [jnp.repeat(1.0 / by_mass, 3, axis=1), jnp.repeat(1.0 / by_inertia, 3, axis=1)], axis=1
    )

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
    """Scale of every mesh of the model [M]: that of the first slot that uses it, 1 where none
    does."""
    users = [
        np.flatnonzero(world.model.geom_dataid[world.block_geoms] == mesh)[:1]
        for mesh in range(world.model.nmesh)
    ]
    one = jnp.ones(())
    return jnp.stack(
        [scale[world.parts.slot[user[0]]] if user.size else one for user in users] or [one]
    )


def with_blocks(
    world: World,
    fields: BlockFields,
    scratch: mujoco.MjData | None = None,
    into: mujoco.MjModel | None = None,
) -> mujoco.MjModel:
    """A copy of the world's model whose blocks have these fields (NumPy arrays), or `into`, an
    earlier copy, with them.

    MuJoCo derives the rest: C takes the mass matrix of a free body from `dof_M0`, not from its
    mass. What it needs room for is written into `scratch`, if there is any: making room, or a copy,
    takes longer than the rest.
    """
    model = into or copy.copy(world.model)
    model.geom_size[world.block_geoms], model.geom_rbound[world.block_geoms] = (
        fields.size,
        fields.rbound,
    )
    model.geom_pos[world.block_geoms] = fields.centre
    model.geom_friction[world.block_geoms, 0] = fields.friction
    model.body_mass[world.block_bodies], model.body_inertia[world.block_bodies] = (
        fields.mass,
        fields.inertia,
    )
    model.body_ipos[world.block_bodies] = fields.com
    for mesh, scale in zip(range(model.nmesh), fields.mesh_scale, strict=False):
        start = model.mesh_vertadr[mesh]
        corners = slice(start, start + model.mesh_vertnum[mesh])
        model.mesh_vert[corners] = world.model.mesh_vert[corners] * scale
    mujoco.mj_setConst(model, scratch or mujoco.MjData(model))
    return model


def scene_fields(world: World, scene: Scene) -> BlockFields:
    """The fields of one scene."""
    return block_fields(
        world, *(jnp.asarray(leaf) for leaf in (scene.half_size, scene.density, scene.friction))
    )
