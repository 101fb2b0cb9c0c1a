"""Compares how MJX and C MuJoCo move blocks; prints JSON.

`csac-jax bench parity [--primitives N] [--poses N] [--warp] [--off]`: N grasps and N pushes in
piles of 6 and of 10, and N poses of each shape alone. --off puts the grasps of piles at random
places near the planner's, so that some fail. --warp measures MJX on Warp, on CUDA, instead of MJX
on JAX; meshes then have their nominal size.

Both engines get the same settled scenes and actions. The planner that reads poses makes the grasps:
its share of lifts is the ceiling that physics allows. Pushes go through a random block.

Two references show how near two engines can come. In one, C MuJoCo runs against itself with every
block a micrometre aside. In the other it solves a scene as one problem, as MJX does, instead of
each heap of touching blocks by itself.
"""

import dataclasses
import functools
import gc
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from csac_jax import presets
from csac_jax.baselines import oracle
from csac_jax.config import Config, PhysicsKind, SceneConfig, SlotKind
from csac_jax.constants import Outcome, Primitive
from csac_jax.robot.primitives import Action
from csac_jax.scenes import pool
from csac_jax.sim import outcome, physics as simulation
from csac_jax.vision import observe
from csac_jax.world import blocks, model, scene_state
from csac_jax.world.scene_state import SceneState
from experiments.bench._options import emit, read

BATCH = 64
STREAM = 9001  # of drops: neither training's nor an evaluation's
PUSH_RUN_UP = 0.07  # m from the place of a push to the block's centre
REFERENCE = "c"
NUDGE = 1e-6  # m
OFF = np.float32([0.012, 0.012, 0.35])  # m, m, rad, standard deviations
MOVED = 0.01  # m, a push that moves a block by as much has had an effect
TEN = presets.get("fast")
Engine = Callable[[SceneState, jax.Array, Action], Any]  # scenes, heights [E, H, W] m, actions


def pile_config(slots: tuple[SlotKind, ...], in_play: int, physics: PhysicsKind = "mjx") -> Config:
    """Configures scenes of `in_play` blocks with contacts for ten."""
    boxes, meshes = SceneConfig().size_jitter
    jitter = (boxes, 0.0 if physics == "warp" else meshes)
    scene = SceneConfig(slots=slots, min_blocks=in_play, size_jitter=jitter)
    sim = dataclasses.replace(TEN.sim, physics=physics)
    return dataclasses.replace(presets.get("quick"), scene=scene, sim=sim)


def _batches(tree: Any, size: int) -> list[Any]:
    starts = range(0, jax.tree.leaves(tree)[0].shape[0] - size + 1, size)
    return [jax.tree.map(lambda leaf, i=i: leaf[i : i + size], tree) for i in starts]


class Bench:
    """The config's engine and the reference over one world, compiled once each."""

    def __init__(self, cfg: Config) -> None:
        self.cfg = cfg
        self.world = model.build(cfg.scene, cfg.sim)
        self.heights = jax.jit(jax.vmap(lambda scene: observe.observe(cfg, scene).height))
        plan = functools.partial(oracle.grasp, cfg)
        self.oracle = jax.jit(jax.vmap(plan))
        self.push = jax.jit(jax.vmap(_push))
        self.engines = {name: self._engine(name) for name in (cfg.sim.physics, REFERENCE)}
        solved_whole = self._engine(REFERENCE, mujoco.mjtDisableBit.mjDSBL_ISLAND)
        self.references = {
            "c_against_itself_1um": lambda scenes, *rest: self.engines[REFERENCE](
                _nudged(scenes), *rest
            ),
            "c_against_itself_solved_whole": solved_whole,
        }

    def _engine(self, name: Any, disabled: int = 0) -> Engine:
        """Compiles a physics with these MuJoCo features disabled."""
        cfg = dataclasses.replace(self.cfg, sim=dataclasses.replace(self.cfg.sim, physics=name))
        world = model.build(cfg.scene, cfg.sim)
        world.model.opt.disableflags |= disabled
        engine = simulation.make(world, cfg.sim)
        return jax.jit(jax.vmap(functools.partial(simulation.execute, engine, cfg)))

    def run(
        self, engines: dict[str, Engine], scenes: SceneState, actions: Action
    ) -> dict[str, Any]:
        """Runs engines: ends [E, N, 3], outcomes, overflows and failures [E] of each."""
        height = self.heights(scenes)
        result = {}
        for name, engine in engines.items():
            after, trace, plan = jax.block_until_ready(engine(scenes, height, actions))
            rise = plan.start[:, 2] - jnp.min(plan.control[:, :, 2], axis=1)
            judged = jax.vmap(outcome.grasp_outcome)(trace, plan.surface, rise)
            physics_diverged = ~jax.vmap(simulation.healthy)(after)
            result[name] = jax.device_get(
                (after.position, judged, trace.contact_overflow, physics_diverged)
            )
        return result


