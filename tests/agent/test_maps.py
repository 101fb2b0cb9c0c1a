"""Dense maps: where their cells lie, and reading them at an action."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax import grippers
from csac_jax.agent import maps, policy
from csac_jax.constants import Primitive
from csac_jax.geometry import cell_centres
from csac_jax.nets import dense, networks
from csac_jax.robot import primitives
from csac_jax.sim.outcome import BARE
from csac_jax.vision.heightmap import Observation

GRASP, PUSH = int(Primitive.GRASP), int(Primitive.PUSH)


def _random_maps(frames: maps.Frames, seed: int = 0) -> jax.Array:
    shape = frames.reachable.shape
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def _read(frames: maps.Frames, values: jax.Array, primitive: int, poses: np.ndarray) -> np.ndarray:
    """Values [n] at the poses [n, 3]."""
    read = jax.vmap(lambda values, pose: maps.read(frames, values, primitive, pose), (None, 0))
    return np.asarray(jax.jit(read)(jnp.asarray(values), jnp.asarray(poses, jnp.float32)))


def _poses(num: int, radius: float = 0.22, seed: int = 0) -> np.ndarray:
    """Random poses [num, 3] within `radius` m of the centre: inside of every frame's canvas."""
    rng = np.random.default_rng(seed)
    distance, angle, yaw = rng.uniform(0, radius, num), *rng.uniform(0, 2 * np.pi, (2, num))
    return np.stack([distance * np.cos(angle), distance * np.sin(angle), yaw], axis=1)


def _cell_poses(frames: maps.Frames) -> jax.Array:
    """Poses [n, 3] of all cells of all yaws."""
    return jax.vmap(lambda cell: maps.cell_pose(frames, cell))(jnp.arange(frames.inside.size))


def test_reading_at_a_cells_pose_gives_the_cell(frames):
    """Claim: `cell_pose` and `read` are inverse, for every cell of every yaw."""
    values = _random_maps(frames)
    for p in Primitive:
        got = _read(frames, values, int(p), _cell_poses(frames))
        assert_allclose(got, values[p].reshape(-1), atol=1e-4)


def test_is_valid_at_a_cells_pose_is_the_cell(frames):
    """Claim: `is_valid` looks at the nearest cell, also a third of a cell and of a yaw step off."""
    valid, poses = _random_maps(frames) > 0.0, _cell_poses(frames)
    step = 2.0 * np.pi / frames.yaws.size
    shift = jnp.array([0.2 * frames.cell, -0.25 * frames.cell, 0.3 * step])
    check = jax.vmap(lambda p, pose: maps.is_valid(frames, valid, p, pose), (None, 0))
    for p in Primitive:
        for near in (poses, poses + shift[None]):
            assert_array_equal(check(jnp.int32(p), near), valid[p].reshape(-1))


def test_read_is_linear_between_cells(frames):
    """Claim: a map that is affine in x and y, in every frame, is read exactly anywhere."""
    plane = 2.0 * frames.xy[..., 0] - 3.0 * frames.xy[..., 1] + 0.5
    poses = _poses(300)
    got = _read(frames, jnp.asarray(np.stack([-plane, plane]), jnp.float32), GRASP, poses)
    assert_allclose(got, 2.0 * poses[:, 0] - 3.0 * poses[:, 1] + 0.5, atol=1e-5)


def test_read_is_linear_in_yaw_and_wraps(frames):
    """Claim: the value is linear between yaws, the last and the first too."""
    per_yaw = np.random.default_rng(3).normal(size=frames.yaws.size).astype(np.float32)
    values = jnp.zeros(frames.reachable.shape).at[PUSH].set(per_yaw[:, None, None])
    yaw = np.linspace(-2.0 * np.pi, 4.0 * np.pi, 301)
    poses = np.stack([np.full_like(yaw, 0.05), np.full_like(yaw, -0.1), yaw], axis=1)
    wanted = np.interp(yaw, frames.yaws, per_yaw, period=2.0 * np.pi)
    assert_allclose(_read(frames, values, PUSH, poses), wanted, atol=1e-5)


