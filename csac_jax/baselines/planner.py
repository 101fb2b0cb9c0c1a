"""A planner that knows the scene and simulates: physics chooses among random actions.

Of many grasps it takes the best that lifts a wanted block. If none does, it looks two deep: it
takes the push after which the most grasps lift one.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from csac_jax.baselines import trials
from csac_jax.baselines.trials import Trials
from csac_jax.config import Config
from csac_jax.geometry import FULL_TURN, quat_to_matrix, wrap_angle
from csac_jax.robot.primitives import Action
from csac_jax.sim import physics as simulation
from csac_jax.sim.physics import Physics
from csac_jax.world import model, scene_state
from csac_jax.world.scene_state import SceneState

NEAR = 0.12  # m from the target's centre, within which blocks are pushed (ours)


@struct.dataclass
class Budget:
    """Numbers of simulated actions of a decision, measured (ours). No pushes: one deep."""

    grasps: int = struct.field(pytree_node=False, default=48)
    pushes: int = struct.field(pytree_node=False, default=16)
    grasps_after: int = struct.field(pytree_node=False, default=12)  # each push


@functools.lru_cache(maxsize=4)
def make_physics(cfg: Config) -> Physics:
    """Makes the engine that a planner simulates in, once for a config."""
    return simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)


def plan(
    key: Array,
    cfg: Config,
    physics: Physics,
    scene: SceneState,
    height: Array,
    budget: Budget,
    proposed: tuple[Action, Action] | None = None,
) -> Action:
    """Plans an action over the map `height` [H, W] m that the robot sees.

    The best grasp lifts the most wanted blocks and loses none, then grips firmest. If none lifts
    one, the best push loses none and is followed by the most random grasps that lift. Of equal ones
    it moves least, but most if no grasp would lift. Grasps and pushes, leaves [K, ...] and
    [M, ...], are random unless `proposed`.
    """
    key_grasps, key_pushes, key_after = jax.random.split(key, 3)
    grasps, pushes = proposed or (
        sample_grasps(key_grasps, scene, budget.grasps),
        sample_pushes(key_pushes, cfg, scene, budget.pushes),
    )
    tried = trials.simulate(cfg, physics, scene, height, grasps)
    grasp = jax.tree.map(lambda leaf: leaf[jnp.argmax(_grasp_scores(tried))], grasps)
    if not pushes.primitive.size:
        return grasp

    def push() -> Action:
        pushed = trials.simulate(cfg, physics, scene, height, pushes)
        counts = lifting_after(key_after, cfg, physics, pushed, budget.grasps_after)
        best = jnp.argmax(_push_scores(pushed, counts))
        return jax.tree.map(lambda leaf: leaf[best], pushes)

    return jax.lax.cond(jnp.any(tried.wanted), lambda: grasp, push)


def sample_grasps(key: Array, scene: SceneState, num: int) -> Action:
    """Draws grasps, leaves [num, ...], at random points of wanted blocks. Half of them close along
    an axis of the block."""
    key_point, key_yaw, key_axis, key_aligned = jax.random.split(key, 4)
    slot, point = _points(key_point, scene, scene_state.is_target(scene), num)
    rotation = jax.vmap(quat_to_matrix)(scene.quaternion[slot])
    axis = jax.random.randint(key_axis, (num,), 0, 3)
    along = rotation[jnp.arange(num), :2, axis]  # [num, 2]
    yaw = jax.random.uniform(key_yaw, (num,), maxval=np.pi)
    aligned = jax.random.bernoulli(key_aligned, shape=(num,))
    yaw = jnp.where(aligned, jnp.arctan2(along[:, 1], along[:, 0]), yaw)
    return Action.grasp(point[:, 0], point[:, 1], wrap_angle(yaw))


def sample_pushes(key: Array, cfg: Config, scene: SceneState, num: int) -> Action:
    """Draws pushes, leaves [num, ...], whose paths meet blocks; with a target, those near it."""
    key_point, key_yaw, key_back = jax.random.split(key, 3)
    away = jnp.linalg.norm(scene.position[:, :2] - scene.position[scene.target, None, :2], axis=1)
    near = (scene.target == scene_state.ANY) | (away < NEAR)
    _, point = _points(key_point, scene, near, num)
    yaw = jax.random.uniform(key_yaw, (num,), maxval=FULL_TURN)
    back = jax.random.uniform(key_back, (num, 1), maxval=cfg.sim.push_length)
    limit = 0.5 * cfg.heightmap.extent
    start = point - back * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=1)
    start = jnp.clip(start, -limit, limit)
    return Action.push(start[:, 0], start[:, 1], yaw)


def _points(key: Array, scene: SceneState, which: Array, num: int) -> tuple[Array, Array]:
    """Draws random blocks in play of `which` [N] bool: slots [num], points in them [num, 2] m."""
    key_slot, key_place = jax.random.split(key)
    logits = jnp.where(scene.in_play & which, 0.0, -jnp.inf)
    slot = jax.random.categorical(key_slot, logits, shape=(num,))
    half = scene.half_size[slot]
    place = half * jax.random.uniform(key_place, half.shape, minval=-1.0, maxval=1.0)
    rotation = jax.vmap(quat_to_matrix)(scene.quaternion[slot])
    turned = (rotation * place[:, None]).sum(-1)
    return slot, (scene.position[slot] + turned)[:, :2]


def lifting_after(
    key: Array, cfg: Config, physics: Physics, pushed: Trials, grasps_after: int
) -> Array:
    """Counts the random grasps after each push that lift a wanted block, [M] int32."""

    def count(number: Array, scene: SceneState) -> Array:
        grasps = sample_grasps(jax.random.fold_in(key, number), scene, grasps_after)
        height = trials.height_map(cfg, scene)
        tried = trials.simulate(cfg, physics, scene, height, grasps)
        return jnp.sum(jnp.any(tried.wanted, axis=1), dtype=jnp.int32)

    return jax.vmap(count)(jnp.arange(len(pushed.motion)), pushed.scene)


def _grasp_scores(tried: Trials) -> Array:
    wanted, lost = jnp.sum(tried.wanted, axis=1), jnp.sum(tried.lost, axis=1)
    share = jnp.max(jnp.where(tried.wanted, tried.share, 0.0), axis=1)  # at most 1
    return 100.0 * (wanted > 0) + 2.0 * (wanted - 2 * lost).astype(jnp.float32) + share


def _push_scores(pushed: Trials, counts: Array) -> Array:
    preference = jnp.where(jnp.any(counts > 0), -0.5, 0.5) * jnp.tanh(pushed.motion)
    return counts.astype(jnp.float32) + preference - 1e3 * jnp.any(pushed.lost, axis=1)