def _nudged(scenes: SceneState) -> SceneState:
    """Moves each block in play by a micrometre, each in its own direction."""
    angle = np.random.default_rng(STREAM).uniform(0.0, 2.0 * np.pi, scenes.position.shape[:2])
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    step = NUDGE * direction * scenes.in_play[..., None]
    return scenes.replace(position=scenes.position + step.astype(np.float32))


def _push(key: jax.Array, scene: SceneState) -> Action:
    """Draws a push through a random block in play, from a random side."""
    key_slot, key_yaw = jax.random.split(key)
    slot = jax.random.categorical(key_slot, jnp.where(scene.in_play, 0.0, -jnp.inf))
    yaw = jax.random.uniform(key_yaw, (), maxval=2.0 * np.pi)
    place = scene.position[slot, :2] - PUSH_RUN_UP * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
    return Action(primitive=jnp.int32(Primitive.PUSH), pose=jnp.append(place, yaw))


def _beside(key: jax.Array, action: Action) -> Action:
    """Moves an action to a normally distributed place and yaw near it."""
    return action.replace(pose=action.pose + OFF * jax.random.normal(key, (3,)))


def piles(
    in_play: int, slots: tuple[SlotKind, ...], count: int, physics: PhysicsKind, off: bool
) -> dict[str, Any]:
    """Compares grasps and pushes in settled piles."""
    cfg = pile_config(slots, in_play, physics)
    bench = Bench(cfg)
    settled = pool.settled(cfg, STREAM, count)
    rows, engines = [], bench.engines | bench.references
    for number, scenes in enumerate(_batches(settled, min(BATCH, count))):
        keys = jax.random.split(jax.random.fold_in(jax.random.key(0), number), len(scenes.target))
        grasps = bench.oracle(scenes, bench.heights(scenes))
        grasps = jax.vmap(_beside)(keys, grasps) if off else grasps
        pushes = bench.push(keys, scenes)
        rows.append((scenes, *(bench.run(engines, scenes, act) for act in (grasps, pushes))))
    starts = np.concatenate([row[0].position for row in rows])

    def joined(i: int) -> dict[str, list[np.ndarray]]:
        leaves = {name: zip(*(row[i][name] for row in rows), strict=True) for name in engines}
        return {name: list(map(np.concatenate, every)) for name, every in leaves.items()}

    grasped, pushed = joined(1), joined(2)
    lifted = {name: float(np.mean(grasped[name][1] == Outcome.LIFTED)) for name in bench.engines}
    overflows = np.concatenate([grasped[physics][2], pushed[physics][2]])
    return {
        "blocks": in_play,
        "grasps": len(starts),
        "oracle_lifts": lifted,
        **_agreement(starts, physics, grasped, pushed),
        **{name: _agreement(starts, name, grasped, pushed) for name in bench.references},
        "saturated_substeps_share": float(overflows.mean() / cfg.sim.substeps),
        "physics_diverged": int(grasped[physics][3].sum() + pushed[physics][3].sum()),
    }


def _agreement(
    starts: np.ndarray, name: str, grasped: dict[str, list], pushed: dict[str, list]
) -> dict[str, Any]:
    """Compares grasps and pushes of the engine `name` with those of the reference."""
    both = pushed[name], pushed[REFERENCE]
    effect, wanted = (np.linalg.norm(run[0] - starts, axis=2).max(axis=1) > MOVED for run in both)
    return {
        "grasp_outcome_equal": float(np.mean(grasped[name][1] == grasped[REFERENCE][1])),
        "push_effect_equal": float(np.mean(effect == wanted)),
        "pushes_with_effect": [float(effect.mean()), float(wanted.mean())],
        "pushed_block_apart_mm": _distances(starts, *both),
    }


