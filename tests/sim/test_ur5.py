"""Arms with grippers: they follow plans, grasp, and press no harder than they should."""

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax import grippers
from csac_jax.assets import assets
from csac_jax.config import HeightmapConfig, SimConfig
from csac_jax.constants import Primitive
from csac_jax.robot import mjcf, primitives
from csac_jax.robot.primitives import Action

SIM, MAP = SimConfig(robot="ur5"), HeightmapConfig()
RG2 = grippers.load("rg2")
CUBE = 0.025  # m, half its side
FINGER = 7  # address in qpos of the first finger, after the six joints and the tool's drive
BLOCK = 9  # address in qpos of the block

_joints = jax.jit(functools.partial(primitives.joint_trajectory, SIM))


@functools.cache
def _model(with_block: bool = False) -> mujoco.MjModel:
    """Table, arm, hand and at will a cube, with the solver as in training."""
    files = (str(assets() / f"{name}.xml") for name in ("table", "blocks"))
    spec, part = map(mujoco.MjSpec.from_file, files)
    mjcf.add(spec, SIM, RG2)
    spec.attach(part, prefix="blocks/", frame=spec.worldbody.add_frame())
    if with_block:
        body = spec.worldbody.add_body(name="block")
        body.add_freejoint()
        geom = body.add_geom(spec.find_default("blocks/block"), name="block", size=[CUBE] * 3)
        geom.type = mujoco.mjtGeom.mjGEOM_BOX
    spec.option.timestep, spec.option.iterations = SIM.timestep, SIM.iterations
    spec.option.ls_iterations = SIM.line_search
    return spec.compile()


@functools.cache
def _plan(primitive: Primitive, x: float, y: float, yaw: float, top: float) -> tuple:
    """Set-points [1 + T, 5] of a primitive over a flat surface, and joint targets [1 + T, 8]."""
    action = Action(primitive=jnp.int32(primitive), pose=jnp.array([x, y, yaw], jnp.float32))
    height = jnp.full((MAP.size, MAP.size), top)
    plan = jax.jit(functools.partial(primitives.plan, SIM, MAP))(height, action)
    joints = _joints(plan)
    assert joints.reachable
    target = jnp.concatenate([joints.start[None, : FINGER + 1], joints.control])
    return np.concatenate([plan.start[None], plan.control]), np.asarray(target)


def _start(model: mujoco.MjModel, target: np.ndarray, block: Any = (9.0, 9.0)) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:FINGER] = target[0, :FINGER]
    data.qpos[FINGER : FINGER + 2] = target[0, FINGER]
    if model.nq > BLOCK:
        data.qpos[BLOCK : BLOCK + 7] = [*block, CUBE, 1, 0, 0, 0]
    return data


def _motion(model: mujoco.MjModel, target: np.ndarray, *block: Any) -> Iterator[mujoco.MjData]:
    """The data, one and the same, after every substep."""
    data = _start(model, target, *block)
    for command in target[1:]:
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        yield data


CORNERS = [(x, y, yaw, 0.0) for x in (-0.224, 0.224) for y in (-0.224, 0.224) for yaw in (0.0, 2.0)]
PLACES = [*CORNERS, (0.0, 0.0, 1.0, 0.05), (0.224, 0.0, 3.0, 0.1), (-0.1, 0.1, 4.0, 0.15)]


@pytest.mark.parametrize("primitive", list(Primitive))
def test_arm_follows_the_plan(primitive: Primitive):
    """Claim: as each phase ends, the tips are within 3 mm of the set-point, at any place."""
    model = _model()
    ends = np.cumsum(SIM.grasp_phases if primitive == Primitive.GRASP else SIM.push_phases)
    for place in PLACES:
        control, target = _plan(primitive, *place)
        for index, data in enumerate(_motion(model, target), 1):
            if index in ends:
                mujoco.mj_kinematics(model, data)
                error = data.site("ur5/tip").xpos - control[index, :3]
                assert np.linalg.norm(error) < 0.003, (place, index)


@pytest.mark.parametrize("x", [-0.2, 0.0, 0.2])
def test_arm_lifts_a_cube(x: float):
    """Claim: a grasp of the arm lifts a cube by as much as the hand, at the gap of its width."""
    control, target = _plan(Primitive.GRASP, x, 0.1, 0.0, 2 * CUBE)
    *_, data = _motion(_model(with_block=True), target, (x, 0.1))
    rise = control[:, 2].max() - control[:, 2].min()
    assert abs(data.qpos[BLOCK + 2] - CUBE - rise) < 0.01
    assert abs(2 * data.qpos[FINGER] - 2 * CUBE) < 0.005
