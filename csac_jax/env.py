"""The environment: a Markov decision process over one scene.

    env = make_env(presets.quick())
    state = env.reset(jax.random.key(0))
    state = env.step(state, Action.grasp(x=0.02, y=-0.05, yaw=0.3))

`reset` and `step` are pure and take one scene: vmap, jit or scan them. An episode terminates when
no block to get is left: any block in the task `clear`, one in the task `target`. It is truncated at
a cap of the config's section `task`, or when physics diverges.
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
from csac_jax.grippers import Gripper
from csac_jax.scene import layout, model, pool
from csac_jax.scene.layout import Scene
from csac_jax.sim import backend, outcome, physics as simulation
from csac_jax.sim.physics import Physics
from csac_jax.sim.primitives import Action
from csac_jax.vision import heightmap, observe, sensor
from csac_jax.vision.heightmap import VIEW_HEIGHT, Observation


@dataclasses.dataclass(frozen=True, eq=False)
class ArraySpec:
    """Shape, dtype and inclusive bounds of an array."""

    shape: tuple[int, ...]
    dtype: Any  # NumPy's
    minimum: float | np.ndarray  # of all entries, or [*shape] of each
    maximum: float | np.ndarray

    def contains(self, values: jax.Array) -> jax.Array:
        """[] bool, all values [*shape] lie within the bounds; NaN does not."""
        return jnp.all((values >= self.minimum) & (values <= self.maximum))


_FINGERS = np.uint32(2**30)  # distinct from what else is drawn from a scene's key
_Spec: Any = ArraySpec  # stands where a pytree has an array


@struct.dataclass
class Info:
    """What the last action did. A block lifted that is not the target counts as TOUCHED."""

    outcome: jax.Array  # [] int32, Outcome of a grasp by ground truth; NOTHING after a push
    outcome_by_gap: jax.Array  # [] int32, the same judged by finger gap and height map
    moved: jax.Array  # [] cm^2 of the height map that moved
    distance: jax.Array  # [] m, from the place aimed at to the nearest block lifted; 0 without one
    cleared: jax.Array  # [] int32, blocks lifted off the table
    blocks_lost: jax.Array  # [] int32, blocks that left the workspace
    contact_overflow: jax.Array  # [] int32, substeps in which contacts may have been dropped
    physics_diverged: jax.Array  # [] bool, physics failed: the transition is void


@struct.dataclass
class State:
    """One scene between two actions."""

    scene: Scene
    obs: Observation
    reward: jax.Array  # [] float32, 1 if the last action lifted a block to get (r2, CSAC eq. 11)
    terminated: jax.Array  # [] bool, no block to get is left
    truncated: jax.Array  # [] bool, a cap was reached or physics diverged
    actions: jax.Array  # [] int32, actions in this episode
    steps_without_change: jax.Array  # [] int32, actions in a row without visible change
    failed_grasps: jax.Array  # [] int32, grasps in a row, pushes aside, that lifted nothing
    info: Info
    noise_key: jax.Array | None = None  # [] root of the episode's sensor noise; None without noise

    @property
    def done(self) -> jax.Array:
        """[] bool, the episode is over."""
        return self.terminated | self.truncated


@dataclasses.dataclass(frozen=True, eq=False)
class Env:
    """Physics and a pool of scenes; static, so compiled functions close over it."""

    cfg: Config
    physics: Physics
    scenes: Scene  # NumPy leaves [P, N, ...], at rest
    any_yaw: bool = True  # False: `reset` rotates scenes by quarter turns only
    max_failures: int = 0  # failed grasps in a row that truncate an episode; 0: no limit

    @property
    def gripper(self) -> Gripper:
        """The config's."""
        return grippers.load(self.cfg.sim.gripper)

    @property
    def observation_spec(self) -> Observation:
        """The ArraySpec of each leaf of an observation."""
        rows = (self.cfg.heightmap.size, self.cfg.heightmap.size)
        return Observation(
            colour=_Spec((*rows, 3), np.float32, 0.0, 1.0),
            height=_Spec(rows, np.float32, 0.0, VIEW_HEIGHT),
            target=_Spec(rows, np.bool_, False, True),
            fingers=_Spec((3,), np.float32, 0.0, 1.0) if self.cfg.net.gripper else None,
        )

    @property
    def action_spec(self) -> Action:
        """The ArraySpec of each leaf of an action: x and y in the workspace, m, and yaw, rad."""
        half = 0.5 * self.cfg.heightmap.extent
        low, high = np.array([[-half, -half, 0.0], [half, half, 2.0 * np.pi]], np.float32)
        return Action(
            primitive=_Spec((), np.int32, int(min(Primitive)), int(max(Primitive))),
            pose=_Spec((3,), np.float32, low, high),
        )

    def reset(self, key: jax.Array) -> State:
        """The first state of an episode: a random scene of the pool, rotated by a random yaw."""
        return self.reset_to(self._sample_scene(key), key)

    def reset_to(self, scene: Scene, key: jax.Array | None = None) -> State:
        """The first state of an episode that starts with this scene.

        Only sensor noise needs the key. Raises ValueError where it is missing.
        """
        no, none = jnp.zeros((), bool), jnp.zeros((), jnp.int32)
        zero = jnp.zeros((), jnp.float32)
        info = Info(none, none, zero, zero, none, none, none, no)
        gripper = self.gripper
        if gripper.varies is not None and scene.fingers is None:
            own = jax.tree.map(jnp.float32, gripper.fingers)
            scene = scene.replace(fingers=own)
        noise_key = sensor.episode_key(key, self.cfg.sensor)
        obs = self._observe(scene, noise_key, none)
        return State(scene, obs, zero, no, no, none, none, none, info, noise_key)

    def auto_reset(self, key: jax.Array, state: State) -> State:
        """The first state after the episode that ended in `state`.

        A fresh scene; but in the task `target`, after a success, the same scene with a new target.
        """
        key_scene, key_target = jax.random.split(key)
        scene = self._sample_scene(key_scene)
        if self.cfg.task.kind == "target":
            goes_on = (state.reward > 0.0) & jnp.any(state.scene.in_play)
            scene = _select(goes_on, layout.mark_target(key_target, state.scene), scene)
        return self.reset_to(scene, key)

    def step(self, state: State, action: Action) -> State:
        """The state after one action; blocks lifted or pushed out of the workspace are removed.

        Nothing moves for an action that the robot cannot follow. Where physics diverges, as it does
        at a pose that is no number, the scene stays as it was; a scene that was invalid before
        becomes empty. `state.done` is not read.
        """
        cfg, task, spec = self.cfg, self.cfg.task, self.observation_spec
        valid = simulation.healthy(state.scene) & spec.height.contains(state.obs.height)
        valid &= spec.colour.contains(state.obs.colour)
        blank = layout.parked(cfg.scene.slots).replace(fingers=state.scene.fingers)
        before = _select(valid, state.scene, blank)
        after, trace, plan = simulation.execute(self.physics, cfg, before, state.obs.height, action)
        sound = jnp.all(jnp.isfinite(action.pose))  # C MuJoCo would go on
        diverged = ~(valid & sound & simulation.healthy(after))
        after = _select(diverged, before, after)

        # Remove the blocks that were lifted or lost.
        is_grasp = action.primitive == Primitive.GRASP
        hand_rise = plan.start[2] - jnp.min(plan.control[:, 2])
        lifted = outcome.lifted_blocks(trace, hand_rise) & is_grasp & ~diverged
        lost = after.in_play & ~layout.inside(after.position, cfg.heightmap.extent) & ~lifted
        success = lifted & layout.is_target(before)
        after = layout.park(after, ~lifted & ~lost)
        actions = state.actions + 1
        obs = self._observe(after, state.noise_key, actions)

        # Judge the action and the episode.
        moved = heightmap.moved_area(cfg.heightmap, state.obs.height, obs.height)
        changed = moved > CHANGE_AREA
        unchanged_steps = jnp.where(changed, 0, state.steps_without_change + 1)
        terminated = ~jnp.any(after.in_play & layout.is_target(after))
        failed = jnp.where(jnp.any(lifted), 0, state.failed_grasps + 1)
        failed_grasps = jnp.where(is_grasp, failed, state.failed_grasps)
        capped = (actions >= task.max_actions) | (unchanged_steps >= task.max_steps_without_change)
        if self.max_failures:
            capped |= failed_grasps >= self.max_failures
        distance = jnp.linalg.norm(before.position[:, :2] - action.pose[:2], axis=1)
        wrong = jnp.any(lifted) & ~jnp.any(success)
        best = jnp.where(wrong, jnp.int32(Outcome.TOUCHED), jnp.int32(Outcome.LIFTED))
        best = jnp.where(is_grasp, best, jnp.int32(Outcome.NOTHING))
        by_truth = outcome.grasp_outcome(trace, plan.surface, hand_rise)
        by_gap = outcome.grasp_outcome_by_gap(trace, plan.surface, changed)
        info = Info(
            outcome=jnp.minimum(by_truth, best),
            outcome_by_gap=jnp.minimum(by_gap, best),
            moved=moved,
            distance=jnp.where(jnp.any(lifted), jnp.min(jnp.where(lifted, distance, jnp.inf)), 0.0),
            cleared=jnp.sum(lifted, dtype=jnp.int32),
            blocks_lost=jnp.sum(lost, dtype=jnp.int32),
            contact_overflow=trace.contact_overflow,
            physics_diverged=diverged,
        )
        return State(
            scene=after,
            obs=obs,
            reward=jnp.any(success).astype(jnp.float32),
            terminated=terminated & ~diverged,
            truncated=(capped & ~terminated) | diverged,
            actions=actions,
            steps_without_change=unchanged_steps,
            failed_grasps=failed_grasps,
            info=info,
            noise_key=state.noise_key,
        )

    def randomise_pose(self, key: jax.Array, scene: Scene) -> Scene:
        """The scene as episodes start with it: at a random yaw, with a target or none, and with
        fingers of the gripper's ranges where it has some."""
        extent, has_target = self.cfg.heightmap.extent, self.cfg.task.kind == "target"
        placed = layout.randomise_pose(key, scene, extent, self.any_yaw, has_target)
        return layout.with_fingers(jax.random.fold_in(key, _FINGERS), placed, self.gripper)

    def _sample_scene(self, key: jax.Array) -> Scene:
        key_index, key_pose = jax.random.split(key)
        index = jax.random.randint(key_index, (), 0, self.scenes.position.shape[0])
        scene = jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], self.scenes)
        return self.randomise_pose(key_pose, scene)

    def _observe(self, scene: Scene, root: jax.Array | None, actions: jax.Array) -> Observation:
        key = None if root is None else jax.random.fold_in(root, actions)
        obs = observe.observe(self.cfg, scene, key)
        if not self.cfg.net.gripper:
            return obs
        return obs.replace(fingers=jnp.stack(layout.fingers(scene, self.gripper)))


