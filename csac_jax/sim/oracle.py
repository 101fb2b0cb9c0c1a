"""A grasp planner that reads block poses: the ceiling that physics allows."""

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import grippers
from csac_jax.config import Config, SlotKind
from csac_jax.constants import Primitive
from csac_jax.geometry import cell_centres, quat_to_matrix, rotate2d
from csac_jax.scene import blocks
from csac_jax.scene.layout import ANY, Scene
from csac_jax.sim.primitives import Action, grasp_depth, local_top

YAWS = 32  # over half a turn: the hand is symmetric
OTHER_YAW = 5  # places in the order of yaws that a second try goes on: neighbours are alike
OPENING_ROOM = 0.02  # m, by which the opening must exceed what is held
EXACT = jax.lax.Precision.HIGHEST  # a GPU would cut products of matrices to 10 bits
OWN = 0.003  # m beyond its face that a block may reach within a pad's width
ALIGNED = 0.01  # 1 - cosine between a face and the pad that is as good as parallel


def grasp(
    cfg: Config, scene: Scene, height: jax.Array, failures: jax.Array | int = 0
) -> Action:
    """The best grasp: room for both fingers as they go down and close, faces square to the pads, a
    high and narrow block.

    With a target, the best grasp is the target's, else that of the block nearest to it. After each
    of several `failures` [] in a row, another block's turn comes, then another yaw.

    Args: height [H, W] m.
    """
    sim, slots, gripper = cfg.sim, cfg.scene.slots, grippers.load(cfg.sim.gripper)
    beside, (along, across_pad) = gripper.half[1] + 0.5 * gripper.finger[0], gripper.footprint
    hulls: tuple[SlotKind, ...] = tuple("box" if kind == "arch" else kind for kind in slots)
    normals, offsets = blocks.half_spaces(hulls, scene.half_size)
    rotation = jax.vmap(quat_to_matrix)(scene.quaternion)
    world_normals = jnp.einsum("nij,nfj->nfi", rotation, normals, precision=EXACT)
    yaws = jnp.asarray(np.arange(YAWS) * np.pi / YAWS, jnp.float32)
    cells = cell_centres(cfg.heightmap)

    def score(slot, yaw):
        axis = jnp.append(rotate2d(yaw, jnp.array([1.0, 0.0])), 0.0)
        cosine = jnp.matmul(world_normals[slot], axis, precision=EXACT)
        low, high = jnp.argmin(cosine), jnp.argmax(cosine)  # the faces most square to the pads
        width = offsets[slot, high] + offsets[slot, low]
        centre = scene.position[slot, :2]
        top = local_top(cfg.heightmap, height, centre, gripper.finger[1])
        tip = jnp.maximum(top - grasp_depth(sim, gripper), gripper.clearance)
        local = jnp.abs(rotate2d(-yaw, cells - centre))
        finger = (jnp.abs(local[..., 0] - beside) < along) & (local[..., 1] < across_pad)
        blocked = jnp.max(jnp.where(finger, height, 0.0)) > tip - 0.002
        beyond = local[..., 0] > 0.5 * width + OWN
        way = beyond & (local[..., 0] < beside) & (local[..., 1] < 0.5 * gripper.finger[1])
        caught = jnp.max(jnp.where(way, height, 0.0)) > tip
        off = jnp.abs(rotate2d(-yaw, scene.position[:, :2] - centre))
        inside = (off[:, 0] < beside) & (off[:, 1] < across_pad) & (scene.position[:, 2] > tip)
        caught |= jnp.any(inside & scene.in_play & (jnp.arange(len(slots)) != slot))
        fits = width < gripper.opening[1] - OPENING_ROOM
        square = jnp.minimum(cosine[high], -cosine[low])
        askew = jnp.maximum(1.0 - square - ALIGNED, 0.0)
        cost = 4.0 * blocked + 2.0 * caught + 4.0 * ~fits + 20.0 * askew + 10.0 * width
        # ANY indexes the last slot, whose distance is then unused.
        away = jnp.linalg.norm(centre - scene.position[scene.target, :2])
        asked = jnp.where(scene.target == slot, 3.0, -4.0 * away)
        wanted = jnp.where(scene.target == ANY, 5.0 * scene.position[slot, 2], asked)
        return jnp.where(scene.in_play[slot], wanted - cost, -jnp.inf)

    each_pair = jax.vmap(jax.vmap(score, (None, 0)), (0, None))
    scores = each_pair(jnp.arange(len(slots)), yaws)  # [N, YAWS]
    slot, yaw = _in_turn(scores, jnp.sum(scene.in_play), jnp.int32(failures))
    pose = jnp.append(scene.position[slot, :2], yaws[yaw])
    return Action(primitive=jnp.int32(Primitive.GRASP), pose=pose)


def _in_turn(
    scores: jax.Array, blocks_left: jax.Array, failures: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Slot and yaw [] of the next grasp to try, by `scores` [N, YAWS]: the best first."""
    order = jnp.argsort(-jnp.max(scores, axis=1))
    around = jnp.maximum(blocks_left, 1)
    slot = order[failures % around]
    yaws = jnp.argsort(-scores[slot])
    return slot, yaws[(failures // around * OTHER_YAW) % YAWS]
