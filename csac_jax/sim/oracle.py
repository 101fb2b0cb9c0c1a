"""A grasp planner that reads the poses of blocks and objects: the ceiling that physics allows."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import grippers
from csac_jax.config import Config, SlotKind
from csac_jax.constants import Primitive
from csac_jax.geometry import cell_centres, quat_to_matrix, rotate2d
from csac_jax.scene import blocks, layout, stock
from csac_jax.scene.layout import ANY, Scene
from csac_jax.sim.primitives import Action, grasp_depth, local_top, lowest, reachable

YAWS = 32  # over half a turn: the hand is symmetric
SHIFTS = (-0.6, 0.0, 0.6)  # of the grasp, in shares of the way to the block's end
OTHER_WAY = 5  # places in the order of ways that a second try goes on: neighbours are alike
OPENING_ROOM = 0.02  # m, by which the opening must exceed what is held
EXACT = jax.lax.Precision.HIGHEST  # a GPU would cut products of matrices to 10 bits
OWN = 0.003  # m beyond its face that a block may reach within a pad's width
ALIGNED = 0.01  # 1 - cosine between a face and the pad that is as good as parallel


class Body(NamedTuple):
    """What is held: a block, or a convex part of an object. F = faces."""

    slot: jax.Array  # [] int32
    centre: jax.Array  # [2] m
    normal: jax.Array  # [F, 3] world frame, 0 where there is no face
    offset: jax.Array  # [F] m, from the centre


class Ways(NamedTuple):
    """Grasps to choose from. n = ways."""

    slot: jax.Array  # [n] int32, what is held
    score: jax.Array  # [n], -inf where there is nothing
    pose: jax.Array  # [n, 3] m, m, rad


def grasp(cfg: Config, scene: Scene, height: jax.Array, failures: jax.Array | int = 0) -> Action:
    """The best grasp: room for both fingers as they go down and close, faces square to the pads, a
    high and narrow block. Ways that the robot does not reach are left out.

    With a target, the best grasp is the target's, else that of the block nearest to it. After each
    of several `failures` [] in a row, another block's turn comes, then another way to take it.

    Args: height [H, W] m.
    """
    ways = [_of_blocks(cfg, scene, height)]
    if cfg.scene.has_objects:
        ways.append(_of_objects(cfg, scene, height))
    every = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *ways)
    chosen = _in_turn(every, len(cfg.scene.slots), jnp.int32(failures))
    return Action(primitive=jnp.int32(Primitive.GRASP), pose=every.pose[chosen])


def _in_turn(ways: Ways, slots: int, failures: jax.Array) -> jax.Array:
    """Number [] of the next way to try: the best first."""
    best = jax.ops.segment_max(ways.score, ways.slot, slots)
    order = jnp.argsort(-best)
    around = jnp.maximum(jnp.sum(best > -jnp.inf), 1)  # blocks that there is a way to take
    own = (ways.slot == order[failures % around]) & (ways.score > -jnp.inf)
    ranked = jnp.argsort(-jnp.where(own, ways.score, -jnp.inf))
    return ranked[(failures // around * OTHER_WAY) % jnp.maximum(jnp.sum(own), 1)]


def _of_blocks(cfg: Config, scene: Scene, height: jax.Array) -> Ways:
    """Every way to take a block: at its middle and towards both ends."""
    hulls: tuple[SlotKind, ...] = tuple(
        "box" if kind == "arch" else kind for kind in cfg.scene.slots
    )
    normals, offsets = blocks.half_spaces(hulls, scene.half_size)
    slot = blocks.parts(hulls).slot
    rotation = jax.vmap(quat_to_matrix)(scene.quaternion)[slot]
    world_normals = jnp.einsum("nij,nfj->nfi", rotation, normals, precision=EXACT)
    bodies = Body(jnp.asarray(slot, jnp.int32), scene.position[slot, :2], world_normals, offsets)
    return _ways(cfg, scene, height, bodies, SHIFTS)


def _of_objects(cfg: Config, scene: Scene, height: jax.Array) -> Ways:
    """Every way to take a part of an object, at its middle."""
    known, slots = stock.table(cfg.scene), np.flatnonzero(blocks.is_object(cfg.scene.slots))
    count = known.present.shape[1]

    def of_slot(slot: jax.Array) -> Ways:
        number = scene.numbers[slot]
        normal, offset, part, middle, present = (
            jnp.asarray(leaf)[number]
            for leaf in (known.normal, known.offset, known.part, known.middle, known.present)
        )
        rotation = quat_to_matrix(scene.quaternion[slot])
        own = jnp.repeat(part, offset.shape[1])[None] == np.arange(count)[:, None]  # [P, F]
        flat = normal.reshape(-1, 3)  # [F, 3]
        inner = jnp.matmul(middle, flat.T, precision=EXACT)  # [P, F] m, middle along the normals
        turned = jnp.matmul(flat, rotation.T, precision=EXACT)
        centre = scene.position[slot][None] + jnp.matmul(middle, rotation.T, precision=EXACT)
        bodies = Body(
            jnp.full(count, slot, jnp.int32),
            centre[:, :2],
            jnp.where(own[:, :, None], turned[None], 0.0),
            offset.reshape(1, -1) - inner,
        )
        ways = _ways(cfg, scene, height, bodies, (0.0,))
        there = jnp.repeat(present, YAWS)
        return ways._replace(score=jnp.where(there, ways.score, -jnp.inf))

    # One after the other: the masks of all grasps of all parts would not fit the memory.
    ways = jax.lax.map(of_slot, jnp.asarray(slots, jnp.int32))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), ways)


def _ways(
    cfg: Config, scene: Scene, height: jax.Array, bodies: Body, shifts: tuple[float, ...]
) -> Ways:
    """Grasps of bodies, leaves [B, ...], at YAWS and `shifts`; n = B YAWS len(shifts)."""
    sim, gripper, cells = cfg.sim, grippers.load(cfg.sim.gripper), cell_centres(cfg.heightmap)
    fingers = layout.fingers(scene, gripper)
    beside, (along, across_pad) = fingers.finger_offset, fingers.footprint
    slots, kind = jnp.arange(len(cfg.scene.slots)), jnp.int32(Primitive.GRASP)

    def place(body: Body, yaw: jax.Array, shift: jax.Array) -> jax.Array:
        """Where the hand closes: `shift` of the way from the middle to the body's end."""
        across = rotate2d(yaw, jnp.array([0.0, 1.0]))
        cosine = jnp.matmul(body.normal[:, :2], across, precision=EXACT)
        return body.centre + shift * body.offset[jnp.argmax(cosine)] * across

    def score(body: Body, yaw: jax.Array, shift: jax.Array) -> jax.Array:
        axis = jnp.append(rotate2d(yaw, jnp.array([1.0, 0.0])), 0.0)
        cosine = jnp.matmul(body.normal, axis, precision=EXACT)
        low, high = jnp.argmin(cosine), jnp.argmax(cosine)  # the faces most square to the pads
        width = body.offset[high] + body.offset[low]
        centre = place(body, yaw, shift)
        top = local_top(cfg.heightmap, height, centre, fingers.width)
        tip = jnp.maximum(top - grasp_depth(sim, gripper), lowest(sim, gripper))
        local = jnp.abs(rotate2d(-yaw, cells - centre[None, None]))
        finger = (jnp.abs(local[..., 0] - beside) < along) & (local[..., 1] < across_pad)
        blocked = jnp.max(jnp.where(finger, height, 0.0)) > tip - 0.002
        beyond = local[..., 0] > 0.5 * width + OWN
        way = beyond & (local[..., 0] < beside) & (local[..., 1] < 0.5 * fingers.width)
        caught = jnp.max(jnp.where(way, height, 0.0)) > tip
        off = jnp.abs(rotate2d(-yaw, scene.position[:, :2] - centre[None]))
        inside = (off[:, 0] < beside) & (off[:, 1] < across_pad) & (scene.position[:, 2] > tip)
        caught |= jnp.any(inside & scene.in_play & (slots != body.slot))
        fits = width < fingers.opening - OPENING_ROOM
        square = jnp.minimum(cosine[high], -cosine[low])
        askew = jnp.maximum(1.0 - square - ALIGNED, 0.0)
        cost = 4.0 * blocked + 2.0 * caught + 4.0 * ~fits + 20.0 * askew + 10.0 * width
        cost += jnp.abs(shift)
        # ANY indexes the last slot, whose distance is then unused.
        away = jnp.linalg.norm(centre - scene.position[scene.target, :2])
        asked = jnp.where(scene.target == body.slot, 3.0, -4.0 * away)
        wanted = jnp.where(scene.target == ANY, 5.0 * scene.position[body.slot, 2], asked)
        possible = scene.in_play[body.slot] & reachable(sim, cfg.heightmap, kind, centre, yaw)
        return jnp.where(possible, wanted - cost, -jnp.inf)

    def of_body(body: Body) -> Ways:
        every = jax.vmap(score, (None, 0, 0))(body, *ways)
        poses = jax.vmap(lambda *way: jnp.append(place(body, *way), way[0]))(*ways)
        return Ways(jnp.full(len(every), body.slot), every, poses)

    yaws = jnp.asarray(np.arange(YAWS) * np.pi / YAWS, jnp.float32)
    ways = jnp.repeat(yaws, len(shifts)), jnp.tile(jnp.array(shifts), YAWS)
    found = jax.vmap(of_body)(bodies)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)
