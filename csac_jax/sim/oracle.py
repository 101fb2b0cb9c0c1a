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
SHIFTS = (-0.6, 0.0, 0.6)  # of the grasp, in shares of the way to the block's end
OTHER_WAY = 5  # places in the order of ways that a second try goes on: neighbours are alike
OPENING_ROOM = 0.02  # m, by which the opening must exceed what is held
EXACT = jax.lax.Precision.HIGHEST  # a GPU would cut products of matrices to 10 bits
OWN = 0.003  # m beyond its face that a block may reach within a pad's width
ALIGNED = 0.01  # 1 - cosine between a face and the pad that is as good as parallel


def grasp(cfg: Config, scene: Scene, height: jax.Array, failures: jax.Array | int = 0) -> Action:
    """The best grasp: room for both fingers as they go down and close, faces square to the pads, a
    high and narrow block.

    With a target, the best grasp is the target's, else that of the block nearest to it. After each
    of several `failures` [] in a row, another block's turn comes, then another way to take it.

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

    def place(slot, yaw, shift):
        """Where the hand closes: `shift` of the way from the middle to the block's end."""
        across = rotate2d(yaw, jnp.array([0.0, 1.0]))
        cosine = jnp.matmul(world_normals[slot, :, :2], across, precision=EXACT)
        end = offsets[slot, jnp.argmax(cosine)]
        return scene.position[slot, :2] + shift * end * across

    def score(slot, yaw, shift):
        axis = jnp.append(rotate2d(yaw, jnp.array([1.0, 0.0])), 0.0)
        cosine = jnp.matmul(world_normals[slot], axis, precision=EXACT)
        low, high = jnp.argmin(cosine), jnp.argmax(cosine)  # the faces most square to the pads
        width = offsets[slot, high] + offsets[slot, low]
        centre = place(slot, yaw, shift)
        top = local_top(cfg.heightmap, height, centre, gripper.finger[1])
        tip = jnp.maximum(top - grasp_depth(sim, gripper), gripper.clearance)
        local = jnp.abs(rotate2d(-yaw, cells - centre[None, None]))
        finger = (jnp.abs(local[..., 0] - beside) < along) & (local[..., 1] < across_pad)
        blocked = jnp.max(jnp.where(finger, height, 0.0)) > tip - 0.002
        beyond = local[..., 0] > 0.5 * width + OWN
        way = beyond & (local[..., 0] < beside) & (local[..., 1] < 0.5 * gripper.finger[1])
        caught = jnp.max(jnp.where(way, height, 0.0)) > tip
        off = jnp.abs(rotate2d(-yaw, scene.position[:, :2] - centre[None]))
        inside = (off[:, 0] < beside) & (off[:, 1] < across_pad) & (scene.position[:, 2] > tip)
        caught |= jnp.any(inside & scene.in_play & (jnp.arange(len(slots)) != slot))
        fits = width < gripper.opening[1] - OPENING_ROOM
        square = jnp.minimum(cosine[high], -cosine[low])
        askew = jnp.maximum(1.0 - square - ALIGNED, 0.0)
        cost = 4.0 * blocked + 2.0 * caught + 4.0 * ~fits + 20.0 * askew + 10.0 * width
        cost += jnp.abs(shift)
        # ANY indexes the last slot, whose distance is then unused.
        away = jnp.linalg.norm(centre - scene.position[scene.target, :2])
        asked = jnp.where(scene.target == slot, 3.0, -4.0 * away)
        wanted = jnp.where(scene.target == ANY, 5.0 * scene.position[slot, 2], asked)
        return jnp.where(scene.in_play[slot], wanted - cost, -jnp.inf)

    ways = jnp.repeat(yaws, len(SHIFTS)), jnp.tile(jnp.array(SHIFTS), YAWS)
    scores = jax.vmap(jax.vmap(score, (None, 0, 0)), (0, None, None))(jnp.arange(len(slots)), *ways)
    slot, way = _in_turn(scores, jnp.sum(scene.in_play), jnp.int32(failures))
    yaw, shift = (each[way] for each in ways)
    pose = jnp.append(place(slot, yaw, shift), yaw)
    return Action(primitive=jnp.int32(Primitive.GRASP), pose=pose)


def _in_turn(
    scores: jax.Array, blocks_left: jax.Array, failures: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Slot and way [] of the next grasp to try, by `scores` [N, ways]: the best first."""
    order = jnp.argsort(-jnp.max(scores, axis=1))
    around = jnp.maximum(blocks_left, 1)
    slot = order[failures % around]
    ways = jnp.argsort(-scores[slot])
    return slot, ways[(failures // around * OTHER_WAY) % scores.shape[1]]
