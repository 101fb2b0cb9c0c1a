"""Scripted scenes on every engine; settled scenes in MJX, and in C MuJoCo by the same plans."""

import dataclasses
import functools
import importlib.util
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.baselines import oracle
from csac_jax.config import Config, SceneConfig
from csac_jax.constants import Primitive
from csac_jax.objects import body, library, solid
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Action, JointTrajectory, Plan
from csac_jax.scenes import pool
from csac_jax.sim import c_physics, physics as simulation
from csac_jax.sim.outcome import Trace
from csac_jax.vision import observe
from csac_jax.world import blocks, model, object_slots, scene_state
from csac_jax.world.scene_state import SceneState

CONFIG = Config(scene=SceneConfig(slots=("box", "box", "prism"), min_blocks=2, settle_time=1.5))
SETTLED = 40
HAS_WARP = importlib.util.find_spec("warp") is not None
_NO_WARP = pytest.mark.skipif(not HAS_WARP, reason="Warp is an extra: pip install 'csac-jax[warp]'")
WARP = pytest.param("warp", marks=[pytest.mark.slow, _NO_WARP])


def place(**shapes: tuple[float, float, float]) -> SceneState:
    """A scene of up to two cubes and a prism at (x, y, yaw) on the table; other slots parked."""
    scene = scene_state.parked(CONFIG.scene.slots)
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
BAR = np.float32([0.02, 0.04, 0.025])  # m, half sizes of a bar


def planned(cfg: Config, height: np.ndarray, action: Action) -> JointTrajectory:
    """Plans the joints of an action."""

    @jax.jit
    def joints(height: jax.Array, action: Action) -> JointTrajectory:
        plan = primitives.plan(cfg.sim, cfg.heightmap, height, action)
        return primitives.joint_trajectory(cfg.sim, plan)

    return jax.device_get(joints(height, action))


def bar(folder: Path) -> dict[str, Any]:
    """Settings of a scene of one bar of 140 g, from a library in `folder`."""
    corners = BAR * list(itertools.product((-1, 1), repeat=3))
    library.save(folder / "bar", [body.make("bar", [solid.convex(corners)], density=900.0)])
    return {"slots": ("object",), "min_blocks": 1, "objects": str(folder / "bar"), "split": "all"}


def grasped_bar(cfg: Config) -> tuple[SceneState, JointTrajectory]:
    """The bar on the table, as a block or an object, and the motion of a hand that grasps it."""
    scene = scene_state.parked(cfg.scene.slots)
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
    return scene, planned(cfg, height, grasp(0.0, 0.0))


TWO_OBJECTS = presets.get("quick").change(
    scene={"slots": ("object",) * 2, "min_blocks": 2, "objects": "procedural:0:12"},
    sim={"grasp_phases": (23, 1, 1), "contacts": 96},
)


def thrown_objects(cfg: Config) -> tuple[SceneState, JointTrajectory]:
    """Four scenes of two objects: in two, one falls on the other; in two, both turn and land."""
    rng, known = np.random.default_rng(0), object_slots.table(cfg.scene)
    order = np.argsort(known.present.sum(axis=1))
    scenes = []
    parked = scene_state.parked(cfg.scene.slots)
    for row, pair in enumerate(zip(order[:4], order[-4:], strict=True)):
        scene = object_slots.hold(parked, np.arange(2), np.array(pair), known)
        turns = rng.normal(size=(2, 4))
        above, aside = [[0.0, 0.0, 0.3], [0.005, 0.0, 0.4]], [[-0.15, 0.0, 0.08], [0.15, 0.0, 0.08]]
        falling, thrown = [[0.0] * 6, [0.0, 0.0, -1.5, 0.0, 0.0, 0.0]], rng.normal(0.0, 3.0, (2, 6))
        thrown[:, :3] = [0.0, 0.0, -0.5]
        scene = scene.replace(
            position=np.float32(above if row < 2 else aside),
            quaternion=np.float32(turns / np.linalg.norm(turns, axis=1, keepdims=True)),
            velocity=np.float32(falling if row < 2 else thrown),
            density=np.float32([500.0, 800.0]),
            in_play=np.ones(2, bool),
        )
        scenes.append(scene)
    start = np.float32([0.0, 0.0, 0.4, 0.0, 0.05, 0.05])
    still = JointTrajectory(start, np.tile(start[:5], (cfg.sim.substeps, 1)), np.ones((), bool))
    return stack(scenes), stack([still] * len(scenes))


def stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def _kicked(speed: float) -> SceneState:
    scene = place(cube=(0.0, 0.0, 0.0), other=(0.1, 0.1, 0.0))
    kick = np.zeros((3, 6), np.float32)
    kick[0, 0] = speed
    return scene.replace(velocity=scene.velocity + kick)


def _spinning() -> SceneState:
    """A plank in the air, spinning about all axes like one squeezed from under the hand."""
    scene = place(cube=(0.1, 0.1, 0.0))
    half, position, velocity = scene.half_size.copy(), scene.position.copy(), scene.velocity.copy()
    half[0], position[0, 2] = blocks.SHAPES["plank"].half_size, 0.4
    velocity[0, 3:] = [148.0, 137.0, -148.0]
    return scene.replace(half_size=half, position=position, velocity=velocity)


