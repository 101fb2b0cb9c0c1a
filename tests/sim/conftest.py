"""Scripted and settled scenes, run once in MJX as one batch, and once in C MuJoCo by the same
plan."""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.config import Config, SceneConfig
from csac_jax.constants import Primitive
from csac_jax.objects import body, library, solid
from csac_jax.scene import blocks, layout, model, pool, stock
from csac_jax.scene.layout import Scene
from csac_jax.sim import c_physics, mjx_physics, oracle, physics as simulation, primitives
from csac_jax.sim.outcome import Trace
from csac_jax.sim.primitives import Action, JointTrajectory, Plan
from csac_jax.vision import observe

CONFIG = Config(scene=SceneConfig(slots=("box", "box", "prism"), min_blocks=2, settle_time=1.5))
SETTLED = 40


def place(**shapes: tuple[float, float, float]) -> Scene:
    """A scene of blocks on the table at (x, y, yaw): up to two cubes, one prism; the other slots
    are parked."""
    scene = layout.parked(CONFIG.scene.slots)
    position, quaternion = scene.position.copy(), scene.quaternion.copy()
    slots = {"cube": 0, "other": 1, "prism": 2}
    for name, (x, y, yaw) in shapes.items():
        position[slots[name]] = [x, y, scene.half_size[slots[name], 2]]
        quaternion[slots[name]] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    in_play = np.isin(np.arange(len(position)), [slots[name] for name in shapes])
    return scene.replace(position=position, quaternion=quaternion, in_play=in_play)


def act(primitive: Primitive, x: float, y: float, yaw: float = 0.0) -> Action:
    return Action(primitive=np.int32(primitive), pose=np.float32([x, y, yaw]))


push = functools.partial(act, Primitive.PUSH)
grasp = functools.partial(act, Primitive.GRASP)


BAR = np.float32([0.02, 0.04, 0.025])
"""Half sizes of a bar, m."""


def bar(folder: Path) -> dict[str, Any]:
    """Settings of a scene of one bar of 140 g, from a library that is put in `folder`."""
    corners = BAR * list(itertools.product((-1, 1), repeat=3))
    library.save(folder / "bar", [body.make("bar", [solid.convex(corners)], density=900.0)])
    return {"slots": ("object",), "min_blocks": 1, "objects": str(folder / "bar"), "split": "all"}


def grasped_bar(cfg: Config) -> tuple[Scene, JointTrajectory]:
    """The bar on the table, as a block or an object, and the motion of a hand that grasps it."""
    scene = layout.parked(cfg.scene.slots)
    scene = scene.replace(
        position=np.float32([[0.0, 0.0, BAR[2]]]),
        half_size=BAR[None],
        density=np.float32([900.0]),
        friction=np.float32([0.5]),
        in_play=np.array([True]),
    )
    if cfg.scene.has_objects:
        scene = scene.replace(object_id=np.int32([0]))
    height = np.full((cfg.heightmap.size,) * 2, 2 * BAR[2])
    plan = primitives.plan(cfg.sim, cfg.heightmap, height, grasp(0.0, 0.0))
    return scene, jax.device_get(primitives.joint_trajectory(cfg.sim, plan))


TWO_OBJECTS = presets.get("quick").change(
    scene={"slots": ("object",) * 2, "min_blocks": 2, "objects": "made:0:12"},
    sim={"grasp_phases": (23, 1, 1), "contacts": 96},
)


def thrown_objects(cfg: Config) -> tuple[Scene, JointTrajectory]:
    """Four scenes of two objects, others in each, of few parts and of many, and a hand at rest: at
    first one falls on the other in the air, in the last two both turn and land."""
    rng, known = np.random.default_rng(0), stock.table(cfg.scene)
    order = np.argsort(known.present.sum(axis=1))
    scenes = []
    for row, pair in enumerate(zip(order[:4], order[-4:], strict=True)):
        scene = stock.hold(layout.parked(cfg.scene.slots), np.arange(2), np.array(pair), known)
        turns = rng.normal(size=(2, 4))
        above, aside = [[0.0, 0.0, 0.3], [0.005, 0.0, 0.4]], [[-0.15, 0.0, 0.08], [0.15, 0.0, 0.08]]
        falling, thrown = [[0.0] * 6, [0.0, 0.0, -1.5, 0.0, 0.0, 0.0]], rng.normal(0.0, 3.0, (2, 6))
        thrown[:, :3] = [0.0, 0.0, -0.5]
        scenes.append(
            scene.replace(
                position=np.float32(above if row < 2 else aside),
                quaternion=np.float32(turns / np.linalg.norm(turns, axis=1, keepdims=True)),
                velocity=np.float32(falling if row < 2 else thrown),
                density=np.float32([500.0, 800.0]),
                in_play=np.ones(2, bool),
            )
        )
    start = np.float32([0.0, 0.0, 0.4, 0.0, 0.05, 0.05])
    still = JointTrajectory(start, np.tile(start[:5], (cfg.sim.substeps, 1)), np.ones((), bool))
    return stack(scenes), stack([still] * len(scenes))


def stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def _kicked(scene: Scene, speed: float) -> Scene:
    return dataclasses.replace(
        scene, velocity=scene.velocity + np.float32([[speed, 0, 0, 0, 0, 0], [0] * 6, [0] * 6])
    )


def _spinning() -> Scene:
    """A plank in the air, spinning about all axes as one squeezed from under the hand was seen
    to."""
    scene = place(cube=(0.1, 0.1, 0.0))
    half, position, velocity = scene.half_size.copy(), scene.position.copy(), scene.velocity.copy()
    half[0], position[0, 2], velocity[0, 3:] = (
        blocks.SHAPES["plank"].half_size,
        0.4,
        [148.0, 137.0, -148.0],
    )
    return scene.replace(half_size=half, position=position, velocity=velocity)


CASES: dict[str, tuple[Scene, Action]] = {
    "nothing": (place(cube=(0.1, 0.1, 0.0)), grasp(-0.1, -0.1)),
    # The window sees the corner of a cube beside the pads: 9 mm left of and above the place, 13 mm
    # off their path.
    "empty": (place(cube=(-0.0205, 0.0275, 0.0)), grasp(0.0125, -0.0055, np.pi / 4)),
    "touched": (place(cube=(0.05, 0.0, 0.0)), grasp(0.0, 0.0)),  # a finger comes down on the cube
    "dropped": (
        place(prism=(0.0, 0.0155, 0.0)),
        grasp(0.0, 0.0),
    ),  # across the slopes, off the middle: it slips out
    "lifted": (place(cube=(0.0, 0.0, 0.0), other=(0.15, 0.1, 0.5)), grasp(0.0, 0.0)),
    "push": (place(cube=(0.06, 0.0, 0.0), prism=(-0.1, 0.1, 0.0)), push(0.0, 0.0)),
    "miss": (place(cube=(0.06, 0.06, 0.0)), push(0.0, 0.0)),
    "spinning": (_spinning(), push(-0.1, -0.1)),
    "nan": (
        _kicked(place(cube=(0.0, 0.0, 0.0), other=(0.1, 0.1, 0.0)), np.nan),
        grasp(0.15, -0.15),
    ),
    "exploded": (
        _kicked(place(cube=(0.0, 0.0, 0.0), other=(0.1, 0.1, 0.0)), 1e3),
        grasp(0.15, -0.15),
    ),
}


class Run(NamedTuple):
    """What a batch of primitives started from and came to, leaves [E, ...]: CASES in order, then
    settled scenes."""

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
    per_number = count // (1 + len(config.scene.slots) - config.scene.min_blocks)
    settled = pool.settled(config, pool.TRAIN_STREAM, per_number)
    look = jax.jit(jax.vmap(lambda scene: observe.observe(config, scene).height))
    plan_grasp = functools.partial(oracle.grasp, config)
    grasps = _noisy(jax.jit(jax.vmap(plan_grasp))(settled, look(settled)))
    scenes, actions = settled, grasps
    if scripted:
        alone, acts = (
            jax.tree.map(lambda *leaves: np.stack(leaves), *part)
            for part in zip(*scripted.values(), strict=True)
        )
        scenes, actions = jax.tree.map(
            lambda *leaves: np.concatenate(leaves), (alone, acts), (settled, grasps)
        )
    height = look(scenes)
    physics = mjx_physics.make(world, config.sim)
    run = jax.jit(jax.vmap(functools.partial(simulation.execute, physics, config)))
    return jax.tree.map(np.asarray, Run(scenes, height, actions, *run(scenes, height, actions)))


@pytest.fixture(scope="session")
def config() -> Config:
    return CONFIG


@pytest.fixture(scope="session")
def world() -> model.World:
    return model.build(CONFIG.scene, CONFIG.sim)


@pytest.fixture(scope="session")
def c_world() -> model.World:
    return model.build(CONFIG.scene, dataclasses.replace(CONFIG.sim, physics="c"))


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


@pytest.fixture(scope="session")
def grasped_in_c(c_world: model.World, grasped: Run) -> tuple[np.ndarray, Trace]:
    """The settled scenes' grasps in C MuJoCo, by the same plans: ends [E, N, 3] m and traces."""
    engine = c_physics.CPhysics(c_world, CONFIG.sim)

    def one(scene: Scene, plan: Plan) -> tuple[Scene, Trace]:
        return engine.run(scene, primitives.joint_trajectory(CONFIG.sim, plan))

    run = jax.jit(jax.vmap(one))
    after, trace = jax.tree.map(np.asarray, run(grasped.scene, grasped.plan))
    return after.position, trace


@pytest.fixture(scope="session")
def doubled_caps(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Run]:
    """Grasps in settled scenes of the default configuration, with its contact caps and with twice
    as many."""
    config = Config()
    sim = dataclasses.replace(
        config.sim, geom_pairs=2 * config.sim.geom_pairs, contacts=2 * config.sim.contacts
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("pool")))
        return tuple(
            execute_settled(c, SETTLED, {}) for c in (config, dataclasses.replace(config, sim=sim))
        )
