"""Errors of a depth camera on an exact depth image: noise, steps, holes, mixed pixels.

It works in inverse depth, w = 1 / z: a stereo camera's disparity is f b w, and a plane is linear in
the image. Errors of w that do not depend on w are errors of z that grow with z^2. Sources:
[1] Grunnet-Jepsen, Sweetser and Woodfill, "Tuning depth cameras for best performance", Intel: the
    best resolutions; RMS error of depth z^2 subpixel / (f b); 126 disparities are searched.
[2] Grunnet-Jepsen et al., "Subpixel linearity improvement for RealSense depth cameras": views.
[3] Intel RealSense D400 series data sheet: baselines.
[4] librealsense, issue 3904: subpixel error of 0.08 px.
[5] Keselman et al., CVPR workshops 2017, "Intel RealSense stereoscopic depth cameras": 5 bits of
    subpixel disparity (R200), errors that are alike within a matching window.
[6] Microsoft, "Azure Kinect DK hardware specifications": range and random error of NFOV unbinned.
"""

import functools
import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from csac_jax.config import CameraConfig, SensorKind

UNIT = 0.001  # m, steps of a depth image of 16 bits
JUMP = 0.01  # m (ours), a larger step between pixels is an edge
LOST, FLYING = 0.5, 0.25  # shares of the pixels at an edge without depth and with a mixed one, ours
DARK = 0.01  # least share of the light that must come back (ours)
SUPPORT = 3  # neighbours that lie with a pixel: a corner of a surface has as many
NEAR = 0.015  # share of the depth by which they may differ (ours); 3 px where those are coarser
STEEP = math.cos(math.radians(80.0))  # of the largest angle between ray and normal (ours)


class DepthCamera(NamedTuple):
    """Error model of a depth camera."""

    noise: float  # 1/m, standard deviation of inverse depth
    step: float  # 1/m, between inverse depths; 0: none
    nearest: float  # m
    farthest: float  # m
    baseline: float  # m, from the viewpoint to the second one, along the image's rows; 0: none
    window: float  # half side of the window that one depth is found from, at a depth of 1


def _stereo(width: int, view_deg: float, baseline: float) -> DepthCamera:
    """Makes a D400 camera of `width` px, a field of view, a baseline in m; window 7 px (ours)."""
    focal = 0.5 * width / math.tan(math.radians(0.5 * view_deg))
    disparity = focal * baseline  # px, at a depth of 1 m
    return DepthCamera(
        noise=0.08 / disparity,  # [1], [4]
        step=1.0 / 32.0 / disparity,  # [5]
        nearest=disparity / 126.0,  # [1]
        farthest=10.0,
        baseline=baseline,
        window=3.0 / focal,
    )


CAMERAS: dict[SensorKind, DepthCamera] = {
    "d415": _stereo(1280, 65.0, 0.055),  # [1], [2], [3]
    "d435": _stereo(848, 90.0, 0.050),  # [1], [2], [3]
    "azure_kinect": DepthCamera(0.017 / 3.86**2, 0.0, 0.5, 3.86, 0.0, 0.0),  # [6]
}
"""Every kind but `none`. The Kinect's random error of 17 mm is taken at the end of its range."""


