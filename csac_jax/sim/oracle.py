"""A grasp planner that reads block poses: the ceiling that physics allows."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import Config, SlotKind
from csac_jax.constants import MAX_OPENING, Primitive
from csac_jax.geometry import cell_centres, quat_to_matrix, rotate2d
from csac_jax.scene import blocks, stock
from csac_jax.scene.layout import ANY, Scene
from csac_jax.sim.primitives import Action, local_top

YAWS = 32  # over half a turn: the hand is symmetric
PAD_HALF_WIDTH = 0.006  # m, across the pad: scenes/hand.xml
FINGER_HALF = (0.008, 0.012)  # m, half footprint of a finger tip across and along its pad: roomy
EXACT = jax.lax.Precision.HIGHEST  # a GPU would cut products of matrices to 10 bits
ALIGNED = 0.01  # 1 - cosine between a face and the pad that is as good as parallel


def grasp(cfg: Config, scene: Scene, height: jax.Array) -> Action:
    """The best grasp: room for both fingers, faces square to the pads, a high and narrow block.

    With a target, the best grasp is the target's, else that of the block nearest to it.

    Args: height [H, W] m.
    """
    scores, poses = _blocks(cfg, scene, height)
    if cfg.scene.has_objects:
        of_objects = _objects(cfg, scene, height)
        both = zip((scores, poses), of_objects, strict=True)
        scores, poses = (jnp.concatenate(pair) for pair in both)
    pose = poses[jnp.argmax(scores)]
    return Action(primitive=jnp.int32(Primitive.GRASP), pose=pose)


class Faces(NamedTuple):
    """What is held: a convex body. F = faces."""

    slot: jax.Array  # [] int32
    centre: jax.Array  # [2] m, where the hand goes down
    normal: jax.Array  # [F, 3] world frame, 0 where there is no face
    offset: jax.Array  # [F] m, from the origin of the body's frame


def _blocks(cfg: Config, scene: Scene, height: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Scores [n] and poses [n, 3] of grasps of the blocks."""
    slots = cfg.scene.slots
    hulls: tuple[SlotKind, ...] = tuple("box" if kind == "arch" else kind for kind in slots)
    normals, offsets = blocks.half_spaces(hulls, scene.half_size)
    slot = blocks.parts(hulls).slot
    rotation = jax.vmap(quat_to_matrix)(scene.quaternion)[slot]
    world_normals = jnp.einsum("nij,nfj->nfi", rotation, normals, precision=EXACT)
    faces = Faces(jnp.asarray(slot, jnp.int32), scene.position[slot, :2], world_normals, offsets)
    return _scores(cfg, scene, height, faces)


def _objects(cfg: Config, scene: Scene, height: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The same of every part of every object, at its middle."""
    known, slots = stock.table(cfg.scene), np.flatnonzero(blocks.is_object(cfg.scene.slots))
    count = known.present.shape[1]

    def of_slot(slot: jax.Array) -> tuple[jax.Array, jax.Array]:
        number = scene.numbers[slot]
        normal, offset, part, middle, present = (
            jnp.asarray(leaf)[number]
            for leaf in (known.normal, known.offset, known.part, known.middle, known.present)
        )
        rotation = quat_to_matrix(scene.quaternion[slot])
        normal = jnp.einsum("ij,cfj->cfi", rotation, normal, precision=EXACT).reshape(-1, 3)
        own = jnp.repeat(part, offset.shape[1])[None] == np.arange(count)[:, None]  # [P, faces]
        centre = scene.position[slot][None] + jnp.matmul(middle, rotation.T, precision=EXACT)
        faces = Faces(
            jnp.full(count, slot, jnp.int32),
            centre[:, :2],
            jnp.where(own[:, :, None], normal[None], 0.0),
            jnp.broadcast_to(offset.reshape(-1)[None], own.shape),
        )
        scores, poses = _scores(cfg, scene, height, faces)
        return jnp.where(jnp.repeat(present, YAWS), scores, -jnp.inf), poses

    # One after the other: the masks of all grasps of all parts would not fit the memory.
    scores, poses = jax.lax.map(of_slot, jnp.asarray(slots, jnp.int32))
    return scores.reshape(-1), poses.reshape(-1, 3)


def _scores(
    cfg: Config, scene: Scene, height: jax.Array, faces: Faces
) -> tuple[jax.Array, jax.Array]:
    """Scores [n] and poses [n, 3] of grasps of bodies, leaves of `faces` [bodies, ...], at YAWS."""
    sim, cells = cfg.sim, cell_centres(cfg.heightmap)
    yaws = jnp.asarray(np.arange(YAWS) * np.pi / YAWS, jnp.float32)

    def score(body: Faces, yaw: jax.Array) -> jax.Array:
        axis = jnp.append(rotate2d(yaw, jnp.array([1.0, 0.0])), 0.0)
        cosine = jnp.matmul(body.normal, axis, precision=EXACT)
        low, high = jnp.argmin(cosine), jnp.argmax(cosine)  # the faces most square to the pads
        width = body.offset[high] + body.offset[low]
        centre = body.centre
        top = local_top(cfg.heightmap, height, centre, sim.window)
        tip = jnp.maximum(top - sim.grasp_depth, sim.clearance)
        local = jnp.abs(rotate2d(-yaw, cells - centre))
        across = jnp.abs(local[..., 0] - 0.5 * MAX_OPENING - PAD_HALF_WIDTH) < FINGER_HALF[0]
        finger = across & (local[..., 1] < FINGER_HALF[1])
        blocked = jnp.max(jnp.where(finger, height, 0.0)) > tip - 0.002
        fits = width < MAX_OPENING - 0.02
        square = jnp.minimum(cosine[high], -cosine[low])
        askew = jnp.maximum(1.0 - square - ALIGNED, 0.0)
        cost = 4.0 * blocked + 4.0 * ~fits + 20.0 * askew + 10.0 * width
        # ANY indexes the last slot, whose distance is then unused.
        away = jnp.linalg.norm(centre - scene.position[scene.target, :2])
        asked = jnp.where(scene.target == body.slot, 3.0, -4.0 * away)
        wanted = jnp.where(scene.target == ANY, 5.0 * scene.position[body.slot, 2], asked)
        return jnp.where(scene.in_play[body.slot], wanted - cost, -jnp.inf)

    each_pair = jax.vmap(jax.vmap(score, (None, 0)), (0, None))
    scores = each_pair(faces, yaws)  # [bodies, YAWS]
    places = jnp.broadcast_to(faces.centre[:, None], (*scores.shape, 2))
    poses = jnp.concatenate([places, jnp.broadcast_to(yaws[None, :, None], (*scores.shape, 1))], 2)
    return scores.reshape(-1), poses.reshape(-1, 3)
