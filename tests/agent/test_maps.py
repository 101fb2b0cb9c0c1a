"""Dense maps: where their cells lie, and reading them at an action."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from csac_jax.agent import actor_critic, maps, policy, values
from csac_jax.config import SmallNet
from csac_jax.constants import Primitive
from csac_jax.nets import dense, networks
from csac_jax.sim import primitives
from csac_jax.sim.outcome import BARE
from csac_jax.vision import rotate
from csac_jax.vision.heightmap import Observation

GRASP, PUSH = int(Primitive.GRASP), int(Primitive.PUSH)


def _random_maps(frames: maps.Frames, seed: int = 0) -> jax.Array:
    shape = (len(Primitive), frames.yaws.size, frames.side, frames.side)
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def _read(frames: maps.Frames, values: jax.Array, primitive: int, poses: np.ndarray) -> np.ndarray:
    """Values [n] at the poses [n, 3]."""
    read = jax.jit(
        lambda values, poses: jax.vmap(
            lambda pose: maps.read(frames, values, jnp.int32(primitive), pose)
        )(poses)
    )
    return np.asarray(read(values, jnp.asarray(poses, jnp.float32)))


def _poses(num: int, radius: float = 0.22, seed: int = 0) -> np.ndarray:
    """Random poses [num, 3] within `radius` m of the centre: inside of every frame's canvas."""
    rng = np.random.default_rng(seed)
    distance, angle, yaw = rng.uniform(0, radius, num), *rng.uniform(0, 2 * np.pi, (2, num))
    return np.stack([distance * np.cos(angle), distance * np.sin(angle), yaw], axis=1)


@pytest.mark.parametrize("primitive", Primitive)
def test_reading_at_a_cells_pose_gives_the_cell(frames, primitive):
    """Claim: `cell_pose` and `read` are inverse, for every cell of every yaw."""
    values = _random_maps(frames)
    cells = jnp.arange(values[0].size)
    poses = jax.jit(jax.vmap(lambda cell: maps.cell_pose(frames, cell)))(cells)
    assert_allclose(
        _read(frames, values, primitive, poses), values[primitive].reshape(-1), atol=1e-4
    )


def test_cell_below_a_cells_pose_is_the_cell(frames):
    """Claim: rounding puts no cell's own pose into the cell or frame before it."""
    count, side = len(frames.yaws), frames.side
    to_cell = jax.vmap(rotate.to_cell, (None, None, 0, 0))
    position = to_cell(side, frames.cell, jnp.asarray(frames.yaws), jnp.asarray(frames.xy))
    cells = np.broadcast_to(np.mgrid[:side, :side].transpose(1, 2, 0), position.shape)
    assert_array_equal(rotate.floor(position), cells)
    index = maps.yaw_index(frames, jnp.asarray(frames.yaws))
    assert_array_equal(rotate.floor(index), np.arange(count))
    assert_array_equal(rotate.floor(position + 0.99), cells)


def test_is_valid_at_a_cells_pose_is_the_cell(frames):
    """Claim: `is_valid` looks at the nearest cell, also from a third of a cell and of a yaw step
    beside it."""
    valid = _random_maps(frames) > 0.0
    cells = jnp.arange(valid[0].size)
    shift = jnp.array(
        [0.2 * frames.cell, -0.25 * frames.cell, 0.3 * 2.0 * np.pi / frames.yaws.size]
    )
    check = jax.vmap(lambda p, pose: maps.is_valid(frames, valid, p, pose), (None, 0))
    for primitive in Primitive:
        poses = jax.vmap(lambda cell: maps.cell_pose(frames, cell))(cells)
        for near in (poses, poses + shift[None]):
            assert_array_equal(check(jnp.int32(primitive), near), valid[primitive].reshape(-1))


