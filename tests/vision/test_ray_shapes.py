"""Every kind of geom against C MuJoCo, and laws of each by itself."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from csac_jax.vision import raycast
from csac_jax.world import geoms
from csac_jax.world.solids import GeomGroup, Kind, Solids
from tests.vision import mujoco_rays

_cast = jax.jit(jax.vmap(raycast.cast_solids, in_axes=(None, None, 0)))
_cast_from = jax.jit(jax.vmap(raycast.cast_solids, in_axes=(None, 0, 0)))
_seeds = st.integers(0, 2**32 - 1)
_ROUND = (Kind.SPHERE, Kind.CAPSULE, Kind.CYLINDER)
PIXEL = 1.0 / 618.62  # rad, of the default camera


def _silhouette(model, data, origin: Any, direction: Any, ours: np.ndarray) -> np.ndarray:
    """[R] bool, a ray one pixel beside meets another geom, nothing, or something 5 mm nearer."""
    side = np.cross(direction, [0.0, 0.0, 1.0])
    side *= PIXEL / np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, direction)
    edge = np.zeros(len(direction), bool)
    for step in (side, -side, up, -up):
        other = mujoco_rays.cast(model, data, origin, direction + step)
        edge |= (other.distance < 0.0) != np.isinf(ours)
        edge |= np.abs(np.where(other.distance < 0.0, np.inf, other.distance) - ours) > 5e-3
    return edge


def _compare(make, rng: np.random.Generator, scenes: int, count: int) -> tuple[int, int]:
    """Rays cast, and rays that only one caster says hit; distances are checked on the way."""
    total, differ, met = 0, 0, set()
    while total < scenes * count:
        model, data = make(rng)
        origin, direction = mujoco_rays.bundle(rng, count)
        expected = mujoco_rays.cast(model, data, origin, direction)
        # the origin lies inside a geom
        if np.any(np.sum(expected.normal * direction, axis=1) > 1e-6):
            continue
        hit = jax.device_get(_cast(mujoco_rays.read(model, data), origin, direction))
        total, differ = total + count, differ + int(np.sum(hit.valid != (expected.geom >= 0)))
        met |= set(expected.geom[expected.geom >= 0])
        both = hit.valid & (expected.geom >= 0)
        off = np.abs(np.where(both, hit.distance, 0.0) - np.where(both, expected.distance, 0.0))
        far = np.flatnonzero(off > 1e-4)
        at_edge = _silhouette(model, data, origin, direction[far], hit.distance[far])
        assert np.all(at_edge), (off[far][~at_edge], expected.geom[far][~at_edge])
        close = both & (off < 1e-5)
        # two geoms share a surface: spheres at the elbow
        other = close & (hit.geom != expected.geom)
        assert other.mean() < 0.02
        off = np.abs(hit.normal - expected.normal)[close & ~other]
        assert off.max() < 2e-3
    assert len(met) >= 9
    return total, differ


@pytest.mark.parametrize(
    ("make", "scenes", "count", "share"),
    [
        (mujoco_rays.every_type, 2, 2500, 1e-3),
        pytest.param(mujoco_rays.every_type, 50, 10_000, 1e-5, marks=pytest.mark.slow),
        pytest.param(mujoco_rays.blocks_and_arm, 50, 10_000, 1e-5, marks=pytest.mark.slow),
    ],
)
def test_rays_agree_with_mujoco(make, scenes: int, count: int, share: float):
    """Claim: distances are C MuJoCo's to 0.1 mm off silhouettes, normals to 0.002; at most 1 in
    100,000 of many rays meets something for one caster alone."""
    total, differ = _compare(make, np.random.default_rng(1), scenes, count)
    assert differ / total <= share


def _solid(kind: Kind, rng: np.random.Generator) -> tuple[Solids, Any, Any, Any]:
    """One random geom: the scene, its size [3], position [3] and rotation [3, 3]."""
    size, position = rng.uniform(0.01, 0.08, 3), rng.uniform(-0.2, 0.2, 3)
    rotation = Rotation.random(random_state=rng).as_matrix()
    leaves = (jnp.asarray(leaf[None], jnp.float32) for leaf in (size, position, rotation))
    group = GeomGroup(kind, *leaves, jnp.zeros(1, jnp.int32))
    return Solids((group,), jnp.zeros((1, 3))), size, position, rotation


def _depth(kind: Kind, size: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Signed distances (right in sign and zeros) to the surface of points [R, 3]."""
    if kind is Kind.SPHERE:
        return np.linalg.norm(point, axis=1) - size[0]
    if kind is Kind.BOX:
        return (np.abs(point) - size).max(axis=1)
    beyond = np.abs(point[:, 2]) - size[1]
    around = np.linalg.norm(point[:, :2], axis=1)
    if kind is Kind.CYLINDER:
        return np.maximum(around - size[0], beyond)
    return np.hypot(around, np.maximum(beyond, 0.0)) - size[0]


