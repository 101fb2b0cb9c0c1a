"""The environment by itself: one scene, pure `reset` and `step`; the caller vmaps and jits.

env = make(Config())
state = env.reset(jax.random.key(0))
state = env.step(state, Action(primitive=jnp.int32(1), pose=jnp.array([0.0, 0.0, 0.5])))
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax import geometry
from csac_jax.config import Config, SceneConfig
from csac_jax.constants import CHANGE_AREA, Outcome, Primitive
from csac_jax.errors import SceneError
from csac_jax.scene import arrange, blocks, families, layout, model, pool
from csac_jax.scene.layout import Scene
from csac_jax.sim import outcome, physics as simulation
from csac_jax.sim.physics import Physics
from csac_jax.sim.primitives import Action
from csac_jax.vision import camera, heightmap
from csac_jax.vision.heightmap import Observation
from csac_jax.vision.raycast import Polytopes

_NOISE = np.uint32(2**31)  # folded into an episode's key: beside its children from `split`
LEAST_ARRANGED = 4  # blocks in an arrangement


@struct.dataclass
class Info:
    """What the last action did."""

    outcome: jax.Array  # [] int32, Outcome of a grasp by ground truth; NOTHING after a push; of a wrong block TOUCHED
    outcome_by_gap: (
        jax.Array
    )  # [] int32, as finger gap and height map suggest; a wrong block is seen to be one
    moved: jax.Array  # [] cm^2 of the height map that moved
    distance: (
        jax.Array
    )  # [] m, between the place aimed at and the nearest block lifted; 0 if none was
    cleared: jax.Array  # [] int32, blocks taken from the table
    blocks_lost: jax.Array  # [] int32, blocks that left the workspace
    contact_overflow: jax.Array  # [] int32, substeps in which contacts may have been dropped
    physics_diverged: jax.Array  # [] bool, physics failed: the transition is void


@struct.dataclass
class State:
    """One scene between two actions."""

    scene: Scene
    obs: Observation
    reward: (
        jax.Array
    )  # [] 1 if the last action took a block that was asked for, else 0 (r2 of CSAC eq. 11)
    terminated: jax.Array  # [] bool, nothing is left to get
    truncated: (
        jax.Array
    )  # [] bool, action cap or no-change cap reached, or the scene is physics_diverged
    actions: jax.Array  # [] int32, taken in this episode
    steps_without_change: jax.Array  # [] int32, actions in a row without visible change
    info: Info
    noise: jax.Array | None = (
        None  # [] typed key, root of the episode's sensor errors; None without any
    )

    @property
    def done(self) -> jax.Array:
        """[] bool, the episode is over."""
        return self.terminated | self.truncated


@dataclasses.dataclass(frozen=True, eq=False)
class Env:
    """Physics, eyes and the pool of settled scenes; closed over by whoever compiles."""

    cfg: Config
    physics: Physics
    scenes: Scene  # NumPy leaves [P, N, ...], at rest
    any_yaw: bool = True  # scenes are turned by any yaw that keeps them in the workspace; else only by quarter turns

    def reset(self, key: jax.Array) -> State:
        """A fresh settled scene of the pool, turned by a random yaw."""
        return self.begin(self._fresh(key), key)

    def restart(self, key: jax.Array, state: State) -> State:
        """What follows an episode: a fresh scene; or, after a target was got, the same one with the
        next target."""
        key_fresh, key_target = jax.random.split(key)
        scene = self._fresh(key_fresh)
        if self.cfg.task.kind == "target":
            goes_on = (state.reward > 0.0) & jnp.any(state.scene.in_play)
            again = layout.choose_target(key_target, state.scene)
            scene = jax.tree.map(lambda new, old: jnp.where(goes_on, old, new), scene, again)
        return self.begin(scene, key)

    def _fresh(self, key: jax.Array) -> Scene:
        key_scene, key_enter = jax.random.split(key)
        index = jax.random.randint(key_scene, (), 0, self.scenes.position.shape[0])
        return self.vary(
            key_enter, jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], self.scenes)
        )

    def vary(self, key: jax.Array, scene: Scene) -> Scene:
        """A scene as an episode meets it: turned at random; with a target, its own or any, if the
        task has one."""
        key_yaw, key_target = jax.random.split(key)
        yaw = jax.random.uniform(key_yaw, (), maxval=2.0 * np.pi)
        near = jnp.linalg.norm(scene.position[:, :2], axis=1) <= 0.5 * self.cfg.heightmap.extent
        anyhow = self.any_yaw & jnp.all(near | ~scene.in_play)
        turned = layout.rotate(
            scene, jnp.where(anyhow, yaw, jnp.round(yaw / (0.5 * np.pi)) * (0.5 * np.pi))
        )
        if self.cfg.task.kind != "target":
            return turned.replace(target=jnp.full_like(scene.target, layout.ANY))
        own = scene.target != layout.ANY
        return jax.tree.map(
            lambda a, b: jnp.where(own, a, b), turned, layout.choose_target(key_target, turned)
        )

    def begin(self, scene: Scene, key: jax.Array | None = None) -> State:
        """The first state of an episode that starts with this scene; the key is needed with a
        sensor model only."""
        no, none = jnp.zeros((), bool), jnp.zeros((), jnp.int32)
        zero = jnp.zeros((), jnp.float32)
        info = Info(none, none, zero, zero, none, none, none, no)
        noise = self._noise(key)
        return State(scene, self._see(scene, noise, none), zero, no, no, none, none, info, noise)

    def _noise(self, key: jax.Array | None) -> jax.Array | None:
        """The root of the sensor's errors in the episode that begins with this key."""
        if not self.cfg.sensor.active:
            return None
        if key is None:
            raise ValueError(
                "begin: with a sensor model (config section `sensor`) an episode needs a key"
            )
        return jax.random.fold_in(key, _NOISE)

    def _see(self, scene: Scene, noise: jax.Array | None, actions: jax.Array) -> Observation:
        """What the sensor makes of a scene after so many actions."""
        return self.look(scene, noise if noise is None else jax.random.fold_in(noise, actions))

    def look(self, scene: Scene, key: jax.Array | None = None) -> Observation:
        """The view of a scene: as it is, or with the errors of the config's sensor if a key is
        given."""
        cfg = self.cfg
        slots = cfg.scene.slots
        normals, offsets = blocks.half_spaces(slots, scene.half_size)
        slot = blocks.parts(slots).slot
        shapes = Polytopes(
            normal=normals,
            offset=offsets,
            position=scene.position[slot],
            rotation=jax.vmap(geometry.quat_to_matrix)(scene.quaternion)[slot],
            colour=jnp.asarray(blocks.COLOURS)[scene.colour[slot]],
        )
        wanted = (slot == scene.target) | (scene.target == layout.ANY)
        seen = (shapes, jnp.asarray(blocks.TABLE_COLOUR), wanted)
        if cfg.heightmap.view == "oblique":
            eye = camera.make(cfg.camera)
            if key is None:
                return heightmap.oblique(cfg.heightmap, *seen, eye)
            return heightmap.oblique_measured(key, cfg.heightmap, cfg.sensor, *seen, eye)
        true = heightmap.orthographic(cfg.heightmap, *seen)
        return true if key is None else heightmap.measured(key, cfg.sensor, true, wanted)

    def step(self, state: State, action: Action) -> State:
        """Runs one primitive; blocks lifted or out of the workspace leave the scene.

        Where physics failed, the scene is as it was before; where it was no scene to begin with,
        empty.
        """
        cfg = self.cfg
        sound = simulation.healthy(state.scene) & plausible(state.obs)
        empty = layout.parked(cfg.scene.slots)
        before = jax.tree.map(lambda given, none: jnp.where(sound, given, none), state.scene, empty)
        after, trace, plan = simulation.execute(
            self.physics, cfg.sim, cfg.heightmap, before, state.obs.height, action
        )
        physics_diverged = ~(sound & simulation.healthy(after))
        after = jax.tree.map(
            lambda good, bad: jnp.where(physics_diverged, good, bad), before, after
        )

        grasped = action.primitive == Primitive.GRASP
        hand_rise = plan.start[2] - jnp.min(plan.control[:, 2])
        lifted = outcome.lifted_blocks(trace, hand_rise) & grasped & ~physics_diverged
        gone = after.in_play & ~layout.inside(after.position, cfg.heightmap.extent) & ~lifted
        got = lifted & self._wanted(before)
        after = layout.park(after, ~lifted & ~gone)
        actions = state.actions + 1
        obs = self._see(after, state.noise, actions)

        moved = heightmap.moved_area(cfg.heightmap, state.obs.height, obs.height)
        changed = moved > CHANGE_AREA
        steps_without_change = jnp.where(changed, 0, state.steps_without_change + 1)
        terminated = ~jnp.any(after.in_play & self._wanted(after))
        capped = (actions >= cfg.task.max_actions) | (
            steps_without_change >= cfg.task.max_steps_without_change
        )
        off = jnp.linalg.norm(before.position[:, :2] - action.pose[:2], axis=1)
        nothing = jnp.int32(Outcome.NOTHING)
        judged = outcome.grasp_outcome(trace, plan.surface, hand_rise)
        by_gap = outcome.grasp_outcome_by_gap(trace, plan.surface, changed)
        wrong, touched = jnp.any(lifted) & ~jnp.any(got), jnp.int32(Outcome.TOUCHED)
        info = Info(
            outcome=jnp.where(grasped, jnp.where(wrong, touched, judged), nothing),
            outcome_by_gap=jnp.where(
                grasped, jnp.where(wrong, jnp.minimum(by_gap, touched), by_gap), nothing
            ),
            moved=moved,
            distance=jnp.where(jnp.any(lifted), jnp.min(jnp.where(lifted, off, jnp.inf)), 0.0),
            cleared=jnp.sum(lifted, dtype=jnp.int32),
            blocks_lost=jnp.sum(gone, dtype=jnp.int32),
            contact_overflow=trace.contact_overflow,
            physics_diverged=physics_diverged,
        )
        return State(
            scene=after,
            obs=obs,
            reward=jnp.any(got).astype(jnp.float32),
            terminated=terminated & ~physics_diverged,
            truncated=(capped & ~terminated) | physics_diverged,
            actions=actions,
            steps_without_change=steps_without_change,
            info=info,
            noise=state.noise,
        )

    def _wanted(self, scene: Scene) -> jax.Array:
        """Slots [N] bool of the blocks that the task asks for."""
        return (scene.target == layout.ANY) | (np.arange(len(self.cfg.scene.slots)) == scene.target)