def test_read_is_linear_between_cells(frames):
    """Claim: a map that is affine in the workspace's x and y, in every frame, is read exactly
    anywhere."""
    plane = 2.0 * frames.xy[..., 0] - 3.0 * frames.xy[..., 1] + 0.5
    poses = _poses(300)
    got = _read(frames, jnp.asarray(np.stack([-plane, plane]), jnp.float32), GRASP, poses)
    assert_allclose(got, 2.0 * poses[:, 0] - 3.0 * poses[:, 1] + 0.5, atol=1e-5)


def test_read_is_linear_in_yaw_and_wraps(frames):
    """Claim: between yaws the value is linear, between the last and the first too, and whole turns
    change nothing."""
    num = frames.yaws.size
    per_yaw = np.random.default_rng(3).normal(size=num)
    values = np.zeros((2, num, frames.side, frames.side))
    values[PUSH] = per_yaw[:, None, None]
    yaw = np.linspace(-2.0 * np.pi, 4.0 * np.pi, 301)
    poses = np.stack([np.full_like(yaw, 0.05), np.full_like(yaw, -0.1), yaw], axis=1)
    wanted = np.interp(yaw, frames.yaws, per_yaw, period=2.0 * np.pi)
    assert_allclose(_read(frames, jnp.asarray(values, jnp.float32), PUSH, poses), wanted, atol=1e-5)


def test_read_is_trilinear_by_hand(frames):
    """Claim: a quarter of a cell along, half a cell across and a fifth of a yaw step on, the
    weights are products."""
    values = np.asarray(_random_maps(frames, 4))
    k, row, col = 0, 7, 5
    pose = np.append(frames.xy[k, row, col] + frames.cell * np.array([0.25, 0.5]), 0.0)
    corner = values[GRASP, k, row : row + 2, col : col + 2]
    here = np.array([0.5, 0.5]) @ corner @ np.array([0.75, 0.25])
    assert_allclose(_read(frames, values, GRASP, pose[None]), here, atol=1e-5)
    step = 2.0 * np.pi / frames.yaws.size
    turned = pose + np.array([0.0, 0.0, 0.2 * step])
    following = _read(frames, values, GRASP, (pose + np.array([0.0, 0.0, step]))[None])
    assert_allclose(
        _read(frames, values, GRASP, turned[None]), 0.8 * here + 0.2 * following, atol=1e-5
    )


def test_gradient_of_read(frames):
    """Claim: the gradient in x, y and yaw is that of finite differences, wherever the pose is
    inside of a cell."""
    values = _random_maps(frames, 5)
    poses = _poses(400, 0.2, seed=6)
    steps = np.array([0.05 * frames.cell, 0.05 * frames.cell, 0.02])
    gradient = jax.jit(
        jax.vmap(jax.grad(lambda pose: maps.read(frames, values, jnp.int32(PUSH), pose)))
    )
    got = np.asarray(gradient(jnp.asarray(poses, jnp.float32)))
    checked = 0
    for axis, step in enumerate(steps):
        above, below = (poses + sign * step * np.eye(3)[axis] for sign in (1.0, -1.0))
        same = np.all(_cells(frames, above) == _cells(frames, below), axis=1)
        wanted = (_read(frames, values, PUSH, above) - _read(frames, values, PUSH, below)) / (
            2.0 * step
        )
        scale = np.abs(wanted[same]).mean()
        assert_allclose(got[same, axis], wanted[same], atol=2e-3 * scale, rtol=2e-3)
        checked += same.sum()
    assert checked > 600


def _cells(frames: maps.Frames, poses: np.ndarray) -> np.ndarray:
    """Lower yaw, and lower cells in both frames next to it, of poses [n, 3]: [n, 5]."""
    num = frames.yaws.size
    lower = np.floor(poses[:, 2] * num / (2.0 * np.pi))
    columns = [lower]
    for k in (lower, lower + 1):
        yaw = 2.0 * np.pi * k / num
        cos, sin = np.cos(yaw), np.sin(yaw)
        x, y = cos * poses[:, 0] + sin * poses[:, 1], -sin * poses[:, 0] + cos * poses[:, 1]
        columns += [
            np.floor(x / frames.cell + 0.5 * (frames.side - 1)),
            np.floor(y / frames.cell + 0.5 * (frames.side - 1)),
        ]
    return np.stack(columns, axis=1)