def test_unfolding(frames):
    """Claim: frame k + K / 2 is frame k upside down, and pushes with the map of push back."""
    half = frames.yaws.size // 2
    shape = (half, frames.side, frames.side, dense.OUTPUTS)
    halves = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    all_yaws = np.asarray(maps.unfold(jnp.asarray(halves)))
    ahead, back, grasp = np.moveaxis(halves, -1, 0)
    assert_array_equal(all_yaws[PUSH], np.concatenate([ahead, back[:, ::-1, ::-1]]))
    assert_array_equal(all_yaws[GRASP], np.concatenate([grasp, grasp[:, ::-1, ::-1]]))
    assert_allclose(frames.xy[half:], frames.xy[:half, ::-1, ::-1], atol=1e-7)


# m, a block that covers whole cells
CENTRE, HALF = np.array([0.056, -0.035]), np.array([0.028, 0.021])


@pytest.fixture
def block(cfg) -> Observation:
    size = cfg.heightmap.size
    along = (np.arange(size) + 0.5) * cfg.heightmap.cell - 0.5 * cfg.heightmap.extent
    in_x, in_y = (np.abs(along - CENTRE[axis]) < HALF[axis] for axis in (0, 1))
    height = jnp.asarray(np.where(in_x[None] & in_y[:, None], 0.05, 0.0), jnp.float32)
    return Observation(jnp.full((size, size, 3), 0.5), height, jnp.ones((size, size), bool))


def test_grasps_are_valid_above_blocks(cfg, frames, block):
    """Claim: a grasp is valid where the cell covers some of a block and nowhere else.

    A cell's corners are 0.71 of its side from its centre; turning to the nearest cell moves by that
    of an input cell. Frame 0 is not turned, and exact.
    """
    valid = np.asarray(maps.actionable_cells(frames, block))[GRASP]
    off = np.abs(frames.xy - CENTRE) - HALF
    outside = np.linalg.norm(np.maximum(off, 0.0), axis=-1)
    assert np.all(valid[np.all(off < 0.0, axis=-1)])
    assert not np.any(valid[outside > 0.71 * (frames.cell + cfg.heightmap.cell)])
    covered = np.max(off[0] - 0.5 * frames.cell, axis=-1) < -1e-6
    assert_array_equal(valid[0], covered)
    assert covered.any()


def test_pushes_are_valid_ahead_of_which_a_block_lies(cfg, frames, block):
    """Claim: a push is valid where a block lies within its length ahead, else not."""
    valid = np.asarray(maps.actionable_cells(frames, block))[PUSH]
    length, slack = cfg.sim.push_length, 1.5 * frames.cell
    counts = np.zeros(4, int)
    for k, yaw in enumerate(frames.yaws):
        direction = np.array([np.cos(yaw), np.sin(yaw)])
        across = np.array([-np.sin(yaw), np.cos(yaw)])
        offset = CENTRE - frames.xy[k]
        along, aside = offset @ direction, np.abs(offset @ across)
        extent, width = np.abs(direction) @ HALF, np.abs(across) @ HALF  # m, half of its shadows
        ahead = (along > 0.0) & (along < length) & (aside < 0.5 * frames.cell) & frames.inside[k]
        behind, far = along < -extent - slack, along > length + extent + slack
        off = aside > width + 2.0 * slack
        assert np.all(valid[k][ahead])
        assert not np.any(valid[k][behind | far | off])
        counts += [cells.sum() for cells in (ahead, behind, far, off)]
    assert counts.min() > 10


def test_pushes_look_a_cell_to_each_side(cfg, frames, block):
    """Claim: a push is valid if any cell holds a block, of its own, those up to its length ahead
    and those a cell to either side: NumPy's windows of scattered cells agree."""
    scattered = np.random.default_rng(0).random(block.height.shape) > 0.995
    sparse = block.replace(height=jnp.where(scattered, 0.05, 0.0))
    under = np.asarray(maps.cell_heights(frames, sparse.height)) > BARE
    reach = int(np.ceil(cfg.sim.push_length / frames.cell))
    padded = np.pad(under, ((0, 0), (1, 1), (0, reach)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, reach + 1), axis=(1, 2))
    wanted = windows.any(axis=(3, 4)) & frames.inside & frames.reachable[PUSH]
    assert_array_equal(np.asarray(maps.actionable_cells(frames, sparse))[PUSH], wanted)
    assert 0.05 < wanted[frames.inside].mean() < 0.95