@dataclasses.dataclass(frozen=True, eq=False)
class AutoResetEnv:
    """An environment whose `step` replaces a finished scene by a fresh one."""

    env: Env

    def reset(self, key: jax.Array) -> State:
        """As `Env.reset`."""
        return self.env.reset(key)

    def step(self, key: jax.Array, state: State, action: Action) -> tuple[State, State]:
        """The state to act in next, and the state that the action led to; carry and output of scan.

        The second has reward, done, info and, where done, the terminal observation. The first is
        the second, or where done `Env.auto_reset` of it: the next episode's first observation.
        """
        after = self.env.step(state, action)
        return _select(after.done, self.env.auto_reset(key, after), after), after


def make_env(cfg: Config, stream: int = pool.TRAIN_STREAM, num_scenes: int | None = None) -> Env:
    """The environment of a config; physics `auto` is resolved for this machine.

    Settles its pool of scenes once and caches it on disk. Evaluation draws from another `stream` of
    random numbers, and needs a pool of `num_scenes` or more; None is the config's `scene.pool`.
    Raises SceneError for blocks that do not come to rest, and for physics that is not installed.
    """
    cfg = backend.resolve(cfg)
    physics = simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    return Env(cfg, physics, pool.scenes(cfg, stream, num_scenes))


def _select(condition: jax.Array, yes: Any, no: Any) -> Any:
    """Leaf by leaf, `yes` where the condition [] holds, else `no`."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