def test_unfolding(frames):
    """Claim: frame k + K / 2 is frame k upside down, cells and positions alike; it pushes with the
    map of push back."""
    half = frames.yaws.size // 2
    shape = (half, frames.side, frames.side, dense.OUTPUTS)
    halves = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    all_yaws = np.asarray(maps.unfold(jnp.asarray(halves)))
    ahead, back, grasp = np.moveaxis(halves, -1, 0)
    assert_array_equal(all_yaws[PUSH], np.concatenate([ahead, back[:, ::-1, ::-1]]))
    assert_array_equal(all_yaws[GRASP], np.concatenate([grasp, grasp[:, ::-1, ::-1]]))
    assert_allclose(frames.xy[half:], frames.xy[:half, ::-1, ::-1], atol=1e-7)


def test_gripper_is_symmetric(frames):
    """Claim: a grasp's value at yaw + pi is that at yaw, wherever it is read."""
    halves = np.random.default_rng(1).normal(
        size=(frames.yaws.size // 2, frames.side, frames.side, dense.OUTPUTS)
    )
    values = maps.unfold(jnp.asarray(halves, jnp.float32))
    poses = _poses(100, seed=2)
    turned = poses + np.array([0.0, 0.0, np.pi])
    assert_allclose(
        _read(frames, values, GRASP, poses), _read(frames, values, GRASP, turned), atol=1e-4
    )
    apart = np.abs(_read(frames, values, PUSH, poses) - _read(frames, values, PUSH, turned))
    assert apart.mean() > 0.1


CENTRE, HALF = (
    np.array([0.056, -0.035]),
    np.array([0.028, 0.021]),
)  # m, a block that covers whole cells


def _one_block(cfg) -> Observation:
    size = cfg.heightmap.size
    along = (np.arange(size) + 0.5) * cfg.heightmap.cell - 0.5 * cfg.heightmap.extent
    inside = (np.abs(along - CENTRE[0]) < HALF[0])[None] & (np.abs(along - CENTRE[1]) < HALF[1])[
        :, None
    ]
    return Observation(
        colour=jnp.full((size, size, 3), 0.5),
        height=jnp.asarray(np.where(inside, 0.05, 0.0), jnp.float32),
        target=jnp.ones((size, size), bool),
    )


def _distance_to_block(xy: np.ndarray) -> np.ndarray:
    """Distance [...] m of points [..., 2] from the block; below 0 inside."""
    off = np.abs(xy - CENTRE) - HALF
    return np.where(
        np.all(off <= 0.0, axis=-1), off.max(axis=-1), np.linalg.norm(np.maximum(off, 0.0), axis=-1)
    )


def test_grasps_are_valid_above_blocks(cfg, frames):
    """Claim: a grasp is valid where the cell covers some of a block and nowhere else, in every
    frame.

    A cell's corners are 0.71 of its side from its centre; turning to the nearest cell moves by that
    of an input cell.
    """
    valid = np.asarray(maps.actionable_cells(frames, _one_block(cfg)))[GRASP]
    distance = _distance_to_block(frames.xy)
    slack = 0.71 * frames.cell + 0.71 * cfg.heightmap.cell
    assert np.all(valid[distance < 0.0])
    assert not np.any(valid[distance > slack])
    axis_parallel = (
        _distance_to_block(frames.xy[0]) < 0.5 * frames.cell
    )  # exact where nothing is turned
    covered = np.max(np.abs(frames.xy[0] - CENTRE) - HALF - 0.5 * frames.cell, axis=-1) < -1e-6
    assert_array_equal(valid[0], covered)
    assert covered.sum() >= axis_parallel.sum() / 2 > 0


def test_pushes_are_valid_ahead_of_which_a_block_lies(cfg, frames):
    """Claim: a push is valid where a block lies within its length ahead along the yaw, not behind,
    not beside."""
    valid = np.asarray(maps.actionable_cells(frames, _one_block(cfg)))[PUSH]
    length, slack = cfg.sim.push_length, 1.5 * frames.cell
    seen = {"ahead": 0, "behind": 0, "beside": 0, "far": 0}
    for k, yaw in enumerate(frames.yaws):
        direction, across = (
            np.array([np.cos(yaw), np.sin(yaw)]),
            np.array([-np.sin(yaw), np.cos(yaw)]),
        )
        offset = CENTRE - frames.xy[k]
        along, beside = offset @ direction, np.abs(offset @ across)
        extent, width = (
            np.abs(direction) @ HALF,
            np.abs(across) @ HALF,
        )  # m, half the block's shadows
        ahead = (along > 0.0) & (along < length) & (beside < 0.5 * frames.cell) & frames.inside[k]
        behind, far = along < -extent - slack, along > length + extent + slack
        off = beside > width + 2.0 * slack
        assert np.all(valid[k][ahead])
        for name, cells in (("behind", behind), ("far", far), ("beside", off)):
            assert not np.any(valid[k][cells]), name
            seen[name] += int(cells.sum())
        seen["ahead"] += int(ahead.sum())
    assert min(seen.values()) > 10


def test_nothing_is_valid_outside_of_the_workspace(cfg, frames):
    """Claim: no action starts outside of the square, and on a bare table none is valid."""
    size = cfg.heightmap.size
    full = _one_block(cfg).replace(height=jnp.full((size, size), 0.05))
    valid = np.asarray(maps.actionable_cells(frames, full))
    assert not np.any(valid[:, np.max(np.abs(frames.xy), axis=-1) > 0.5 * cfg.heightmap.extent])
    assert np.all(
        valid[GRASP] == (np.max(np.abs(frames.xy), axis=-1) <= 0.5 * cfg.heightmap.extent)
    )
    assert not np.any(maps.actionable_cells(frames, full.replace(height=jnp.zeros((size, size)))))


def test_actions_anywhere(cfg, frames):
    """Claim: with `policy.cells all` every cell of the workspace is valid, on a bare table and in
    the target task too, and random grasps meet bare table, as eq. 15's lowest level asks."""
    anywhere = cfg.change(policy={"cells": "all"}, task={"kind": "target"})
    free = maps.frames(anywhere, networks.make(cfg.net))
    obs = _one_block(cfg)
    for height in (obs.height, jnp.zeros_like(obs.height)):
        valid = maps.actionable_cells(free, obs.replace(height=height))
        assert_array_equal(valid, np.stack([frames.inside] * 2))
    keys = jax.random.split(jax.random.key(0), 100)
    grasps = jax.jit(jax.vmap(lambda key: policy.random_grasp(key, free, valid)))(keys)
    below = jax.vmap(lambda xy: primitives.local_top(cfg.heightmap, obs.height, xy, 0.02))
    assert 0.5 < np.mean(below(grasps.pose[:, :2]) < BARE) < 1.0


def test_target_task_grasps_the_target_alone(cfg, frames):
    """Claim: in the target task a grasp is valid above the target alone, a push ahead of which any
    block lies."""
    lone = _one_block(cfg)
    amid = lone.replace(target=lone.height > 0.01, height=jnp.maximum(lone.height, 0.02))
    valid = maps.actionable_cells(dataclasses.replace(frames, shows_target=True), amid)
    assert_array_equal(valid[GRASP], maps.actionable_cells(frames, lone)[GRASP])
    assert_array_equal(valid[PUSH], maps.actionable_cells(frames, amid)[PUSH])
    assert 0 < np.asarray(valid[GRASP]).sum() < frames.inside.sum() // 4
    assert np.all(valid[PUSH] == frames.inside)


def test_best_cells(frames):
    """Claim: the largest valid values in their order; if none is valid, the largest of all."""
    values = _random_maps(frames)[GRASP]
    valid = _random_maps(frames, 1)[GRASP] > 0.5
    flat = np.asarray(values).reshape(-1)
    only = np.where(np.asarray(valid).reshape(-1), flat, -np.inf)
    assert_array_equal(maps.best_cells(values, valid, 5), np.argsort(-only)[:5])
    assert_array_equal(maps.best_cells(values, jnp.zeros_like(valid), 5), np.argsort(-flat)[:5])


def test_normalise_is_inverse(frames):
    """Claim: pose to box and back is the same pose, with the yaw in [0, 2 pi)."""
    poses = jnp.asarray(_poses(100), jnp.float32)
    box = jax.vmap(lambda pose: maps.normalise(frames, pose))(poses)
    assert np.all(np.abs(box) <= 1.0)
    assert_allclose(jax.vmap(lambda u: maps.denormalise(frames, u))(box), poses, atol=2e-6)


@pytest.mark.optax
@pytest.mark.slow
def test_turned_scene_gives_turned_maps(cfg, observations, randomised):
    """Claim: a scene turned by one frame step gives the same maps one frame on, with a random net,
    the actor's too; so the best action turns with the scene.

    By 90 degrees, where turning to the nearest cell is exact. Not across the half turn: there push
    ahead and push back come from other outputs of the net, and frames K / 2 - 1 and K - 1 have no
    such successor.
    """
    four = actor_critic.make(
        cfg.change(net=SmallNet(rotations=4, growth=4, dilations=(1, 2), stem=4, head=8))
    )
    params = randomised(actor_critic.init(jax.random.key(0), four)).online
    scenes = observations(2, 0)
    turned = jax.tree.map(
        lambda field: jnp.rot90(field, -1, axes=(1, 2)), scenes
    )  # rows are y: this is +90 degrees
    look = jax.jit(lambda obs: values.dense_maps(four, params, obs))
    before, after = look(scenes), look(turned)
    for k in (0, 2):
        assert_array_equal(after.valid[:, :, k + 1], before.valid[:, :, k])
        assert_allclose(after.q[:, :, k + 1], before.q[:, :, k], atol=1e-4)
        assert_allclose(after.logits[:, :, k + 1], before.logits[:, :, k], atol=1e-3)
    assert np.std(before.q) > 0.05
    for primitive in Primitive:
        first, second = (
            four.frames.xy[k].reshape(-1, 2)[
                np.argmax(np.where(state.valid, state.q, -np.inf)[0, primitive, k])
            ]
            for state, k in ((before, 0), (after, 1))
        )
        assert_allclose(second, [-first[1], first[0]], atol=1e-6)


def test_best_over_yaws(frames):
    """Claim: a place has the largest valid value of its yaws, each primitive its own, and -inf
    where none is valid."""
    shape = (len(Primitive), frames.yaws.size, frames.side, frames.side)
    q, valid = np.zeros(shape, np.float32), np.zeros(shape, bool)
    q[PUSH, 3, 9, 6], q[PUSH, 1, 9, 9], q[GRASP, 3, 9, 6] = 1.0, 7.0, 0.5
    valid[PUSH, 3, 9, 6] = valid[GRASP, 3, 9, 6] = True
    state = maps.DenseMaps(jnp.asarray(q), jnp.asarray(q), jnp.asarray(valid))
    places = jnp.asarray(np.stack([frames.xy[3, 9, 6], frames.xy[1, 9, 9]]).reshape(2, 1, 2))
    best = maps.best_over_yaws(frames, state, places)
    assert_allclose(best[:, 0, 0], [1.0, 0.5], atol=1e-5)
    assert np.all(np.isneginf(best[:, 1, 0]))
