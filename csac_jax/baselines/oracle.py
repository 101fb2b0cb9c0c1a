"""A grasp planner that reads the true poses of blocks and objects: an upper bound."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from csac_jax import grippers
from csac_jax.config import Config, SlotKind
from csac_jax.constants import Primitive
from csac_jax.geometry import cell_centres, quat_to_matrix, rotate2d
from csac_jax.robot.fit import ROOM
from csac_jax.robot.primitives import Action, grasp_depth, local_top, lowest, reachable
from csac_jax.world import blocks, object_slots, scene_state
from csac_jax.world.scene_state import ANY, SceneState

YAWS = 32  # over half a turn: the hand is symmetric
SHIFTS = (-0.6, 0.0, 0.6)  # of the grasp, in shares of the way to the block's end
OTHER_WAY = 5  # ranks that a second try skips: neighbours are alike
OPENING_ROOM = 0.02  # m, by which the opening must exceed the target's width
EXACT = jax.lax.Precision.HIGHEST  # a GPU would cut products of matrices to 10 bits
OWN = 0.003  # m beyond its face that a block may reach within a pad's width
ALIGNED = 0.01  # 1 - cosine between a face and the pad that is as good as parallel


class GraspTarget(NamedTuple):
    """A block, or a convex part of an object. F = faces."""

    slot: Array  # [] int32
    centre: Array  # [2] m
    normal: Array  # [F, 3] world frame, 0 where there is no face
    offset: Array  # [F] m, from the centre


class GraspCandidates(NamedTuple):
    """Grasps to choose from. n = candidates."""

    slot: Array  # [n] int32, of the target
    score: Array  # [n], -inf where impossible
    pose: Array  # [n, 3] m, m, rad


def grasp(cfg: Config, scene: SceneState, height: Array, failures: Array | int = 0) -> Action:
    """Plans the best grasp: room for both fingers, faces square to the pads, a high, narrow block.

    With a target, it is the target's, else that of the block nearest to it. Each of several
    `failures` [] in a row moves to another block, then to another grasp of it. `height` [H, W] m.
    """
    parts = [_of_blocks(cfg, scene, height)]
    if cfg.scene.has_objects:
        parts.append(_of_objects(cfg, scene, height))
    candidates = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    chosen = _in_turn(candidates, len(cfg.scene.slots), jnp.int32(failures))
    return Action(primitive=jnp.int32(Primitive.GRASP), pose=candidates.pose[chosen])


def _in_turn(candidates: GraspCandidates, slots: int, failures: Array) -> Array:
    """Returns the index [] of the next grasp to try, the best first."""
    slot, score = candidates.slot, candidates.score
    best = jax.ops.segment_max(score, slot, slots)
    order = jnp.argsort(-best)
    graspable = jnp.maximum(jnp.sum(best > -jnp.inf), 1)  # blocks
    of_block = (slot == order[failures % graspable]) & (score > -jnp.inf)
    ranked = jnp.argsort(-jnp.where(of_block, score, -jnp.inf))
    return ranked[(failures // graspable * OTHER_WAY) % jnp.maximum(jnp.sum(of_block), 1)]


def _of_blocks(cfg: Config, scene: SceneState, height: Array) -> GraspCandidates:
    convex: dict[SlotKind, SlotKind] = {"arch": "box"}
    hulls = tuple(convex.get(kind, kind) for kind in cfg.scene.slots)
    normals, offsets = blocks.half_spaces(hulls, scene.half_size)
    slot = blocks.parts(hulls).slot
    rotation = jax.vmap(quat_to_matrix)(scene.quaternion)[slot]
    turned = jnp.einsum("nij,nfj->nfi", rotation, normals, precision=EXACT)
    number = jnp.asarray(slot, jnp.int32)
    targets = GraspTarget(number, scene.position[slot, :2], turned, offsets)
    return _candidates(cfg, scene, height, targets, SHIFTS)


def _of_objects(cfg: Config, scene: SceneState, height: Array) -> GraspCandidates:
    known, slots = object_slots.table(cfg.scene), np.flatnonzero(blocks.is_object(cfg.scene.slots))
    count = known.present.shape[1]

    def of_slot(slot: Array) -> GraspCandidates:
        number = scene.numbers[slot]
        normal, offset, part, middle, present = (
            jnp.asarray(leaf)[number]
            for leaf in (known.normal, known.offset, known.part, known.middle, known.present)
        )
        rotation = quat_to_matrix(scene.quaternion[slot])
        is_part = jnp.repeat(part, offset.shape[1])[None] == np.arange(count)[:, None]  # [P, F]
        flat = normal.reshape(-1, 3)  # [F, 3]
        inner = jnp.matmul(middle, flat.T, precision=EXACT)  # [P, F] m, middle along the normals
        turned = jnp.matmul(flat, rotation.T, precision=EXACT)
        centre = scene.position[slot][None] + jnp.matmul(middle, rotation.T, precision=EXACT)
        targets = GraspTarget(
            jnp.full(count, slot, jnp.int32),
            centre[:, :2],
            jnp.where(is_part[:, :, None], turned[None], 0.0),
            offset.reshape(1, -1) - inner,
        )
        grasps = _candidates(cfg, scene, height, targets, (0.0,))
        score = jnp.where(jnp.repeat(present, YAWS), grasps.score, -jnp.inf)
        return grasps._replace(score=score)

    # One after the other: the masks of all grasps of all parts would not fit the memory.
    grasps = jax.lax.map(of_slot, jnp.asarray(slots, jnp.int32))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), grasps)


def _candidates(
    cfg: Config, scene: SceneState, height: Array, targets: GraspTarget, shifts: tuple[float, ...]
) -> GraspCandidates:
    """Scores grasps of targets, leaves [B, ...], at YAWS and `shifts`; n = B YAWS len(shifts)."""
    sim, gripper, cells = cfg.sim, grippers.load(cfg.sim.gripper), cell_centres(cfg.heightmap)
    fingers = scene_state.fingers(scene, gripper)
    inner = 0.5 * jnp.asarray(fingers.opening)  # m, to an open finger
    along, across_pad = fingers.footprint
    slots = jnp.arange(len(cfg.scene.slots))

    def place(target: GraspTarget, yaw: Array, shift: Array) -> Array:
        across = rotate2d(yaw, jnp.array([0.0, 1.0]))
        cosine = jnp.matmul(target.normal[:, :2], across, precision=EXACT)
        return target.centre + shift * target.offset[jnp.argmax(cosine)] * across

    def score(target: GraspTarget, yaw: Array, shift: Array) -> Array:
        axis = jnp.append(rotate2d(yaw, jnp.array([1.0, 0.0])), 0.0)
        cosine = jnp.matmul(target.normal, axis, precision=EXACT)
        low, high = jnp.argmin(cosine), jnp.argmax(cosine)  # the faces most square to the pads
        width = target.offset[high] + target.offset[low]
        centre = place(target, yaw, shift)
        beside = inner
        if sim.opening == "fit":
            beside = jnp.minimum(0.5 * width + ROOM, inner)
        beside += 0.5 * fingers.thickness
        top = local_top(cfg.heightmap, height, centre, fingers.width)
        tip = jnp.maximum(top - grasp_depth(sim, gripper), lowest(sim, gripper))
        local = jnp.abs(rotate2d(-yaw, cells - centre[None, None]))
        finger = (jnp.abs(local[..., 0] - beside) < along) & (local[..., 1] < across_pad)
        blocked = jnp.max(jnp.where(finger, height, 0.0)) > tip - 0.002
        beyond = local[..., 0] > 0.5 * width + OWN
        swept = beyond & (local[..., 0] < beside) & (local[..., 1] < 0.5 * fingers.width)
        caught = jnp.max(jnp.where(swept, height, 0.0)) > tip
        apart = jnp.abs(rotate2d(-yaw, scene.position[:, :2] - centre[None]))
        inside = (apart[:, 0] < beside) & (apart[:, 1] < across_pad) & (scene.position[:, 2] > tip)
        caught |= jnp.any(inside & scene.in_play & (slots != target.slot))
        fits = width < fingers.opening - OPENING_ROOM
        square = jnp.minimum(cosine[high], -cosine[low])
        askew = jnp.maximum(1.0 - square - ALIGNED, 0.0)
        cost = 4.0 * blocked + 2.0 * caught + 4.0 * ~fits + 20.0 * askew + 10.0 * width
        cost += jnp.abs(shift)
        # ANY indexes the last slot, whose distance is then unused.
        away = jnp.linalg.norm(centre - scene.position[scene.target, :2])
        asked = jnp.where(scene.target == target.slot, 3.0, -4.0 * away)
        wanted = jnp.where(scene.target == ANY, 5.0 * scene.position[target.slot, 2], asked)
        reached = reachable(sim, cfg.heightmap, centre, yaw)[Primitive.GRASP]
        possible = scene.in_play[target.slot] & reached
        return jnp.where(possible, wanted - cost, -jnp.inf)

    def of_target(target: GraspTarget) -> GraspCandidates:
        scores = jax.vmap(score, (None, 0, 0))(target, *grid)
        poses = jax.vmap(lambda yaw, shift: jnp.append(place(target, yaw, shift), yaw))(*grid)
        return GraspCandidates(jnp.full(len(scores), target.slot), scores, poses)

    yaws = jnp.asarray(np.arange(YAWS) * np.pi / YAWS, jnp.float32)
    grid = jnp.repeat(yaws, len(shifts)), jnp.tile(jnp.array(shifts), YAWS)
    candidates = jax.vmap(of_target)(targets)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), candidates)
