"""Contact of the hand, as JSON: `csac-jax bench contact [--step MM] [--yaws N] [--warp]`.

Shares of exhaustive grasps that lift some block: of two cubes apart, and of packed cubes, on a grid
of places and yaws, by the most force of the hand and by the kind of descent. `sink_mm` is how far
the tips of an open hand, which comes down on a cube of the lightest density, end below its top.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.baselines import trials
from csac_jax.config import Config, SceneConfig, SimConfig
from csac_jax.constants import Primitive
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Action
from csac_jax.sim import c_physics, physics as simulation
from csac_jax.vision import observe
from csac_jax.world import model, scene_state
from csac_jax.world.scene_state import SceneState
from experiments.bench._options import timed

SIDE, GAP = 0.05, 0.0003  # m, of a cube and between packed ones
FORCES = (100.0, 20.0)  # N
BESIDE = 0.061  # m, from the middle of the open hand to that of a finger
TURNS = 24  # yaws of the hand that comes down on a cube


def _cubes(places: Any) -> SceneState:
    position = np.float32([[x, y, 0.5 * SIDE] for x, y in places])
    half = np.full_like(position, 0.5 * SIDE)
    scene = scene_state.parked(("box",) * len(places))
    return scene.replace(position=position, half_size=half, in_play=np.ones(len(places), bool))


def _packed(rows: int, columns: int) -> SceneState:
    x, y = ((np.arange(n) - 0.5 * (n - 1)) * (SIDE + GAP) for n in (rows, columns))
    return _cubes([(a, b) for a in x for b in y])


SCENES = {
    "two_apart": _cubes([(-0.06, 0.0), (0.06, 0.02)]),
    "packed_2x2": _packed(2, 2),
    "packed_3x3": _packed(3, 3),
}


def _config(count: int, **sim: Any) -> Config:
    scene = SceneConfig(slots=("box",) * count, min_blocks=count)
    return Config(scene=scene, sim=SimConfig(geom_pairs=24, contacts=80, **sim))


def _lifts(cfg: Config, scene: SceneState, poses: np.ndarray) -> float:
    """Returns the share of grasps at poses [A, 3] after which some block hangs in the hand."""
    scene = jax.tree.map(jnp.asarray, scene)
    physics = simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    height = trials.height_map(cfg, scene)

    @jax.jit
    def lifted(poses: jax.Array) -> jax.Array:
        actions = Action(jnp.full(len(poses), Primitive.GRASP, jnp.int32), poses)
        return jnp.any(trials.simulate(cfg, physics, scene, height, actions).lifted, axis=1)

    batches = np.array_split(np.float32(poses), -(-len(poses) // 1024))
    return float(np.concatenate([lifted(batch) for batch in batches]).mean())


def sink(force: float) -> dict[str, float]:
    """Measures how far the tips end below the top of a cube, mm, in C MuJoCo."""
    cfg = _config(1, physics="c", down_force=force)
    world = model.build(cfg.scene, cfg.sim)
    scene = _cubes([(0.0, 0.0)]).replace(density=np.float32([cfg.scene.density[0]]))
    height = observe.observe(cfg, jax.tree.map(jnp.asarray, scene), None).height
    plan = jax.jit(functools.partial(primitives.plan, cfg.sim, cfg.heightmap))
    fields = jax.device_get(model.scene_fields(world, scene))
    deep = []
    for yaw in np.arange(TURNS) * np.pi / TURNS:
        x, y = BESIDE * np.cos(yaw), BESIDE * np.sin(yaw)
        set_points = plan(height, Action.grasp(x, y, yaw))
        joints = jax.device_get(primitives.joint_trajectory(cfg.sim, set_points))
        qpos = c_physics.trajectory(world, fields, scene, joints).qpos
        deep.append(SIDE - qpos[cfg.sim.grasp_phases[0] - 1, world.press_qpos])
    return {"median": 1e3 * float(np.median(deep)), "most": 1e3 * max(deep)}


def _poses(scene: SceneState, step: float, yaws: int) -> np.ndarray:
    """Returns grasps [A, 3] above the cubes, on a grid of places `step` m apart."""
    places = np.arange(-0.12, 0.121, step)
    turns = np.arange(yaws) * np.pi / yaws
    grid = np.stack(np.meshgrid(places, places, turns, indexing="ij"), axis=-1).reshape(-1, 3)
    offset = np.abs(grid[:, None, :2] - scene.position[None, :, :2]).max(axis=2)
    return grid[(offset <= 0.5 * SIDE).any(axis=1)]


def measure(step: int, yaws: int, warp: bool) -> dict[str, Any]:
    """Measures shares of lifts and depths; places are `step` mm apart."""
    poses = {name: _poses(scene, step / 1e3, yaws) for name, scene in SCENES.items()}
    counts = {name: len(grasps) for name, grasps in poses.items()}
    result: dict[str, Any] = {"grasps": counts, "physics": "warp" if warp else "c"}
    hands: dict[str, dict[str, Any]] = {f"{force:g} N": {"down_force": force} for force in FORCES}
    hands["20 N, guarded"] = {"approach": "guarded"}
    for name, hand in hands.items():
        cfg = functools.partial(_config, physics=result["physics"], **hand)
        result[name] = {
            scene: _lifts(cfg(len(blocks.in_play)), blocks, poses[scene])
            for scene, blocks in SCENES.items()
        }
    return result | {"sink_mm": {f"{force:g} N": sink(force) for force in FORCES}}


def main(arguments: list[str]) -> None:
    """Prints the result."""
    timed("contact", arguments, measure, step=12, yaws=8, warp=False)