def _distances(
    starts: np.ndarray, pushed: list[np.ndarray], reference: list[np.ndarray]
) -> dict[str, float]:
    """Measures the distance between the engines' ends of the block that moved most, mm."""
    moved = np.linalg.norm(reference[0] - starts, axis=2)
    slot = moved.argmax(axis=1)
    rows = np.arange(len(slot))
    distance = 1e3 * np.linalg.norm(pushed[0][rows, slot] - reference[0][rows, slot], axis=1)
    return {
        "median": float(np.median(distance)),
        "p95": float(np.percentile(distance, 95)),
        "median_moved": float(1e3 * np.median(moved[rows, slot])),
        "pushes": len(rows),
    }


def shapes(poses: int, physics: PhysicsKind) -> dict[str, Any]:
    """Compares grasps of a single block of every shape, at rest after a fall."""
    slots: tuple[SlotKind, ...] = ("box", "arch", "prism", "half_cylinder", "cylinder")
    cfg = pile_config(slots, 1, physics)
    bench = Bench(cfg)
    each = {name: _resting(bench, cfg, name, poses) for name in blocks.SHAPES}
    scenes = jax.tree.map(lambda *leaves: np.concatenate(leaves), *each.values())
    total, size = len(blocks.SHAPES) * poses, min(BATCH, poses)
    padded = jax.tree.map(lambda leaf: np.concatenate([leaf, leaf[: -total % size]]), scenes)
    runs = [
        bench.run(bench.engines, batch, bench.oracle(batch, bench.heights(batch)))
        for batch in _batches(padded, size)
    ]
    lifted = {
        name: np.concatenate([run[name][1] for run in runs])[:total].reshape(-1, poses)
        == Outcome.LIFTED
        for name in bench.engines
    }
    return {
        "poses_per_shape": poses,
        "lifted": {
            name: {shape: float(row.mean()) for shape, row in zip(blocks.SHAPES, rows, strict=True)}
            for name, rows in lifted.items()
        },
        "lifted_over_all": {name: float(rows.mean()) for name, rows in lifted.items()},
    }


def _resting(bench: Bench, cfg: Config, shape: str, count: int) -> SceneState:
    """Drops a block of this shape until `count` scenes are at rest."""
    rng = np.random.default_rng([STREAM, list(blocks.SHAPES).index(shape)])
    slot = cfg.scene.slots.index(blocks.SHAPES[shape].kind)
    at_rest: list[SceneState] = []
    while len(at_rest) < count:
        scene = jax.tree.map(np.copy, scene_state.parked(cfg.scene.slots))
        rotation = rng.normal(size=4)
        scene.half_size[slot] = blocks.SHAPES[shape].half_size
        scene.position[slot] = [*rng.uniform(-0.12, 0.12, 2), cfg.scene.drop_height]
        scene.quaternion[slot] = rotation / np.linalg.norm(rotation)
        dropped = scene.replace(in_play=np.arange(len(scene.half_size)) == slot)
        fields = jax.device_get(model.scene_fields(bench.world, dropped))
        ended = pool.rest(bench.world, cfg, dropped, fields)
        at_rest += [ended] if ended is not None else []
    return jax.tree.map(lambda *leaves: np.stack(leaves), *at_rest)


def main(arguments: list[str]) -> None:
    """Prints the result."""
    options = read("parity", arguments, primitives=512, poses=125, warp=False, off=False)
    physics: PhysicsKind = "warp" if options["warp"] else "mjx"
    if options["warp"]:
        gc.disable()  # CUDA ends the process where a program is freed while Warp records a graph
    begun = time.perf_counter()
    result: dict[str, Any] = {"physics": physics, "shapes": shapes(options["poses"], physics)}
    for num in (6, 10):
        result[f"piles_of_{num}"] = piles(
            num, TEN.scene.slots[:num], options["primitives"], physics, bool(options["off"])
        )
    result["seconds"] = time.perf_counter() - begun
    emit(result)
