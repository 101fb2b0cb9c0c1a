"""The state of the blocks of one scene; blocks out of play are parked."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from csac_jax import geometry
from csac_jax.config import SimConfig, SlotKind, TaskKind
from csac_jax.grippers import Fingers, Grip, Gripper
from csac_jax.world import blocks

NOMINAL_DENSITY = 600.0  # kg/m^3, wood
NOMINAL_FRICTION = 0.8
# Fastest block after a substep, m/s and rad/s (ours). A thin block squeezed from under the hand
# spins faster, and the explicit gyroscopic torque would lead to NaN.
SPEED_LIMIT = np.array([5, 5, 5, 50, 50, 50], np.float32)
STILL = 0.008  # m/s, ours: slower counts as at rest
ANY = -1  # `Scene.target` in the clearing task


@struct.dataclass
class SceneState:
    """Blocks of one scene. N = block slots; slots out of play are parked out of view."""

    position: jax.Array  # [N, 3] float32 m, centre of the bounding box; of mass of an object
    quaternion: jax.Array  # [N, 4] float32 (w, x, y, z), body -> world
    velocity: jax.Array  # [N, 6] float32 linear m/s (world), angular rad/s (body)
    half_size: jax.Array  # [N, 3] float32 m, half of the bounding box
    density: jax.Array  # [N] float32 kg/m^3
    friction: jax.Array  # [N] float32, sliding, against table and blocks; pads have their own
    colour: jax.Array  # [N] int32, row of blocks.COLOURS
    in_play: jax.Array  # [N] bool
    target: jax.Array  # [] int32, slot of the block to get; ANY if any block will do
    object_id: jax.Array | None = None  # [N] int32, number in the library; None without objects
    fingers: Fingers | None = None  # [] float32 m, the episode's; None: the gripper's own
    grip: Grip | None = None  # [] float32, the episode's; None: the gripper's own
    certified: jax.Array | None = None  # [] bool; None: all scenes of the pool are, or none is

    @property
    def numbers(self) -> jax.Array:
        """Returns `object_id` of a scene with objects. Raises ValueError for one without."""
        if self.object_id is None:
            raise ValueError("the scene has no objects of a library")
        return self.object_id


def parking(num_slots: int) -> np.ndarray:
    """Returns parking places [N, 3] m, in the air and far apart, so that nothing touches."""
    x = 3.0 + 0.3 * np.arange(num_slots)
    return np.stack([x, np.zeros(num_slots), np.ones(num_slots)], 1).astype(np.float32)


def parked(slots: tuple[SlotKind, ...]) -> SceneState:
    """Creates a scene of NumPy arrays: every slot parked, every block nominal."""
    num = len(slots)
    leaves: dict[str, Any] = {
        "position": parking(num),
        "quaternion": np.eye(1, 4, dtype=np.float32).repeat(num, axis=0),
        "velocity": np.zeros((num, 6), np.float32),
        "half_size": np.stack([blocks.half_size_choices(kind)[0] for kind in slots]),
        "density": np.full(num, NOMINAL_DENSITY, np.float32),
        "friction": np.full(num, NOMINAL_FRICTION, np.float32),
        "colour": np.arange(num, dtype=np.int32) % len(blocks.COLOURS),
        "in_play": np.zeros(num, bool),
        "target": np.int32(ANY),
        "object_id": np.zeros(num, np.int32) if "object" in slots else None,
    }
    return SceneState(**leaves)


def park(scene: SceneState, keep: jax.Array) -> SceneState:
    """Moves all blocks but those in `keep` [N] bool to their parking places."""
    keep = scene.in_play & keep
    column, upright = keep[:, None], jnp.array([1.0, 0.0, 0.0, 0.0], jnp.float32)[None]
    position = jnp.where(column, scene.position, parking(keep.shape[0]))
    quaternion = jnp.where(column, scene.quaternion, upright)
    velocity = jnp.where(column, scene.velocity, 0.0)
    return scene.replace(position=position, quaternion=quaternion, velocity=velocity, in_play=keep)


def rotate(scene: SceneState, yaw: jax.Array) -> SceneState:
    """Rotates the blocks in play about the workspace centre by `yaw` [] rad, all at rest."""
    multiply = jax.vmap(geometry.quat_multiply, (None, 0))
    rotated = scene.replace(
        position=scene.position.at[:, :2].set(geometry.rotate2d(yaw, scene.position[:, :2])),
        quaternion=multiply(geometry.quat_from_yaw(yaw), scene.quaternion),
    )
    return park(rotated, scene.in_play)


def with_fingers(key: jax.Array, scene: SceneState, gripper: Gripper) -> SceneState:
    """Samples the fingers of an episode, if the gripper has ranges of them."""
    if gripper.varies is None:
        return scene
    low, high = (np.array(ends, np.float32) for ends in gripper.varies)
    return scene.replace(fingers=Fingers(*jax.random.uniform(key, (3,), minval=low, maxval=high)))


def with_grip(key: jax.Array, scene: SceneState, cfg: SimConfig) -> SceneState:
    """Samples friction and force of an episode's grip, if the config has ranges of them."""
    if not cfg.grip_varies:
        return scene
    low, high = np.array([cfg.pad_friction, cfg.grip_force], np.float32).T
    return scene.replace(grip=Grip(*jax.random.uniform(key, (2,), minval=low, maxval=high)))


