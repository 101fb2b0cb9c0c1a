"""Depth cameras against the formulas of their makers, against rays and against brute force."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.config import CameraConfig, SensorConfig
from csac_jax.vision import camera, depth_camera, observe, raycast, sensor
from tests.deploy import scenes
from tests.sections import scaled

EYE = scaled(CameraConfig(), 0.5)
D415 = depth_camera.CAMERAS["d415"]
WIDE = D415._replace(baseline=0.15)  # its shadows are wide enough to be compared
SHAPES = scenes.blocks_at([[0.05, 0.06, 0.3], [-0.1, -0.05, 1.2]])

_measure = jax.jit(depth_camera.measure, static_argnums=(1, 2))
_supported = jax.jit(depth_camera.supported)


class Picture(NamedTuple):
    """Exact rays' results; [h, w, ...] NumPy."""

    depth: np.ndarray  # m, 0 where nothing is hit
    lit: np.ndarray  # colours
    shadow: np.ndarray  # bool, something stands between the point and the second viewpoint
    near_shadow: np.ndarray  # bool, within 1.5 pixels of the border of a shadow


@pytest.fixture(scope="module")
def picture() -> Picture:
    """Two blocks, by rays from the camera and from its points to the second viewpoint."""
    eye = camera.make(EYE)

    @jax.jit
    def cast() -> Any:
        hits = camera.cast_rays(eye, raycast.cast_polytopes, SHAPES)
        points = camera.points(eye, jnp.where(hits.valid, hits.distance, 1.0))
        lit = observe.surface_tables(SHAPES, jnp.ones(2, bool)).colour[hits.surface]
        second = eye.position + WIDE.baseline * eye.rotation[:, 0]
        to_points = (points - second[None, None]).reshape(-1, 3)
        back = jax.vmap(raycast.cast_polytopes, (None, None, 0))(SHAPES, second, to_points)
        return hits, lit, back.distance.reshape(hits.distance.shape)

    hits, lit, reached = jax.device_get(cast())
    shadow = hits.valid & (reached < 0.99)
    spread = np.lib.stride_tricks.sliding_window_view(np.pad(shadow, 2, mode="edge"), (5, 5))
    border = spread.any((2, 3)) & ~spread.all((2, 3))
    depth = np.where(hits.valid, hits.distance, 0.0).astype(np.float32)
    return Picture(depth, lit, shadow, border)


def _plane(distance: float, lightness: float = 0.5, kind: Any = "d415") -> Any:
    """Depths and which are measured of a wall that faces the camera."""
    shape = (EYE.size[1], EYE.size[0])
    depth, light = (jnp.full(shape, value, jnp.float32) for value in (distance, lightness))
    own = depth_camera.CAMERAS[kind]
    return jax.device_get(
        _measure(jax.random.key(3), own, EYE, depth, jnp.ones(shape, bool), light)
    )


@pytest.mark.parametrize(
    ("kind", "distance", "error", "alike"),
    [
        ("d415", 2.0, 2.0**2 * 0.08 / (1004.6 * 0.055), None),  # z^2 subpixel / (f b)
        ("d435", 2.0, 2.0**2 * 0.08 / (424.0 * 0.050), 4 / 5),
        ("azure_kinect", 0.5 * 3.86, 0.25 * 0.017, 0.0),
    ],
)
def test_errors_are_those_of_the_data_sheets(kind: str, distance: float, error: float, alike: Any):
    """Claim: depths of a wall err by the makers' figure, on top of which are the steps' errors.
    Errors are alike within a stereo camera's window, not in time of flight."""
    depth, valid = _plane(distance, kind=kind)
    off = depth[valid] - distance
    step = depth_camera.CAMERAS[kind].step * distance**2
    assert np.std(off) == pytest.approx(np.hypot(error, step / 12**0.5), rel=0.1)
    assert abs(np.mean(off)) < 0.1 * error
    if alike is not None:
        correlation = np.corrcoef(depth[:, 1:].ravel(), depth[:, :-1].ravel())[0, 1]
        assert correlation == pytest.approx(alike, abs=0.05)


@pytest.mark.parametrize(
    ("distance", "lightness", "kind", "share"),
    [
        (0.44, 0.5, "d415", 1.0),
        (0.43, 0.5, "d415", 0.0),  # 126 px of disparity at 43.8 cm
        (3.9, 0.5, "azure_kinect", 0.0),
        (1.0, 0.005, "d415", 0.5),
        (1.0, 0.0, "d415", 0.0),
    ],
)
def test_range_and_darkness(distance: float, lightness: float, kind: str, share: float):
    """Claim: too near, too far or black: no depth; half as light as needed: half of the time."""
    _, valid = _plane(distance, lightness, kind)
    assert abs(valid.mean() - share) < 0.06


