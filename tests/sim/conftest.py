"""Scripted and settled scenes, run once in MJX as one batch, and once in C MuJoCo by the same plan."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax.config import Config, SceneConfig
from csac_jax.env import Env
from csac_jax.scene import blocks, layout, model, pool
from csac_jax.scene.layout import Scene
from csac_jax.sim import mjx_physics, oracle, primitives
from csac_jax.sim.outcome import Trace
from csac_jax.sim.primitives import Action, Plan

CONFIG = Config(scene=SceneConfig(slots=("box", "box", "prism"), min_blocks=2, settle_time=1.5))
SETTLED = 40
CUBE = 0  # row of blocks.BOX_HALF_SIZES


def place(**shapes: tuple[float, float, float]) -> Scene:
    """A scene of blocks on the table at (x, y, yaw): up to two cubes, one prism; the other slots are parked."""
    num = len(CONFIG.scene.slots)
    position, quaternion = layout.parking(num), np.tile(np.float32([1, 0, 0, 0]), (num, 1))
    half_size = np.stack([blocks.half_size_choices(kind)[CUBE] for kind in CONFIG.scene.slots])
    slots = {"cube": 0, "other": 1, "prism": 2}
    for name, (x, y, yaw) in shapes.items():
        position[slots[name]] = [x, y, half_size[slots[name], 2]]
        quaternion[slots[name]] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    in_play = np.isin(np.arange(num), [slots[name] for name in shapes])
    velocity, colour = np.zeros((num, 6), np.float32), np.arange(num, dtype=np.int32)
    return Scene(position, quaternion, velocity, half_size, colour, in_play)


def act(primitive: primitives.Primitive, x: float, y: float, yaw: float = 0.0) -> Action:
    return Action(primitive=np.int32(primitive), pose=np.float32([x, y, yaw]))


push = functools.partial(act, primitives.Primitive.PUSH)
grasp = functools.partial(act, primitives.Primitive.GRASP)


def _kicked(scene: Scene, speed: float) -> Scene:
    return dataclasses.replace(scene, velocity=scene.velocity + np.float32([[speed, 0, 0, 0, 0, 0], [0] * 6, [0] * 6]))


CASES: dict[str, tuple[Scene, Action]] = {
    "nothing": (place(cube=(0.1, 0.1, 0.0)), grasp(-0.1, -0.1)),
    # The window sees the corner of a cube beside the pads: 9 mm left of and above the place, 13 mm off their path.
    "empty": (place(cube=(-0.0205, 0.0275, 0.0)), grasp(0.0125, -0.0055, np.pi / 4)),
    "touched": (place(cube=(0.05, 0.0, 0.0)), grasp(0.0, 0.0)),  # a finger comes down on the cube
    "dropped": (place(prism=(0.0, 0.02, 0.0)), grasp(0.0, 0.0)),  # across the slopes, off the middle: it slips out
    "lifted": (place(cube=(0.0, 0.0, 0.0), other=(0.15, 0.1, 0.5)), grasp(0.0, 0.0)),
    "push": (place(cube=(0.06, 0.0, 0.0), prism=(-0.1, 0.1, 0.0)), push(0.0, 0.0)),
    "miss": (place(cube=(0.06, 0.06, 0.0)), push(0.0, 0.0)),
    "nan": (_kicked(place(cube=(0.0, 0.0, 0.0), other=(0.1, 0.1, 0.0)), np.nan), grasp(0.15, -0.15)),
    "exploded": (_kicked(place(cube=(0.0, 0.0, 0.0), other=(0.1, 0.1, 0.0)), 1e3), grasp(0.15, -0.15)),
}


class Run(NamedTuple):
    """What a batch of primitives started from and came to, leaves [E, ...]: CASES in order, then settled scenes."""

    scene: Scene
    height: np.ndarray
    action: Action
    after: Scene
    trace: Trace
    plan: Plan

    def case(self, name: str) -> "Run":
        """The scripted case `name` by itself."""
        return self.at(list(CASES).index(name))

    def at(self, index: int) -> "Run":
        return jax.tree.map(lambda leaf: leaf[index], self)

    @property
    def hand_rise(self) -> np.ndarray:
        return self.plan.start[..., 2] - self.plan.control[..., 2].min(axis=-1)


def _noisy(actions: Action) -> Action:
    """Grasps of the oracle, one in four beside its place and turned, so that outcomes differ."""
    noise = np.random.default_rng(0).normal(size=(SETTLED, 3)) * [0.03, 0.03, 0.5]
    noise[np.arange(SETTLED) % 4 > 0] = 0.0
    return actions.replace(pose=np.asarray(actions.pose) + noise.astype(np.float32))


def execute_settled(config: Config, count: int, scripted: dict[str, tuple[Scene, Action]]) -> Run:
    """Runs the scripted cases and grasps in `count` settled scenes of `config`, as one batch."""
    world = model.build(config.scene, config.sim)
    settled = pool.settled(world, config.scene, config.heightmap.extent, pool.TRAIN_STREAM, count)
    look = jax.jit(jax.vmap(lambda scene: Env(config, None, None).look(scene).height))
    plan_grasp = functools.partial(oracle.grasp, config.sim, config.heightmap, config.scene.slots)
    grasps = _noisy(jax.jit(jax.vmap(plan_grasp))(settled, look(settled)))
    scenes, actions = settled, grasps
    if scripted:
        alone, acts = (
            jax.tree.map(lambda *leaves: np.stack(leaves), *part) for part in zip(*scripted.values(), strict=True)
        )
        scenes, actions = jax.tree.map(lambda *leaves: np.concatenate(leaves), (alone, acts), (settled, grasps))
    height = look(scenes)
    physics = mjx_physics.make(world)
    run = jax.jit(jax.vmap(functools.partial(mjx_physics.execute, physics, config.sim, config.heightmap)))
    return jax.tree.map(np.asarray, Run(scenes, height, actions, *run(scenes, height, actions)))


@pytest.fixture(scope="session")
def config() -> Config:
    return CONFIG


@pytest.fixture(scope="session")
def world() -> model.World:
    return model.build(CONFIG.scene, CONFIG.sim)


@pytest.fixture(scope="session")
def executed(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """CASES and SETTLED grasps in MJX: the one compilation that the tests of this folder share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("pool")))
        return execute_settled(CONFIG, SETTLED, CASES)