CASES: dict[str, tuple[SceneState, Action]] = {
    "nothing": (place(cube=(0.1, 0.1, 0.0)), grasp(-0.1, -0.1)),
    # The window sees the corner of a cube 13 mm off the pads' path.
    "empty": (place(cube=(-0.0205, 0.0275, 0.0)), grasp(0.0125, -0.0055, np.pi / 4)),
    "touched": (place(cube=(0.05, 0.0, 0.0)), grasp(0.0, 0.0)),  # a finger comes down on the cube
    # Across the slopes, off the middle: it slips out.
    "dropped": (place(prism=(0.0, 0.026, 1.2)), grasp(0.0, 0.0)),
    "lifted": (place(cube=(0.0, 0.0, 0.0), other=(0.15, 0.1, 0.5)), grasp(0.0, 0.0)),
    "push": (place(cube=(0.06, 0.0, 0.0), prism=(-0.1, 0.1, 0.0)), push(0.0, 0.0)),
    "miss": (place(cube=(0.06, 0.06, 0.0)), push(0.0, 0.0)),
    "spinning": (_spinning(), push(-0.1, -0.1)),
    "nan": (_kicked(np.nan), grasp(0.15, -0.15)),
    "kicked": (_kicked(1e3), grasp(0.15, -0.15)),
}


class Run(NamedTuple):
    """Inputs and results of a batch of primitives, leaves [E, ...]: CASES in order, then others."""

    scene: SceneState
    height: np.ndarray
    action: Action
    after: SceneState
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


@functools.cache
def _programs(config: Config) -> tuple[Any, Any]:
    """Compiles the height maps and the primitives of a batch of scenes."""
    physics = simulation.make(model.build(config.scene, config.sim), config.sim)
    heights = jax.vmap(lambda scene: observe.observe(config, scene).height)
    run = jax.vmap(functools.partial(simulation.execute, physics, config))
    return jax.jit(heights), jax.jit(run)


def execute(config: Config, scenes: SceneState, actions: Action) -> Run:
    """Runs actions in scenes, leaves [E, ...], on the config's engine, in batches as CASES."""
    heights, run = _programs(config)
    results = []
    for start in range(0, len(scenes.in_play), len(CASES)):
        rows = jax.tree.map(lambda leaf, at=start: leaf[at : at + len(CASES)], (scenes, actions))
        height = heights(rows[0])
        inputs = (rows[0], height, rows[1])
        results.append(Run(*inputs, *run(*inputs)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *results)


def execute_settled(config: Config, count: int) -> Run:
    """Runs grasps in `count` settled scenes in MJX, as one batch."""
    config = config.change(sim={"physics": "mjx"})
    per_number = count // (1 + len(config.scene.slots) - config.scene.min_blocks)
    settled = pool.settled(config, pool.TRAIN_STREAM, per_number)

    def plan(scene: SceneState) -> Action:
        return oracle.grasp(config, scene, observe.observe(config, scene).height)

    return execute(config, settled, _noisy(jax.jit(jax.vmap(plan))(settled)))


@pytest.fixture(scope="session")
def world() -> model.World:
    return model.build(CONFIG.scene, CONFIG.sim)


@pytest.fixture(scope="session")
def c_world() -> model.World:
    return model.build(CONFIG.scene, dataclasses.replace(CONFIG.sim, physics="c"))


@pytest.fixture(scope="session", params=["c", pytest.param("mjx", marks=pytest.mark.slow), WARP])
def cases(request: pytest.FixtureRequest) -> Run:
    """CASES on each engine."""
    jitter = CONFIG.scene.size_jitter
    if request.param == "warp":  # whose meshes have one size
        jitter = (jitter[0], 0.0)
    cfg = CONFIG.change(scene={"size_jitter": jitter}, sim={"physics": request.param})
    return execute(cfg, *stack(list(CASES.values())))


@pytest.fixture(scope="session")
def grasped(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Grasps in settled scenes in MJX: one compilation for the tests of this folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("pool")))
        return execute_settled(CONFIG, SETTLED)


@pytest.fixture(scope="session")
def grasped_in_c(c_world: model.World, grasped: Run) -> tuple[np.ndarray, Trace]:
    """The same plans in C MuJoCo: ends [E, N, 3] m and traces."""
    engine = c_physics.CPhysics(c_world, CONFIG.sim)

    def one(scene: SceneState, plan: Plan) -> tuple[SceneState, Trace]:
        return engine.run(scene, primitives.joint_trajectory(CONFIG.sim, plan))

    run = jax.jit(jax.vmap(one))
    after, trace = jax.tree.map(np.asarray, run(grasped.scene, grasped.plan))
    return after.position, trace


@pytest.fixture(scope="session")
def doubled_caps(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Run]:
    """Grasps in settled scenes by default, with its contact caps and with twice as many."""
    config = Config()
    caps = {"geom_pairs": 2 * config.sim.geom_pairs, "contacts": 2 * config.sim.contacts}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("pool")))
        return tuple(execute_settled(cfg, SETTLED) for cfg in (config, config.change(sim=caps)))