@pytest.mark.parametrize("kind", [Kind.BOX, *_ROUND])
@settings(max_examples=15, deadline=None)
@given(seed=_seeds, scale=st.floats(0.1, 10.0))
def test_hits_lie_on_the_surface(kind, seed, scale):
    """Claim: a hit lies on the surface, its normal faces the ray, and nothing lies before it."""
    rng = np.random.default_rng(seed)
    scene, size, position, rotation = _solid(kind, rng)
    origin, direction = mujoco_rays.bundle(rng, 64)
    direction = direction + 0.2 * (position - origin - direction)  # towards the geom
    direction *= scale / np.linalg.norm(direction, axis=1, keepdims=True)
    direction = direction.astype(np.float32)
    hit = jax.device_get(_cast(scene, origin, direction))
    met = hit.valid
    local = (origin - position) @ rotation + hit.distance[met, None] * (direction[met] @ rotation)
    np.testing.assert_allclose(_depth(kind, size, local), 0.0, atol=3e-6)
    assert np.all(np.sum(hit.normal * direction, axis=1)[met] <= 1e-3 * scale)
    np.testing.assert_allclose(np.linalg.norm(hit.normal[met], axis=1), 1.0, atol=1e-3)
    outside = local + 1e-3 * (hit.normal[met] @ rotation)
    assert np.all(_depth(kind, size, outside) > 2e-4)
    reach = np.where(met, 0.999 * hit.distance, 2.0 / scale)[:, None]
    steps = np.linspace(0.0, reach, 400) * (direction @ rotation)
    assert np.all(
        _depth(kind, size, ((origin - position) @ rotation + steps).reshape(-1, 3)) > -1e-5
    )


@pytest.mark.parametrize("kind", [Kind.BOX, *_ROUND])
def test_rays_along_the_axes_agree_with_mujoco(kind):
    """Claim: rays parallel to axis or faces, where a slab gives 0 / 0, are right too."""
    rng = np.random.default_rng(2)
    geom = f'<geom type="{kind.name.lower()}" size="0.05 0.03 0.02"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geom}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    direction = np.repeat(np.concatenate([np.eye(3), -np.eye(3)]), 100, axis=0).astype(np.float32)
    origin = (rng.uniform(-0.1, 0.1, (600, 3)) - 0.5 * direction).astype(np.float32)
    origin[::10] = np.where(direction[::10] == 0.0, 0.0, origin[::10])  # along the axis itself
    hit = jax.device_get(_cast_from(mujoco_rays.read(model, data), origin, direction))
    distance = mujoco_rays.cast(model, data, origin, direction).distance
    np.testing.assert_array_equal(hit.valid, distance >= 0.0)
    assert 0.1 < hit.valid.mean() < 0.9
    np.testing.assert_allclose(hit.distance[hit.valid], distance[hit.valid], rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", [Kind.BOX, *_ROUND])
def test_seen_from_outside_only(kind):
    """Claim: a ray that starts inside a geom, or behind it, does not meet it."""
    scene, _, position, rotation = _solid(kind, np.random.default_rng(3))
    origin = np.stack([position, position + 0.3 * rotation[:, 0]]).astype(np.float32)
    direction = np.stack([rotation[:, 0]] * 2).astype(np.float32)
    np.testing.assert_array_equal(_cast_from(scene, origin, direction).valid, [False, False])


def test_geoms_that_are_read():
    """Claim: a geom of opacity 0 is not met; colours are the geom's or its material's; a geom of an
    unknown type is refused by its name and type."""
    egg = '<mujoco><worldbody><geom name="egg" type="ellipsoid" size="1 2 3"/></worldbody></mujoco>'
    with pytest.raises(ValueError, match=r"geom egg: .*ellipsoid.*cylinder"):
        geoms.read(mujoco.MjModel.from_xml_string(egg))
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset><material name="red" rgba="1 0 0 1"/></asset><worldbody>
        <geom type="sphere" size="0.1" pos="0 0 1" rgba="1 1 1 0"/>
        <geom type="sphere" size="0.1" pos="0 0 0.5" rgba="0.25 0.5 0.75 1"/>
        <geom type="sphere" size="0.1" pos="1 0 0.5" material="red"/></worldbody></mujoco>"""
    )
    scene = geoms.read(model)
    origin, down = jnp.array([[0.0, 0, 2], [1, 0, 2]]), jnp.array([[0.0, 0, -1]] * 2)
    hit = _cast_from(scene, origin, down)
    np.testing.assert_array_equal(hit.geom, [1, 2])
    np.testing.assert_allclose(scene.colour[1:], [[0.25, 0.5, 0.75], [1, 0, 0]])