@pytest.fixture(scope="session")
def grasped(executed: Run) -> Run:
    """The grasps in settled scenes among them."""
    return executed.at(slice(len(CASES), None))


def in_c(world: model.World, closed_at: int, run: Run) -> tuple[np.ndarray, Trace]:
    """Ends [N, 3] m and trace of one primitive in C MuJoCo, by the plan of `run`; `closed_at`: when the hand closed."""
    scene, slots = run.scene, model.box_slots(world)
    fields = jax.tree.map(np.asarray, model.box_fields(jnp.asarray(scene.half_size[slots])))
    exact = model.with_boxes(world, fields)
    data, parked = mujoco.MjData(exact), ~scene.in_play
    data.qpos[world.hand_qpos] = np.append(run.plan.start, run.plan.start[4])
    data.qpos[world.block_qpos] = start = np.concatenate([scene.position, scene.quaternion], axis=1)
    touched, gap_closed, held_rise = False, 0.0, np.zeros(len(parked))
    for index, control in enumerate(run.plan.control):
        data.ctrl[:] = control
        mujoco.mj_step(exact, data)
        data.qpos[world.block_qpos[parked]], data.qvel[world.block_dofs[parked]] = start[parked], 0.0
        pairs = {frozenset(pair) for pair in data.contact.geom[data.contact.dist < 0.0].tolist()}
        touching = np.array([[{hand, block} in pairs for block in world.block_geoms] for hand in world.hand_geoms])
        held, rise = touching[1] & touching[2], data.qpos[world.block_qpos[:, 2]] - scene.position[:, 2]
        touched |= touching.any()
        held_rise = np.where(held, np.maximum(held_rise, rise), held_rise)
        gap = 2.0 * data.qpos[world.hand_qpos[4]]
        gap_closed = gap if index == closed_at else gap_closed
    leaves = (touched, held_rise, held, rise, gap_closed, gap, 0)
    return data.qpos[world.block_qpos[:, :3]], Trace(*map(np.asarray, leaves))


@pytest.fixture(scope="session")
def grasped_in_c(world: model.World, grasped: Run) -> tuple[np.ndarray, Trace]:
    """The settled scenes' grasps in C MuJoCo: ends [E, N, 3] m and traces."""
    closed_at = sum(CONFIG.sim.grasp_phases[:2]) - 1
    each = [in_c(world, closed_at, grasped.at(index)) for index in range(SETTLED)]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *each)


@pytest.fixture(scope="session")
def doubled_caps(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Run]:
    """Grasps in settled scenes of the default configuration, with its contact caps and with twice as many."""
    config = Config()
    sim = dataclasses.replace(config.sim, geom_pairs=2 * config.sim.geom_pairs, contacts=2 * config.sim.contacts)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("pool")))
        return tuple(execute_settled(c, SETTLED, {}) for c in (config, dataclasses.replace(config, sim=sim)))
