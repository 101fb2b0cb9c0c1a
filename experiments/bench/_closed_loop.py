"""Episodes in which a deployed policy sees images of MuJoCo's renderer and moves a robot."""

import argparse
import collections
import functools
import itertools
import statistics
import time
import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import Config, SensorConfig, SimConfig
from csac_jax.constants import OUTCOMES
from csac_jax.deploy import CameraPolicy
from csac_jax.deploy.decision import Decision
from csac_jax.deploy.record import PUSHED, Recorder, ReportedOutcome
from csac_jax.env import Env
from csac_jax.errors import DataWarning, ViewError
from csac_jax.evaluation import suites
from csac_jax.evaluation.metrics import wilson
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Plan
from csac_jax.sim import outcome, physics as simulation
from csac_jax.vision import camera, sensor
from csac_jax.world import model, scene_state
from csac_jax.world.scene_state import SceneState
from experiments.bench._rgbd import RgbdRenderer, intrinsics

COUNTED = (
    *("grasps", "pushes", "refused", "nothing_to_act_on", "out_of_reach", "warnings"),
    *("blocks", "blocks_taken", "blocks_lost", "table_empty", "all_taken", *OUTCOMES),
)
"""Counters: actions, decisions and images, blocks, episodes, grasps by outcome."""
MOVED = 0.01  # m, a block that moves less has not changed the scene


class Loop(NamedTuple):
    """A policy, and the scenes that it acts in."""

    policy: CameraPolicy
    env: Env
    episodes: int
    seed: int
    recorder: Recorder | None  # of images, decisions and outcomes


def make(options: argparse.Namespace) -> Loop:
    """Makes the loop of a policy, see `CameraPolicy.load`, in a suite of one part."""
    policy = CameraPolicy.load(options.policy, gripper=options.gripper)
    world = suites.standard(policy.cfg, options.suite)
    clear = world.change(sensor=SensorConfig(), heightmap={"view": "oblique"})
    cfg = clear.change(sim={"physics": "c", "robot": options.robot})
    scenes = options.episodes, options.seed
    (env,) = suites.prepare(cfg, options.suite, *scenes, objects=options.objects).parts.values()
    recorder = options.record and Recorder(options.record, options.policy)
    return Loop(policy, env, *scenes, recorder)


class Step(NamedTuple):
    """The result of a motion of the robot. N = block slots."""

    scene: SceneState
    reachable: jax.Array  # [] bool
    lifted: jax.Array  # [N] bool
    blocks_lost: jax.Array  # [] int32
    outcome: jax.Array  # [] int32, Outcome of a grasp, EMPTY at least
    moved: jax.Array  # [] bool, the scene has changed


def set_points(cfg: SimConfig, decision: Decision) -> np.ndarray:
    """Computes set-points of the hand [1 + T, 5], as `primitives.Plan.control`, from waypoints."""
    stations = np.array(
        [(*point.position, point.yaw, 0.5 * point.opening) for point in decision.waypoints]
    )
    is_grasp = decision.primitive == "grasp"
    phases, rows = cfg.grasp_phases if is_grasp else cfg.push_phases, [stations[:1]]
    for phase, (begin, end) in enumerate(itertools.pairwise(stations)):
        share = np.arange(1, phases[phase] + 1)[:, None] / phases[phase]
        share = share**2 * (3.0 - 2.0 * share) if phase == 2 else share
        rows.append(begin + share * (end - begin))
        closing = np.minimum(1.3 * share[:, 0], 1.0)  # before the way ends: the retreat begins
        rows[-1][:, 4] = begin[4] + closing * (end[4] - begin[4])
    return np.concatenate(rows).astype(np.float32)


@functools.partial(jax.jit, static_argnums=0)
def act(env: Env, scene: SceneState, control: jax.Array, is_grasp: jax.Array) -> Step:
    """Moves the robot along set-points [1 + T, 5]; blocks lifted or lost are taken away."""
    plan = Plan(control[1:], control[0], jnp.float32(1.0))
    joints = primitives.joint_trajectory(env.cfg.sim, plan)
    after, trace = env.physics.run(scene, joints)
    rise = plan.start[2] - jnp.min(plan.control[:, 2])
    lifted = outcome.lifted_blocks(trace, rise) & is_grasp
    inside = scene_state.inside(after.position, env.cfg.heightmap.extent)
    way = jnp.linalg.norm(after.position - scene.position, axis=1)
    return Step(
        scene=scene_state.park(after, ~lifted & inside),
        reachable=joints.reachable & simulation.healthy(after),
        lifted=lifted,
        blocks_lost=jnp.sum(after.in_play & ~inside & ~lifted, dtype=jnp.int32),
        outcome=outcome.grasp_outcome(trace, plan.surface, rise),
        moved=jnp.any((way > MOVED) & scene.in_play),
    )