def plausible(obs: Observation) -> jax.Array:
    """True where every entry of a top view is one that a view can have, [] bool; NaN is none."""
    height = (obs.height >= 0.0) & (obs.height <= heightmap.VIEW_HEIGHT)
    return jnp.all(height) & jnp.all((obs.colour >= 0.0) & (obs.colour <= 1.0))


def make(cfg: Config, stream: int = pool.TRAIN_STREAM, scenes: int | None = None) -> Env:
    """The environment of a config; settles (or reads from the cache) the scenes that resets draw
    from.

    Args: stream, the stream of random numbers that drops follow: training takes 0, evaluation
    others; scenes, size of the pool at least, as many with each number of blocks; `cfg.scene.pool`
    of each if None. Of these `cfg.scene.arranged` are arrangements, behind the others.
    """
    world = model.build(cfg.scene, cfg.sim)
    floating = model.build(cfg.scene, dataclasses.replace(cfg.sim, robot="hand"))
    numbers = 1 + len(cfg.scene.slots) - cfg.scene.min_blocks
    count = cfg.scene.pool if scenes is None else -(-scenes // numbers)
    packed, extent = round(cfg.scene.arranged * count), cfg.heightmap.extent
    parts = []
    if packed < count:
        dropped = dataclasses.replace(cfg.scene, arranged=0.0)
        parts.append(pool.settled(floating, dropped, extent, stream, count - packed))
    if packed:
        parts.append(arrangements(cfg.scene, extent, stream, packed * numbers))
    scenes_at_rest = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return Env(cfg, simulation.make(world, cfg.sim), scenes_at_rest)


def arrangements(cfg: SceneConfig, extent: float, stream: int, count: int) -> Scene:
    """`count` packed arrangements, NumPy leaves [P, N, ...], easy ones first; streams as in `make`.

    Each has at least LEAST_ARRANGED blocks or `cfg.min_blocks`, whichever is less, as far as there
    is room. Raises SceneError where the slots allow no arrangement.
    """
    try:
        families.available(cfg.slots)
    except ValueError as error:
        raise SceneError(f"scene.arranged: {error}") from None
    few = dataclasses.replace(cfg, min_blocks=min(cfg.min_blocks, LEAST_ARRANGED))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(stream), jnp.arange(count))
    draw = jax.vmap(lambda key, level: arrange.arrange(key, few, extent, level))
    return jax.device_get(jax.jit(draw)(keys, jnp.linspace(0.0, 1.0, count)))
