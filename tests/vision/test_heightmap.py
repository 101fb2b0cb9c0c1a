"""The top view against C MuJoCo, its packed form, and moved areas against hand counts."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from csac_jax import geometry
from csac_jax.config import HeightmapConfig
from csac_jax.vision import camera, heightmap, observe, raycast
from csac_jax.world import blocks

_TABLE = blocks.TABLE_COLOUR


def _look(cfg: HeightmapConfig, polytopes: raycast.Polytopes, is_target: jax.Array | None = None):
    every = jnp.ones(polytopes.offset.shape[0], bool)
    tables = observe.surface_tables(polytopes, every if is_target is None else is_target)
    return observe.ortho(cfg, observe.Shapes(polytopes), tables)


def test_heights_agree_with_mujoco(reference):
    """Claim: height and block of cells 0.1 mm off edges are C MuJoCo's to 0.1 mm."""
    cfg = HeightmapConfig(64)
    obs = jax.jit(functools.partial(_look, cfg))(reference.polytopes)
    origin = np.asarray(geometry.cell_centres(cfg), np.float64).reshape(-1, 2)
    origin = np.concatenate([origin, np.full((len(origin), 1), 0.5)], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (len(origin), 1))
    distance, geom, normal = reference.rays(origin, down)
    clear = ~reference.near_edge(origin, down, shift=1e-4)
    assert clear.mean() > 0.98
    assert set(geom[clear]) == {-1, 0, 1, 2, 3, 4, 5}
    height = np.asarray(obs.height).reshape(-1)
    np.testing.assert_allclose(height[clear], 0.5 - distance[clear], rtol=0, atol=1e-4)
    assert np.all(height[clear & (geom == -1)] == 0.0)
    # -1 is the last row
    albedo = np.concatenate([np.asarray(reference.polytopes.colour), _TABLE[None]])[geom]
    brightness = 0.4 + 0.6 * np.maximum(normal @ camera.LIGHT, 0.0)
    colour = np.asarray(obs.colour).reshape(-1, 3)
    np.testing.assert_allclose(colour[clear], (albedo * brightness[:, None])[clear], atol=1e-3)
    assert obs.height.dtype == obs.colour.dtype == jnp.float32
    assert obs.target.dtype == jnp.bool_


def test_target_mask_shows_the_target(reference):
    """Claim: the mask is True where a wanted block is seen, all ones if every one is wanted; blocks
    above VIEW_HEIGHT are not seen."""
    cfg = HeightmapConfig(64)
    look = jax.jit(lambda wanted: _look(cfg, reference.polytopes, wanted))
    clearing = look(jnp.ones(6, bool))
    assert np.all(clearing.target)
    masks = np.stack([look(jnp.arange(6) == g).target for g in range(6)])
    assert np.all(masks.sum((1, 2)) > 10)
    # each raised cell is one block's
    np.testing.assert_array_equal(masks.sum(0), np.asarray(clearing.height) > 0.0)
    middle = np.asarray(geometry.cell_centres(cfg))[masks[4]].mean(0)
    np.testing.assert_allclose(middle, [0.11, -0.07], atol=0.003)  # where the octagon stands
    position = reference.polytopes.position + jnp.array([[0.0, 0.0, 0.6]])
    assert not np.any(_look(cfg, reference.polytopes.replace(position=position)).height)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_packing_rounds(seed):
    """Claim: packing rounds heights to 0.05 mm, colours to half a level, is idempotent, and clips
    values beyond its range."""
    rng = np.random.default_rng(seed)
    obs = heightmap.Observation(
        colour=jnp.asarray(rng.uniform(size=(8, 8, 3)), jnp.float32),
        height=jnp.asarray(rng.uniform(0.0, 0.5, (8, 8)), jnp.float32),
        target=jnp.asarray(rng.uniform(size=(8, 8)) < 0.5),
    )
    packed = heightmap.pack(obs)
    assert [leaf.dtype for leaf in jax.tree.leaves(packed)] == [jnp.uint8, jnp.uint16, jnp.bool_]
    back = heightmap.unpack(packed)
    np.testing.assert_allclose(back.height, obs.height, rtol=0, atol=0.05e-3 + 1e-7)
    np.testing.assert_allclose(back.colour, obs.colour, rtol=0, atol=0.5 / 255 + 1e-6)
    np.testing.assert_array_equal(back.target, obs.target)
    jax.tree.map(np.testing.assert_array_equal, heightmap.pack(back), packed)
    beyond = obs.replace(colour=obs.colour + 1.0, height=obs.height - 7.0)
    assert np.all(heightmap.pack(beyond).colour == 255)
    assert not np.any(heightmap.pack(beyond).height)


@pytest.mark.parametrize("size", [64, 224])
def test_areas(size):
    """Claim: a block 6 cm square that moves by its own length moves 72 cm^2 at any resolution;
    changes count from 1 cm to 30 cm either way."""
    cfg = HeightmapConfig(size)
    x, y = np.moveaxis(np.asarray(geometry.cell_centres(cfg)), -1, 0)
    rows = np.abs(y) < 0.03
    before, after = (
        jnp.where(rows & (np.abs(x - place) < 0.03), 0.05, 0.0) for place in (0.0, 0.06)
    )
    edge = 4 * 6 * cfg.cell * 100 / 2  # half a cell along the outline, cm^2
    assert abs(float(heightmap.moved_area(cfg, before, after)) - 72.0) <= 2 * edge
    change = np.zeros((size, size), np.float32)
    change[0, :6] = [0.009, 0.011, -0.011, 0.299, 0.301, -0.301]
    area = heightmap.moved_area(cfg, jnp.full((size, size), 0.4), jnp.asarray(0.4 + change))
    np.testing.assert_allclose(area, 3 * (100 * cfg.cell) ** 2, rtol=1e-5)