def test_nothing_is_valid_outside_of_the_workspace(frames, block):
    """Claim: no action starts outside of the square, and on a bare table none is valid."""
    full = block.replace(height=jnp.full_like(block.height, 0.05))
    valid = np.asarray(maps.actionable_cells(frames, full))
    inside = np.max(np.abs(frames.xy), axis=-1) <= 0.5 * frames.extent
    assert not np.any(valid[:, ~inside])
    assert np.all(valid[GRASP] == inside)
    bare = full.replace(height=jnp.zeros_like(block.height))
    assert not np.any(maps.actionable_cells(frames, bare))


def test_actions_anywhere(cfg, frames, block):
    """Claim: with `policy.action_mask none` every cell of the workspace is valid, on a bare table
    and in the target task too, and random grasps meet bare table, as eq. 15's lowest level asks."""
    anywhere = cfg.change(policy={"action_mask": "none"}, task={"kind": "target"})
    free = maps.frames(anywhere, networks.make(cfg.net))
    for height in (block.height, jnp.zeros_like(block.height)):
        valid = maps.actionable_cells(free, block.replace(height=height))
        assert_array_equal(valid, np.stack([frames.inside] * 2))
    keys = jax.random.split(jax.random.key(0), 100)
    grasps = jax.jit(jax.vmap(lambda key: policy.random_grasp(key, free, valid)))(keys)
    below = jax.vmap(lambda xy: primitives.local_top(cfg.heightmap, block.height, xy, 0.02))
    assert 0.5 < np.mean(below(grasps.pose[:, :2]) < BARE) < 1.0


def test_target_task_grasps_the_target_alone(frames, block):
    """Claim: in the target task grasps are valid above the target, pushes towards any block."""
    height = jnp.maximum(block.height, 0.02)
    amid = block.replace(target=block.height > 0.01, height=height)
    valid = maps.actionable_cells(dataclasses.replace(frames, shows_target=True), amid)
    assert_array_equal(valid[GRASP], maps.actionable_cells(frames, block)[GRASP])
    assert_array_equal(valid[PUSH], maps.actionable_cells(frames, amid)[PUSH])
    assert 0 < np.asarray(valid[GRASP]).sum() < frames.inside.sum() // 4
    assert np.all(valid[PUSH] == frames.inside)


def test_net_sees_how_the_hand_fits(cfg):
    """Claim: with `net.fit` four maps follow those without it; above the middle of a disc they
    have half its width, no shift, its height below the surface, and nothing beside, at all yaws."""
    plain, fitted = (cfg.change(net={"fit": flag}, heightmap={"size": 224}) for flag in (0, 1))
    away = jnp.linalg.norm(cell_centres(fitted.heightmap), axis=-1)
    height = jnp.where(away < 0.03, 0.05, 0.0)
    bare = jnp.full((*height.shape, 3), 0.5)
    obs = Observation(bare, height, jnp.ones(height.shape, bool))
    frames = [maps.frames(one, networks.make(one.net)) for one in (plain, fitted)]
    before, after = (np.asarray(maps.rotated_inputs(one, obs)) for one in frames)
    assert_array_equal(after[..., :-4], before)
    middle = after.shape[1] // 2
    found = after[:, middle, middle, -4:] / maps.FIT_SCALE
    depth = primitives.grasp_depth(cfg.sim, grippers.load(cfg.sim.gripper))
    assert_allclose(found, [[0.03, 0.0, depth, 0.0]] * len(found), atol=0.004)
    assert not after[:, 0, 0, -4:].any()
    some = maps.rotated_inputs(frames[1], obs, jnp.array([2, 0]))
    assert_array_equal(some, after[np.array([2, 0])])
