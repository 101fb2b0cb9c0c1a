"""Height maps of points and of a depth image, against NumPy and the view from above."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings, strategies as st

from csac_jax.config import CameraConfig, HeightmapConfig
from csac_jax.vision import camera, heightmap, observe, raycast
from tests.sections import scaled

CFG = HeightmapConfig(64, view="oblique")
_EYE, _FINE = (camera.make(scaled(CameraConfig(), share)) for share in (0.25, 0.5))


def _by_hand(
    cfg: HeightmapConfig, points: np.ndarray, valid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Height [H, W] and which point [H, W], -1 for none, point by point."""
    height, source = np.zeros((cfg.size, cfg.size), np.float32), np.full((cfg.size, cfg.size), -1)
    top = np.full((cfg.size, cfg.size), -np.inf)
    cells = np.floor((points[:, :2] + np.float32(0.5 * cfg.extent)) / np.float32(cfg.cell))
    for i in np.flatnonzero(valid):
        col, row = cells[i]
        if 0 <= row < cfg.size and 0 <= col < cfg.size:
            row, col = int(row), int(col)
            if points[i, 2] > top[row, col]:
                top[row, col], source[row, col] = points[i, 2], i
                height[row, col] = max(points[i, 2], 0.0)
    return height, source


_from_points = jax.jit(heightmap.from_points, static_argnums=0)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_points_agree_with_numpy(seed):
    """Claim: height and source of a cell are those of a loop: the highest, of ties the first."""
    rng = np.random.default_rng(seed)
    cfg = HeightmapConfig(16, extent=0.5)  # a cell of 2^-5 m: dividing by it is exact
    points = rng.uniform(-0.3, 0.3, (400, 3)).astype(np.float32)
    points[:, 2] = rng.integers(-1, 4, 400) * 0.01  # ties, and some below the table
    valid = rng.uniform(size=400) < 0.8
    points[~valid & (rng.uniform(size=400) < 0.5)] = np.nan
    cells = jax.device_get(_from_points(cfg, jnp.asarray(points), jnp.asarray(valid)))
    height, source = _by_hand(cfg, points, valid)
    np.testing.assert_array_equal(cells.height, height)
    np.testing.assert_array_equal(cells.filled, source >= 0)
    np.testing.assert_array_equal(cells.source[cells.filled], source[cells.filled])


def test_the_view_agrees_with_numpy(reference):
    """Claim: of a depth image, height, colour and target mask are NumPy's, bit for bit (uncompiled:
    a fused multiply-add may move a point to another cell)."""
    seen = camera.cast_rays(_EYE, raycast.cast_polytopes, reference.polytopes)
    is_target = jnp.arange(6) == 4
    tables = observe.surface_tables(reference.polytopes, is_target)
    obs = observe.from_pixels(CFG, _EYE, seen, tables)
    depth, valid, surface = (np.asarray(leaf) for leaf in (seen.distance, seen.valid, seen.surface))
    points = depth[..., None] * np.asarray(camera.directions(_EYE)) + np.asarray(_EYE.position)
    height, source = _by_hand(CFG, points.reshape(-1, 3), valid.reshape(-1))
    row = surface.reshape(-1)[source]
    empty = source < 0
    assert 0.02 < empty.mean() < 0.5
    np.testing.assert_array_equal(obs.height, height)
    colour = np.where(empty[..., None], 0.0, np.asarray(tables[0])[row])
    np.testing.assert_array_equal(obs.colour, colour)
    np.testing.assert_array_equal(obs.target, np.where(empty, False, np.asarray(tables[1])[row]))
    assert np.asarray(obs.target).any()
