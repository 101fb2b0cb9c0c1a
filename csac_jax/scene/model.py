"""MJCF pieces to one MuJoCo model, with the index of what later stages address in it."""

import copy
import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from csac_jax.config import SceneConfig, SimConfig, SlotKind
from csac_jax.scene import blocks, layout

HAND_JOINTS = ("x", "y", "z", "yaw", "finger_low", "finger_high")
DENSITY = 600.0  # kg/m^3, as in scenes/blocks.xml
MAX_OPENING = 0.110  # m, RG2 data sheet
HAND_PARK_HEIGHT = 1.0  # m, where the hand waits while blocks settle


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """A compiled model and the addresses in it. N = block slots."""

    model: mujoco.MjModel
    slots: tuple[SlotKind, ...]
    block_bodies: np.ndarray  # [N] body ids
    block_geoms: np.ndarray  # [N] geom ids
    block_qpos: np.ndarray  # [N, 7] addresses in qpos: position, quaternion
    block_dofs: np.ndarray  # [N, 6] addresses in qvel
    hand_qpos: np.ndarray  # [6] addresses in qpos, order of HAND_JOINTS
    hand_dofs: np.ndarray  # [6] addresses in qvel
    hand_geoms: np.ndarray  # [3] geom ids: palm, low pad, high pad


def assets() -> Path:
    """Folder of the MJCF files: `scenes/` of a checkout, `_scenes/` of an installed package.

    Raises FileNotFoundError where neither exists.
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package.parent / "scenes", package / "_scenes"):
        if (folder / "table.xml").is_file():
            return folder
    raise FileNotFoundError(f"the MJCF files of csac_jax are missing beside {package}; install the package again")


def _spec(scene: SceneConfig, sim: SimConfig) -> mujoco.MjSpec:
    folder = assets()
    spec = mujoco.MjSpec.from_file(str(folder / "table.xml"))
    for name in ("hand", "blocks"):
        part = mujoco.MjSpec.from_file(str(folder / f"{name}.xml"))
        spec.attach(part, prefix=f"{name}/", frame=spec.worldbody.add_frame())
    for slot, (kind, place) in enumerate(zip(scene.slots, layout.parking(len(scene.slots)), strict=True)):
        body = spec.worldbody.add_body(name=f"block{slot}", pos=place)
        body.add_freejoint(name=f"block{slot}")
        geom = body.add_geom(spec.find_default("blocks/block"), name=f"block{slot}")
        if kind == "box":
            geom.type, geom.size = mujoco.mjtGeom.mjGEOM_BOX, blocks.BOX_HALF_SIZES.max(axis=0)
        else:
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, f"blocks/{kind}"
    spec.option.timestep = sim.timestep
    spec.option.iterations = sim.iterations
    spec.option.ls_iterations = sim.line_search
    spec.add_numeric(name="max_geom_pairs", data=[sim.geom_pairs])
    spec.add_numeric(name="max_contact_points", data=[sim.contacts])
    return spec


def build(scene: SceneConfig, sim: SimConfig) -> World:
    """The world of table, hand and block slots; blocks parked, boxes at the largest box size."""
    model = _spec(scene, sim).compile()
    names = [f"block{slot}" for slot in range(len(scene.slots))]
    block_joints = [model.joint(name) for name in names]
    hand_joints = [model.joint(f"hand/{name}") for name in HAND_JOINTS]
    return World(
        model=model,
        slots=scene.slots,
        block_bodies=np.array([model.body(name).id for name in names]),
        block_geoms=np.array([model.geom(name).id for name in names]),
        block_qpos=np.array([joint.qposadr[0] + np.arange(7) for joint in block_joints]),
        block_dofs=np.array([joint.dofadr[0] + np.arange(6) for joint in block_joints]),
        hand_qpos=np.array([joint.qposadr[0] for joint in hand_joints]),
        hand_dofs=np.array([joint.dofadr[0] for joint in hand_joints]),
        hand_geoms=np.array([model.geom(f"hand/{name}").id for name in ("palm", "pad_low", "pad_high")]),
    )


class BoxFields(NamedTuple):
    """Model fields of the box slots of one scene. M = box slots."""

    size: jax.Array  # [M, 3] m, half sizes
    rbound: jax.Array  # [M] m, radius of the bounding sphere
    mass: jax.Array  # [M] kg
    inertia: jax.Array  # [M, 3] kg m^2, about the centre
    invweight: jax.Array  # [M, 2] 1/kg, 1/(kg m^2)


def box_slots(world: World) -> np.ndarray:
    """Indices [M] of the slots whose size differs per scene."""
    return np.flatnonzero([kind == "box" for kind in world.slots])


def box_fields(half: jax.Array) -> BoxFields:
    """Fields that follow from the half sizes [M, 3] m: closed forms of what MuJoCo's compiler derives.

    m = 8 rho a b c, I_x = m (b^2 + c^2) / 3; for a free body invweight is 1 / m and mean(1 / I).
    """
    square = half**2
    mass = 8.0 * DENSITY * jnp.prod(half, axis=1)
    inertia = mass[:, None] * (jnp.sum(square, axis=1, keepdims=True) - square) / 3.0
    invweight = jnp.stack([1.0 / mass, jnp.mean(1.0 / inertia, axis=1)], axis=1)
    return BoxFields(half, jnp.sqrt(jnp.sum(square, axis=1)), mass, inertia, invweight)


def with_boxes(world: World, fields: BoxFields) -> mujoco.MjModel:
    """A copy of the world's model whose box slots have these fields (NumPy arrays).

    MuJoCo derives the rest: C takes the mass matrix of a free body from `dof_M0`, not from its mass.
    """
    model = copy.copy(world.model)
    slots = box_slots(world)
    geoms, bodies = world.block_geoms[slots], world.block_bodies[slots]
    model.geom_size[geoms], model.geom_rbound[geoms] = fields.size, fields.rbound
    model.body_mass[bodies], model.body_inertia[bodies] = fields.mass, fields.inertia
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