def fingers(scene: SceneState, gripper: Gripper) -> Fingers:
    """Returns the fingers of the episode, or the gripper's own."""
    return gripper.fingers if scene.fingers is None else scene.fingers


def mark_target(key: jax.Array, scene: SceneState) -> SceneState:
    """Marks a random block in play as the target; ANY if none is in play."""
    slot = jax.random.categorical(key, jnp.where(scene.in_play, 0.0, -jnp.inf)).astype(jnp.int32)
    return scene.replace(target=jnp.where(jnp.any(scene.in_play), slot, ANY))


def with_target(
    key: jax.Array, scene: SceneState, kind: TaskKind, certified: jax.Array | bool
) -> SceneState:
    """Marks what an episode of a task asks for; except in `clear`, a scene keeps its own target.

    In the task `both`, a `certified` scene without a target gets none, another with half a chance.
    """
    if kind == "clear":
        return scene.replace(target=jnp.full_like(scene.target, ANY))
    drawn = mark_target(key, scene).target
    if kind == "both":
        one = jax.random.bernoulli(jax.random.fold_in(key, 1)) & ~jnp.asarray(certified)
        drawn = jnp.where(one, drawn, ANY)
    return scene.replace(target=jnp.where(scene.target == ANY, drawn, scene.target))


def is_target(scene: SceneState) -> jax.Array:
    """Returns [N] bool, slots of the blocks that the task asks for."""
    return (scene.target == ANY) | (np.arange(len(scene.in_play)) == scene.target)


def inside(position: jax.Array, extent: float) -> jax.Array:
    """Tests which centres [N, 3] m lie above the workspace square, [N] bool."""
    return jnp.all(jnp.abs(position[:, :2]) <= 0.5 * extent, axis=1)


def rotate_at_random(key: jax.Array, scene: SceneState, extent: float, any_yaw: bool) -> SceneState:
    """Rotates a scene by a random yaw.

    Without `any_yaw`, or where a block would leave the square of `extent` m, by quarter turns.
    """
    yaw = jax.random.uniform(key, (), maxval=2.0 * np.pi)
    near = jnp.linalg.norm(scene.position[:, :2], axis=1) <= 0.5 * extent
    free = any_yaw & jnp.all(near | ~scene.in_play)
    quarters = jnp.round(yaw / (0.5 * np.pi)) * (0.5 * np.pi)
    return rotate(scene, jnp.where(free, yaw, quarters))
