"""One step of our MJX beside one of C MuJoCo, from states where `mjx.step` differs."""

from typing import ClassVar, NamedTuple

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from csac_jax.config import Config, SceneConfig, SimConfig
from csac_jax.sim import mjx_physics, mjx_step
from csac_jax.sim.quiet_mjx import mjx
from csac_jax.world import model, scene_state

pytestmark = pytest.mark.mjx


class ConvergedSim(SimConfig):
    """Both solvers converge: what differs is not theirs."""

    iterations: ClassVar[int] = 50
    line_search: ClassVar[int] = 50


CONFIG = Config(scene=SceneConfig(slots=("box",), min_blocks=1), sim=ConvergedSim())
# m, front of the closed fingers from the hand's axis at the origin; tips are 12 mm high
PAD = 0.012
HALF, DEEP = 0.025, 3e-4  # m, half a cube and how deep it is in what it touches
DIAGONAL = np.sqrt(2.0) * HALF
TILT = 0.2  # rad
FAR = 0.3  # m, out of everything's way


class Case(NamedTuple):
    """A cube in the air: place (m), Euler angles (deg), set-point of the fingers, C's contacts."""

    cube: tuple[float, float, float]
    turn: tuple[float, float, float]
    fingers: float = 0.0
    contacts: int = 0


CORNER = PAD + DIAGONAL * np.cos(TILT) + HALF * np.sin(TILT) - DEEP
CASES = {
    "face on pad": Case((PAD + HALF - DEEP, 0.004, 0.035), (0, 0, 0), contacts=4),
    "edge on pad": Case((PAD + DIAGONAL - DEEP, 0.001, 0.035), (45, 0, 0), contacts=2),
    "corner on pad": Case((CORNER, 0.0, 0.045), (45, np.degrees(TILT), 0), contacts=1),
    "pressing": Case((FAR, 0.1, FAR), (0, 0, 0), fingers=0.055),
}
SCENE = scene_state.parked(CONFIG.scene.slots)


class Ends(NamedTuple):
    """Results of a step: speeds [cases, nv] m/s, rad/s; depths of contacts that push, m."""

    qvel: np.ndarray
    depths: list[np.ndarray]
    deep: list[int]  # points deeper than 0, whether they push or not


def _state(world: model.World, case: Case) -> tuple[np.ndarray, np.ndarray]:
    """qpos [nq] and ctrl [nu]."""
    qpos, ctrl = world.model.qpos0.copy(), np.zeros(world.model.nu)
    qpos[world.robot_qpos] = ctrl_hand = np.array([0.0, 0.0, 0.012, 0.0, 0.0, 0.0])
    address = world.block_qpos[0]
    qpos[address[:3]] = case.cube
    turn = Rotation.from_euler("zyx", case.turn, degrees=True)
    qpos[address[3:]] = turn.as_quat(scalar_first=True)
    ctrl[:4], ctrl[4] = ctrl_hand[:4], case.fingers
    return qpos, ctrl


@pytest.fixture(scope="module")
def world() -> model.World:
    return model.build(CONFIG.scene, CONFIG.sim)


@pytest.fixture(scope="module")
def ours(world: model.World) -> Ends:
    physics = mjx_physics.MjxPhysics(world, CONFIG.sim)

    def one(qpos: jax.Array, ctrl: jax.Array) -> mjx.Data:
        its = mjx_physics.scene_model(physics, SCENE)
        return mjx_step.step(its, physics.data.replace(qpos=qpos, ctrl=ctrl))

    columns = zip(*(_state(world, case) for case in CASES.values()), strict=True)
    states = [np.float32(column) for column in columns]
    data = jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(*states))
    contact = data._impl.contact
    active = contact.dist < contact.includemargin
    deep = np.sum(contact.dist < 0.0, axis=1).tolist()
    depths = [np.sort(dist[row]) for dist, row in zip(contact.dist, active, strict=True)]
    return Ends(data.qvel, depths, deep)


@pytest.fixture(scope="module")
def theirs(world: model.World) -> Ends:
    exact = model.with_blocks(world, jax.device_get(model.scene_fields(world, SCENE)))
    rows, depths = [], []
    for case in CASES.values():
        data = mujoco.MjData(exact)
        data.qpos, data.ctrl = _state(world, case)
        mujoco.mj_step(exact, data)
        rows.append(data.qvel.copy())
        depths.append(np.sort(data.contact.dist[data.contact.dist < 0.0]))
    return Ends(np.stack(rows), depths, [len(row) for row in depths])


@pytest.mark.parametrize("name", CASES)
def test_a_step_is_that_of_c(name: str, ours: Ends, theirs: Ends):
    """Claim: each point of a touch pushes once: as many contacts as in C, to a micrometre. A point
    that MJX repeats keeps its depth. A step leaves C's speeds, at a finger's limit of force too."""
    index = list(CASES).index(name)
    assert len(theirs.depths[index]) == CASES[name].contacts
    np.testing.assert_allclose(ours.depths[index], theirs.depths[index], atol=1e-6)
    assert not CASES[name].contacts or ours.deep[index] == 4
    assert np.abs(theirs.qvel[index]).max() > 0.01
    np.testing.assert_allclose(ours.qvel[index], theirs.qvel[index], atol=0.01)
