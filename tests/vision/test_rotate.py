"""Rotated frames and interpolation against SciPy, and against where blocks are known to lie."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage
from hypothesis import example, given, settings, strategies as st

from csac_jax.config import HeightmapConfig
from csac_jax.vision import observe, rotate
from tests.vision.conftest import cubes

_K = 16


def _yaw(k: int) -> float:
    return 2.0 * np.pi * k / _K


@pytest.mark.parametrize(("size", "side", "count"), [(64, 80, 16), (48, 48, 8), (64, 90, 16)])
def test_frames_agree_with_scipy(size, side, count):
    """Claim: every frame is SciPy's nearest-cell rotation, to half a pixel a side, and 0 outside
    the workspace: an action with the frame's yaw points along +column."""
    tables = rotate.tables(size, 0.448, _K, count, side)
    row, col = np.meshgrid(*[np.arange(size, dtype=np.float32)] * 2, indexing="ij")
    maps = jnp.asarray(np.stack([row, col, np.ones_like(row)], axis=-1))
    frames = np.asarray(rotate.rotate(tables, maps))
    assert frames.shape == (count, side, side, 3)
    for k in range(count):
        cos, sin = np.cos(_yaw(k)), np.sin(_yaw(k))
        # (row, col) of the frame to (row, col) of the workspace
        matrix = np.array([[cos, sin], [-sin, cos]])
        offset = 0.5 * (size - 1) - matrix @ np.full(2, 0.5 * (side - 1))

        def scipy_frame(channel, order, matrix=matrix, offset=offset):
            return scipy.ndimage.affine_transform(
                channel, matrix, offset, (side, side), order=order, cval=np.nan
            )

        inside = ~np.isnan(scipy_frame(np.asarray(row), 1))
        assert np.all(frames[k, inside, 2] == 1.0)
        along = (np.arange(side) + 0.5 - 0.5 * side) / size
        x, y = np.meshgrid(along, along)
        beyond = np.maximum(np.abs(cos * x - sin * y), np.abs(sin * x + cos * y)) > 0.5 + 1e-6
        assert not np.any(frames[k, beyond])
        for channel, exact in enumerate((row, col)):
            shift = np.abs(frames[k, :, :, channel] - scipy_frame(exact, 1))[inside]
            assert shift.max() <= 0.5 + 1e-4
            same = frames[k, :, :, channel][inside] == scipy_frame(exact, 0)[inside]
            assert same.mean() > 0.97  # ties at half a cell may fall to either side


def test_quarter_turns_are_exact():
    """Claim: frame 0 is the map in a border of zeros; quarter turns only permute cells."""
    tables = rotate.tables(64, 0.448, _K, _K, 80)
    maps = np.random.default_rng(0).normal(size=(64, 64, 3)).astype(np.float32)
    frames = np.asarray(rotate.rotate(tables, jnp.asarray(maps)))
    assert np.abs(frames[0]).sum() == pytest.approx(np.abs(maps).sum(), rel=1e-5)
    for quarter in range(4):
        inner = frames[quarter * _K // 4, 8:-8, 8:-8]
        # rows upward: the frame's turn undone
        np.testing.assert_array_equal(inner, np.rot90(maps, quarter))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, _K - 1), st.floats(-0.15, 0.15), st.floats(-0.15, 0.15))
@example(2, 0.11138523104556389, 0.11138523104556389)
def test_a_block_appears_where_to_cell_says(k, x, y):
    """Claim: a block is seen in the map and in frame k where `to_cell` says, to half a cell."""
    cfg = HeightmapConfig(64)
    block = cubes((x, y, 0.025))
    tables = rotate.tables(cfg.size, cfg.extent, _K, _K, 80)
    height = _look(block)
    row, column = np.argwhere(np.asarray(height) > 0.02).mean(0)
    xy = (np.array([column, row]) + 0.5) * cfg.cell - 0.5 * cfg.extent
    np.testing.assert_allclose(xy, [x, y], atol=0.5 * cfg.cell)
    frame = rotate.rotate(tables, height[..., None], jnp.array(k, jnp.int32))
    seen = np.argwhere(np.asarray(frame)[..., 0] > 0.02).mean(0)
    yaw = jnp.asarray(_yaw(k), jnp.float32)
    place = rotate.to_cell(tables.canvas, tables.cell, yaw, jnp.asarray(xy, jnp.float32))
    np.testing.assert_allclose(place, seen, atol=0.5)


@jax.jit
def _look(block):
    tables = observe.surface_tables(block, jnp.ones(1, bool))
    return observe.ortho(HeightmapConfig(64), observe.Shapes(block), tables).height


def test_bilinear_agrees_with_scipy():
    """Claim: `bilinear` is SciPy's order-1 interpolation, with the nearest edge's value outside."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 12, 17)).astype(np.float32)
    row_col = rng.uniform([-3.0, -3.0], [15.0, 20.0], (3, 500, 2)).astype(np.float32)
    # the last cells themselves
    row_col[:, :4] = [[0.0, 0.0], [11.0, 16.0], [4.0, 16.0], [11.0, 3.5]]
    read_all = jax.jit(jax.vmap(jax.vmap(rotate.bilinear, in_axes=(None, 0))))
    read = read_all(jnp.asarray(values), jnp.asarray(row_col))
    for i in range(3):
        expected = scipy.ndimage.map_coordinates(values[i], row_col[i].T, order=1, mode="nearest")
        np.testing.assert_allclose(read[i], expected, atol=1e-5)
