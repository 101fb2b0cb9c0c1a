"""The environment: a Markov decision process over one scene.

    env = make_env(presets.quick())
    state = env.reset(jax.random.key(0))
    state = env.step(state, Action.grasp(x=0.02, y=-0.05, yaw=0.3))

`reset` and `step` are pure and take one scene: vmap, jit or scan them. An episode terminates when
no wanted block is left: any block in the task `clear`, one in the task `target`, and either in the
task `both`. It is truncated at a cap of the config's section `task`, or when physics diverges.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax import grippers
from csac_jax.config import Config
from csac_jax.constants import CHANGE_AREA, Outcome, Primitive
from csac_jax.grippers import Grip, Gripper
from csac_jax.robot.primitives import Action
from csac_jax.runtime import short
from csac_jax.scenes import pool
from csac_jax.sim import backend, outcome, physics as simulation
from csac_jax.sim.physics import Motion, Physics, Started
from csac_jax.vision import heightmap, observe, sensor
from csac_jax.vision.heightmap import VIEW_HEIGHT, Observation
from csac_jax.world import model, scene_state
from csac_jax.world.scene_state import SceneState


@dataclasses.dataclass(frozen=True, eq=False)
class ArraySpec:
    """Shape, dtype and inclusive bounds of an array."""

    shape: tuple[int, ...]
    dtype: Any  # NumPy's
    minimum: float | np.ndarray  # of all entries, or [*shape] of each
    maximum: float | np.ndarray

    def contains(self, values: jax.Array) -> jax.Array:
        """Returns [] bool, all values [*shape] lie within the bounds; NaN does not."""
        return jnp.all((values >= self.minimum) & (values <= self.maximum))


MAX_FAILURES = 2  # failed grasps in a row that end an episode of certified scenes
_FINGERS, _GRIP = np.uint32(2**30), np.uint32(2**30 + 1)  # distinct from other children of a key
_Spec: Any = ArraySpec  # stands where a pytree has an array


@struct.dataclass
class Info:
    """Effects of the last action. A lifted block that is not the target counts as TOUCHED, and so
    does a grasp that is blocked."""

    outcome: jax.Array  # [] int32, Outcome of a grasp by ground truth; NOTHING after a push
    outcome_by_gap: jax.Array  # [] int32, the same, from finger gap and height map
    moved: jax.Array  # [] cm^2 of the height map that moved
    distance: jax.Array  # [] m, from the pose to the nearest lifted block; 0 without one
    cleared: jax.Array  # [] int32, blocks lifted off the table
    blocks_lost: jax.Array  # [] int32, blocks that left the workspace
    contact_overflow: jax.Array  # [] int32, substeps in which contacts may have been dropped
    physics_diverged: jax.Array  # [] bool, physics failed: the transition is void
    blocked: jax.Array  # [] bool, a guarded descent was stopped: the scene is as before


@struct.dataclass
class State:
    """One scene between two actions."""

    scene: SceneState
    obs: Observation
    reward: jax.Array  # [] float32, 1 if the action lifted a wanted block (r2, CSAC eq. 11)
    terminated: jax.Array  # [] bool, no wanted block is left
    truncated: jax.Array  # [] bool, a cap was reached or physics diverged
    actions: jax.Array  # [] int32, actions in this episode
    steps_without_change: jax.Array  # [] int32, actions in a row without visible change
    failed_grasps: jax.Array  # [] int32, grasps in a row, pushes aside, that lifted nothing
    info: Info
    noise_key: jax.Array | None = None  # [] root of the episode's sensor noise; None without noise

    __repr__ = short.text

    @property
    def done(self) -> jax.Array:
        """Returns [] bool, the episode is over."""
        return self.terminated | self.truncated


@dataclasses.dataclass(frozen=True, eq=False)
class Env:
    """Physics and a pool of scenes; static, so compiled functions close over it."""

    cfg: Config
    physics: Physics
    scenes: SceneState  # NumPy leaves [P, N, ...], at rest
    any_yaw: bool = True  # False: `reset` rotates scenes by quarter turns only
    max_failures: int = 0  # failed grasps in a row that end an episode, see `gives_up`; 0: any

    __repr__ = short.text

    @property
    def gripper(self) -> Gripper:
        """Returns the gripper of the config."""
        return grippers.load(self.cfg.sim.gripper)

    @property
    def observation_spec(self) -> Observation:
        """Returns the ArraySpec of each leaf of an observation."""
        rows = (self.cfg.heightmap.size, self.cfg.heightmap.size)
        return Observation(
            colour=_Spec((*rows, 3), np.float32, 0.0, 1.0),
            height=_Spec(rows, np.float32, 0.0, VIEW_HEIGHT),
            target=_Spec(rows, np.bool_, False, True),
            fingers=_Spec((3,), np.float32, 0.0, 1.0) if self.cfg.net.gripper else None,
        )

    @property
    def action_spec(self) -> Action:
        """Returns the ArraySpec of each leaf of an action; the pose is x m, y m, yaw rad."""
        half = 0.5 * self.cfg.heightmap.extent
        low, high = np.array([[-half, -half, 0.0], [half, half, 2.0 * np.pi]], np.float32)
        return Action(
            primitive=_Spec((), np.int32, int(min(Primitive)), int(max(Primitive))),
            pose=_Spec((3,), np.float32, low, high),
        )

    def reset(self, key: jax.Array) -> State:
        """Starts an episode in a random scene of the pool, rotated by a random yaw."""
        return self.reset_to(self._sample_scene(key), key)

    def reset_to(self, scene: SceneState, key: jax.Array | None = None) -> State:
        """Starts an episode in this scene. Raises ValueError if sensor noise lacks its key."""
        no, zero = jnp.zeros((), bool), jnp.zeros((), jnp.float32)
        count = jnp.zeros((), jnp.int32)
        info = Info(count, count, zero, zero, count, count, count, no, no)
        gripper = self.gripper
        if gripper.varies is not None and scene.fingers is None:
            scene = scene.replace(fingers=jax.tree.map(jnp.float32, gripper.fingers))
        if self.cfg.sim.grip_varies and scene.grip is None:
            scene = scene.replace(grip=Grip(zero, zero))
        if self.cfg.scene.mixes_certified and scene.certified is None:
            scene = scene.replace(certified=no)
        noise_key = sensor.episode_key(key, self.cfg.sensor)
        obs = self._observe(scene, noise_key, count)
        return State(scene, obs, zero, no, no, count, count, count, info, noise_key)

    def auto_reset(self, key: jax.Array, state: State) -> State:
        """Starts the episode after `state` in a fresh scene, or in the same scene with a new target
        after the old one was lifted; a certified scene is none any more."""
        key_scene, key_target = jax.random.split(key)
        scene = self._sample_scene(key_scene)
        if self.cfg.task.has_target:
            one_lifted = (state.reward > 0.0) & (state.scene.target != scene_state.ANY)
            same_scene = one_lifted & jnp.any(state.scene.in_play) & ~self._certified(state.scene)
            scene = select(same_scene, scene_state.mark_target(key_target, state.scene), scene)
        return self.reset_to(scene, key)

    def step(self, state: State, action: Action) -> State:
        """Returns the state after one action, without the blocks that were lifted or pushed out.

        Nothing moves for an action that the robot cannot follow, or whose pose is not finite, or
        where physics diverges. A scene that was invalid before becomes empty.
        """
        before, valid = self._validate(state)
        height = state.obs.height
        motion = simulation.act(self.physics, self.cfg, before, height, action, valid)
        return self._judge(state, action, motion)

    def start(self, state: State, action: Action) -> Started:
        """Starts an action, which Warp runs in the background until `finish`."""
        before, valid = self._validate(state)
        given = before, state.obs.height, action, valid
        return simulation.start(self.physics, self.cfg, *given, background=True)

    def finish(self, state: State, started: Started, after: jax.Array) -> State:
        """Returns the state after an action that was started, as `step`. Physics may run until
        `after` [] was computed."""
        motion = simulation.finish(self.physics, self.cfg, started, after)
        return self._judge(state, started.action, motion)

    def _validate(self, state: State) -> tuple[SceneState, jax.Array]:
        """Returns the scene, empty if it or the observation is out of bounds, and [] bool."""
        spec = self.observation_spec
        valid = simulation.healthy(state.scene) & spec.height.contains(state.obs.height)
        valid &= spec.colour.contains(state.obs.colour)
        blank = scene_state.parked(self.cfg.scene.slots)
        kept = {name: getattr(state.scene, name) for name in ("fingers", "grip", "certified")}
        blank = blank.replace(**kept)
        return select(valid, state.scene, blank), valid

    def _judge(self, state: State, action: Action, motion: Motion) -> State:
        """Observes the scene that is left; counts actions, rewards and ends the episode."""
        scene, actions = motion.after, state.actions + 1
        obs = self._observe(scene, state.noise_key, actions)
        moved = heightmap.moved_area(self.cfg.heightmap, state.obs.height, obs.height)
        unchanged_steps = jnp.where(moved > CHANGE_AREA, 0, state.steps_without_change + 1)
        terminated = ~jnp.any(scene.in_play & scene_state.is_target(scene))
        failed = jnp.where(jnp.any(motion.lifted), 0, state.failed_grasps + 1)
        failed_grasps = jnp.where(motion.is_grasp, failed, state.failed_grasps)
        task = self.cfg.task
        capped = (actions >= task.max_actions) | (unchanged_steps >= task.max_steps_without_change)
        if self.max_failures:
            capped |= self.gives_up(scene, failed_grasps)
        success = jnp.any(motion.lifted & scene_state.is_target(motion.before))
        return State(
            scene=scene,
            obs=obs,
            reward=success.astype(jnp.float32),
            terminated=terminated & ~motion.diverged,
            truncated=(capped & ~terminated) | motion.diverged,
            actions=actions,
            steps_without_change=unchanged_steps,
            failed_grasps=failed_grasps,
            info=_info(action, motion, success, moved),
            noise_key=state.noise_key,
        )

    def gives_up(self, scene: SceneState, failed_grasps: jax.Array) -> jax.Array:
        """Tests which episodes [...] end for failed grasps in a row [...]; in a pool of certified
        and other scenes, those in certified ones."""
        over = (failed_grasps >= self.max_failures) & (self.max_failures > 0)
        return over if scene.certified is None else over & scene.certified

    def randomise_pose(self, key: jax.Array, scene: SceneState) -> SceneState:
        """Rotates a scene at random, in a tray by quarter turns; draws the target, and fingers and
        grip where they vary."""
        extent, any_yaw = self.cfg.heightmap.extent, self.any_yaw and not self.cfg.scene.tray
        key_yaw, key_target = jax.random.split(key)
        turned = scene_state.rotate_at_random(key_yaw, scene, extent, any_yaw)
        kind, certified = self.cfg.task.kind, self._certified(scene)
        placed = scene_state.with_target(key_target, turned, kind, certified)
        placed = scene_state.with_grip(jax.random.fold_in(key, _GRIP), placed, self.cfg.sim)
        return scene_state.with_fingers(jax.random.fold_in(key, _FINGERS), placed, self.gripper)

    def _certified(self, scene: SceneState) -> jax.Array:
        """Returns [] bool, the scene is a certified one of the pool."""
        if scene.certified is None:
            return jnp.asarray(bool(self.cfg.scene.certified))
        return jnp.asarray(scene.certified)

    def _sample_scene(self, key: jax.Array) -> SceneState:
        key_index, key_pose = jax.random.split(key)
        index = jax.random.randint(key_index, (), 0, self.scenes.position.shape[0])
        scene = jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], self.scenes)
        return self.randomise_pose(key_pose, scene)

    def _observe(
        self, scene: SceneState, root: jax.Array | None, actions: jax.Array
    ) -> Observation:
        key = None if root is None else jax.random.fold_in(root, actions)
        obs = observe.observe(self.cfg, scene, key)
        if root is not None:
            obs = obs.replace(colour=sensor.grey(root, self.cfg.sensor, obs.colour))
        if not self.cfg.net.gripper:
            return obs
        return obs.replace(fingers=jnp.stack(scene_state.fingers(scene, self.gripper)))


@dataclasses.dataclass(frozen=True, eq=False)
class AutoResetEnv:
    """An environment whose `step` replaces a finished scene by a fresh one."""

    env: Env

    __repr__ = short.text

    def reset(self, key: jax.Array) -> State:
        """Starts an episode, see `Env.reset`."""
        return self.env.reset(key)

    def step(self, key: jax.Array, state: State, action: Action) -> tuple[State, State]:
        """Returns the state to act in next, and the state after the action: carry, output of scan.

        Where an episode is done, the first begins the next one and the second has its last
        observation.
        """
        after = self.env.step(state, action)
        return select(after.done, self.env.auto_reset(key, after), after), after


def make_env(cfg: Config, stream: int = pool.TRAIN_STREAM, num_scenes: int | None = None) -> Env:
    """Makes the environment of a config; physics `auto` is resolved for this machine.

    The pool of `num_scenes` scenes, None for the config's `scene.pool`, is drawn from a `stream` of
    random numbers, settled once and cached on disk. Raises SceneError for blocks that do not come
    to rest, and for physics that is not installed.
    """
    cfg = backend.resolve(cfg)
    physics = simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    max_failures = MAX_FAILURES if cfg.scene.certified else 0
    return Env(cfg, physics, pool.scenes(cfg, stream, num_scenes), max_failures=max_failures)


def _info(action: Action, motion: Motion, success: jax.Array, moved: jax.Array) -> Info:
    """Judges one action that `moved` [] cm^2; a `success` [] bool lifted a wanted block."""
    lifted = motion.lifted
    distance = jnp.linalg.norm(motion.before.position[:, :2] - action.pose[:2], axis=1)
    wrong = jnp.any(lifted) & ~success
    best = jnp.where(wrong, jnp.int32(Outcome.TOUCHED), jnp.int32(Outcome.LIFTED))
    best = jnp.where(motion.blocked, jnp.int32(Outcome.TOUCHED), best)
    best = jnp.where(motion.is_grasp, best, jnp.int32(Outcome.NOTHING))
    least = jnp.where(motion.blocked, best, jnp.int32(Outcome.NOTHING))
    by_truth = outcome.grasp_outcome(motion.trace, motion.surface, motion.hand_rise)
    by_gap = outcome.grasp_outcome_by_gap(motion.trace, motion.surface, moved > CHANGE_AREA)
    return Info(
        outcome=jnp.clip(by_truth, least, best),
        outcome_by_gap=jnp.clip(by_gap, least, best),
        moved=moved,
        distance=jnp.where(jnp.any(lifted), jnp.min(jnp.where(lifted, distance, jnp.inf)), 0.0),
        cleared=jnp.sum(lifted, dtype=jnp.int32),
        blocks_lost=jnp.sum(motion.lost, dtype=jnp.int32),
        contact_overflow=motion.trace.contact_overflow,
        physics_diverged=motion.diverged,
        blocked=motion.blocked,
    )


def select(condition: jax.Array, yes: Any, no: Any) -> Any:
    """Returns the tree `yes` where the condition [] holds, else `no`."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