def measure(
    key: jax.Array,
    camera: DepthCamera,
    eye: CameraConfig,
    exact: jax.Array,
    valid: jax.Array,
    lightness: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Measures depths [h, w] m; returns them and [h, w] bool, a pixel has one.

    Half of the pixels at edges have no depth. Nor have surfaces that are dark, at a flat angle,
    hidden from the second viewpoint, too near or too far. The returned light is
    lightness cos(angle). Multiple reflections, sunlight and lasting errors are left out.

    Args: exact [h, w] m along the optical axis; valid [h, w] bool, the ray hit anything; lightness
    [h, w], share of the light that the surface scatters; eye, whose intrinsics count.
    """
    key_noise, key_edge, key_dark = jax.random.split(key, 3)
    radius = max(1, round(camera.window * eye.focal[0]))
    inverse = jnp.where(valid, 1.0 / jnp.where(valid, exact, 1.0), 0.0)  # [h, w] 1/m
    around = _shifted(inverse, radius)
    bends = jnp.abs(around[::2] + around[1::2] - 2.0 * inverse[None])  # [2, h, w], 0 on a plane
    edge = jnp.max(bends, axis=0) > JUMP * inverse**2
    cosine = _cosine(eye, inverse, around, radius)
    draw = jax.random.uniform(key_edge, exact.shape)
    mixed = edge & (draw >= LOST) & (draw < LOST + FLYING)
    near, far = jnp.max(around, axis=0), jnp.min(around, axis=0)
    measured = jnp.where(mixed, far + (draw - LOST) / FLYING * (near - far), inverse)
    noise = _alike_within(jax.random.normal(key_noise, exact.shape), camera.window * eye.focal[0])
    depth = _depth(camera, measured + camera.noise * noise)
    dark = lightness * cosine < DARK * jax.random.uniform(key_dark, exact.shape)
    lost = jnp.where(edge, draw < LOST, dark | (cosine < STEEP))
    in_range = (depth >= camera.nearest) & (depth <= camera.farthest)
    return depth, valid & in_range & ~lost & ~hidden(camera, eye, inverse)


def supported(depth: jax.Array, focal: Any) -> jax.Array:
    """Returns [h, w] bool, a pixel does not fly: SUPPORT or more of its eight neighbours have its
    depth [h, w] m, 0 without one. `focal` is in px."""
    reach = depth * jnp.maximum(NEAR, 3.0 / focal)
    starts = [start for start in itertools.product(range(3), repeat=2) if start != (1, 1)]
    neighbours = [jax.lax.dynamic_slice(jnp.pad(depth, 1), at, depth.shape) for at in starts]
    alike = [(jnp.abs(other - depth) < reach).astype(jnp.int32) for other in neighbours]
    return functools.reduce(jnp.add, alike) >= SUPPORT


def _shifted(inverse: jax.Array, radius: int) -> jax.Array:
    """Returns the pixels to the right, left, below and above [4, h, w]; edges repeat."""
    padded, size = jnp.pad(inverse, radius, mode="edge"), inverse.shape
    starts = ((radius, 2 * radius), (radius, 0), (2 * radius, radius), (0, radius))
    return jnp.stack([jax.lax.dynamic_slice(padded, start, size) for start in starts])


def _cosine(eye: CameraConfig, inverse: jax.Array, around: jax.Array, radius: int) -> jax.Array:
    """Returns the cosine [h, w] of the angle between a surface's normal and the pixel's ray."""
    # On the plane n . p = 1 the pixel (x, y, 1) has the inverse depth n . (x, y, 1).
    right, left, below, above = around
    rows, cols = inverse.shape
    x = ((jnp.arange(cols, dtype=jnp.float32) - eye.centre[0]) / eye.focal[0])[None]
    y = ((jnp.arange(rows, dtype=jnp.float32) - eye.centre[1]) / eye.focal[1])[:, None]
    along = (right - left) * (0.5 * eye.focal[0] / radius)
    down = (below - above) * (0.5 * eye.focal[1] / radius)
    normal = along**2 + down**2 + (inverse - along * x - down * y) ** 2
    return inverse / jnp.sqrt(jnp.maximum(normal * (x**2 + y**2 + 1.0), 1e-12))


def hidden(camera: DepthCamera, eye: CameraConfig, inverse: jax.Array) -> jax.Array:
    """Returns [h, w] bool, hidden from the second viewpoint: shadows at the left of near things.

    A pixel of column u lies in column u - f b w there. A pixel further right hides it that lies
    half a pixel or more further left there. Things narrower than their shadow hide too much.
    """
    columns = jnp.arange(inverse.shape[1], dtype=jnp.float32)[None]
    there = columns - eye.focal[0] * camera.baseline * inverse
    return jax.lax.cummin(there, axis=1, reverse=True) < there - 0.5


def _alike_within(noise: jax.Array, window: float) -> jax.Array:
    """Averages noise [h, w] over `window` px to all sides and keeps its variance."""
    reach = round(window)
    for axis in range(2):
        moved = [jnp.roll(noise, shift, axis) for shift in range(-reach, reach + 1)]
        noise = functools.reduce(jnp.add, moved) / math.sqrt(len(moved))
    return noise


def _depth(camera: DepthCamera, inverse: jax.Array) -> jax.Array:
    """Converts to depths [h, w] m in steps; 0 where the inverse depth is not above 0."""
    if camera.step > 0.0:
        inverse = camera.step * jnp.round(inverse / camera.step)
    ahead = inverse > 0.0
    depth = UNIT * jnp.round(1.0 / jnp.where(ahead, inverse, 1.0) / UNIT)
    return jnp.where(ahead, depth, 0.0)