def measure(loop: Loop, errors: SensorConfig) -> dict[str, Any]:
    """Runs all episodes with images of this sensor and counts what happens."""
    counts = collections.Counter(dict.fromkeys(COUNTED, 0))
    seconds: list[float] = []
    for number in range(loop.episodes):
        _episode(loop, errors, number, counts, seconds)
    return {
        "sensor": errors.kind,
        "grasp_success": wilson(counts["lifted"], counts["grasps"]),
        "completion": wilson(counts["all_taken"], loop.episodes),
        "completion_reachable": wilson(counts["table_empty"], loop.episodes),
        "counts": dict(counts),
        "ms_per_decision": 1e3 * statistics.median(seconds),
    }


def _episode(
    loop: Loop,
    errors: SensorConfig,
    number: int,
    counts: collections.Counter[str],
    seconds: list[float],
) -> None:
    """Runs one episode; adds to `counts` and the time of every decision to `seconds`."""
    env, task = loop.env, loop.env.cfg.task
    scene = _first_scene(loop, number)
    blocks, taken_before = int(scene.in_play.sum()), counts["blocks_taken"]
    counts["blocks"] += blocks
    world = model.build(env.cfg.scene, env.cfg.sim)
    studio = RgbdRenderer(world, scene, env.cfg.camera.size)
    unchanged, episode_key = 0, jax.random.fold_in(jax.random.key(loop.seed), number)
    for action in range(task.max_actions):
        key = jax.random.fold_in(episode_key, action)
        image = _photograph(env.cfg, errors, key, studio, scene)
        begun = time.perf_counter()
        decisions = _decide(loop.policy, env.cfg, image, counts)
        seconds.append(time.perf_counter() - begun)
        moved, reported = False, None
        if decisions:
            scene, moved, reported = _move(env, scene, decisions[0], counts)
        unchanged = 0 if moved else unchanged + 1
        ended = not scene.in_play.any() or unchanged >= task.max_steps_without_change
        ended |= action + 1 == task.max_actions
        if loop.recorder and reported:
            seen = (*image, intrinsics(env.cfg.camera), _pose(env.cfg), None)
            entry = loop.recorder.add(seen, decisions)
            loop.recorder.post(entry, ReportedOutcome(outcome=reported, ended=bool(ended)))
        if ended:
            break
    studio.close()
    counts["table_empty"] += not scene.in_play.any()
    counts["all_taken"] += counts["blocks_taken"] - taken_before == blocks


def _pose(cfg: Config) -> np.ndarray:
    """Returns the pose that the policy is given [4, 4], camera to workspace."""
    eye, pose = camera.make(cfg.camera), np.eye(4)
    pose[:3, :3], pose[:3, 3] = eye.rotation, eye.position
    return pose


def _first_scene(loop: Loop, number: int) -> SceneState:
    """Returns the scene that an episode of `eval` with this seed starts with."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(loop.seed), 0), number)
    row = number * loop.env.scenes.position.shape[0] // loop.episodes
    scene = jax.tree.map(lambda leaf: jnp.asarray(leaf[row]), loop.env.scenes)
    return jax.device_get(loop.env.randomise_pose(key, scene))


def _photograph(
    cfg: Config, errors: SensorConfig, key: jax.Array, studio: RgbdRenderer, scene: SceneState
) -> tuple[np.ndarray, np.ndarray]:
    """Renders colour and depth of a scene as the sensor gives them."""
    key_pose, key_image = jax.random.split(key)
    real = sensor.pose(key_pose, errors, camera.make(cfg.camera))
    rgb, depth = studio.image(scene, real)
    if not errors.active:
        return rgb, depth
    return jax.device_get(_sensed(key_image, errors, cfg.camera, rgb, depth))


_sensed = jax.jit(sensor.image, static_argnums=(1, 2))


def _decide(
    policy: CameraPolicy, cfg: Config, image: Any, counts: collections.Counter[str]
) -> list[Decision]:
    """Returns the best action, or none where the image is refused or shows nothing to act on."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DataWarning)
        try:
            decisions = policy.decide(*image, intrinsics(cfg.camera), _pose(cfg))
        except ViewError:
            counts["refused"] += 1
            return []
    counts["warnings"] += len(caught)
    counts["nothing_to_act_on"] += not decisions
    return decisions


def _move(
    env: Env, scene: SceneState, decision: Decision, counts: collections.Counter[str]
) -> tuple[SceneState, bool, str | None]:
    """Moves the robot; returns the scene, True if it has changed, and the outcome of a motion."""
    is_grasp = decision.primitive == "grasp"
    step = jax.device_get(act(env, scene, set_points(env.cfg.sim, decision), jnp.bool(is_grasp)))
    counts["grasps" if is_grasp else "pushes"] += 1
    if not step.reachable:
        counts["out_of_reach"] += 1
        return scene, False, None
    reported = OUTCOMES[int(step.outcome)] if is_grasp else PUSHED
    if is_grasp:
        counts[reported] += 1
    counts["blocks_taken"] += int(step.lifted.sum())
    counts["blocks_lost"] += int(step.blocks_lost)
    return step.scene, bool(step.moved), reported