def test_shadow_is_what_the_second_viewpoint_does_not_see(picture: Picture):
    """Claim: shadows are where rays to the second viewpoint are blocked."""
    inverse = np.divide(1.0, picture.depth, where=picture.depth > 0, out=0 * picture.depth)
    hidden = np.asarray(depth_camera.hidden(WIDE, EYE, jnp.asarray(inverse)))
    assert picture.shadow.sum() > 50
    wrong = (hidden != picture.shadow) & (picture.depth > 0)
    assert not np.any(wrong & ~picture.near_shadow)
    assert wrong.sum() < 0.3 * picture.shadow.sum()


def test_steep_surfaces_have_no_depth():
    """Claim: a table seen at less than ten degrees has no depth, one seen at more has."""
    rows = np.arange(EYE.size[1], dtype=np.float32)[:, None] - EYE.centre[1]
    for height, seen in ((0.12, False), (0.25, True)):  # m above a level table, 1 m ahead
        slope = np.broadcast_to(rows / EYE.focal[1], EYE.size[::-1])
        ahead = slope + height  # the table passes 1 m ahead of the image's middle
        inverse = np.where(ahead > 0.0, ahead / height, 0.0)
        depth = np.divide(1.0, inverse, where=inverse > 0, out=np.zeros_like(inverse))
        light = jnp.full(depth.shape, 0.5)
        given = jnp.asarray(depth, jnp.float32), jnp.asarray(depth > 0), light
        _, valid = _measure(jax.random.key(0), D415, EYE, *given)
        assert (np.degrees(np.arctan(height)) > 10.0) == seen
        assert np.asarray(valid)[119:121, 20:-20].mean() == float(seen)


def test_edges_lose_and_mix_pixels(picture: Picture):
    """Claim: beside a step of 10 cm half of the pixels are lost, a quarter lie between; elsewhere
    none does. Leaving out pixels without support takes most of those, and hardly others."""
    rows, cols = EYE.size[::-1]
    depth = np.where(np.arange(cols) < cols // 2, 0.9, 1.0) * np.ones((rows, 1))
    given = jnp.asarray(depth, jnp.float32), jnp.ones(depth.shape, bool), jnp.ones(depth.shape)
    kinect = depth_camera.CAMERAS["azure_kinect"]
    measured, valid = jax.device_get(_measure(jax.random.key(1), kinect, EYE, *given))
    edge = np.abs(np.arange(cols) - cols // 2 + 0.5) < 1.0
    off = np.abs(measured - depth) > 0.01
    assert valid[:, edge].mean() == pytest.approx(0.5, abs=0.1)
    assert off[:, edge].mean() == pytest.approx(0.25 * 0.9, abs=0.08)
    assert not off[:, ~edge].any()
    assert valid[:, ~edge].all()
    kept = np.asarray(_supported(jnp.asarray(np.where(valid, measured, 0.0)), EYE.focal[0]))
    assert (kept & off).sum() < 0.2 * (valid & off).sum()
    assert kept[:, ~edge].all()
    kept, lone = np.asarray(_supported(jnp.asarray(picture.depth), EYE.focal[0])), picture.depth > 0
    assert not kept[~lone].any()
    lone[:, [0, -1]] = lone[[0, -1]] = False
    assert kept[lone].mean() > 0.995


def test_image_of_another_renderer(picture: Picture):
    """Claim: a NumPy image keeps its kind: unchanged without errors, else with all of them."""
    rgb = np.round(255 * picture.lit).astype(np.uint8)
    depth = np.where(picture.depth > 0, picture.depth, np.nan)
    take = jax.jit(sensor.image, static_argnums=(1, 2))
    same = jax.device_get(take(jax.random.key(0), SensorConfig(), EYE, rgb, depth))
    np.testing.assert_array_equal(same[0], rgb)
    np.testing.assert_array_equal(same[1], picture.depth)
    noisy = SensorConfig(kind="d435", colour=0.1, light=0.1)
    colour, measured = jax.device_get(take(jax.random.key(0), noisy, EYE, rgb, depth))
    assert (colour.dtype, measured.dtype) == (np.uint8, np.float32)
    seen = (measured > 0) & (picture.depth > 0)
    assert 0.5 < seen.mean() < (picture.depth > 0).mean()
    assert 1e-4 < np.median(np.abs(measured - picture.depth)[seen]) < 0.005
    assert np.abs(colour.astype(int) - rgb).mean() > 1.0
