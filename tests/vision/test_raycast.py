"""The raycaster against C MuJoCo, and laws that hold for any scene."""

import copy
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from hypothesis import strategies as st

from csac_jax import geometry
from csac_jax.vision import raycast

_TABLE = -1  # geom


class Hit(NamedTuple):
    """First hit of one ray."""

    distance: jax.Array  # [] in lengths of the direction
    normal: jax.Array  # [3] of the surface
    geom: jax.Array  # []
    valid: jax.Array  # [] bool


def _cast_one(polytopes: raycast.Polytopes, origin: jax.Array, direction: jax.Array) -> Hit:
    """`raycast.cast_polytopes` with the normal and the geom of the surface."""
    distance, surface, valid = raycast.cast_polytopes(polytopes, origin, direction)
    normal = raycast.surface_normals(polytopes)[surface]
    return Hit(distance, normal, (surface - 1) // polytopes.offset.shape[1], valid)


_cast_all = jax.jit(jax.vmap(_cast_one, in_axes=(None, 0, 0)))
_seeds = st.integers(0, 2**32 - 1)


def _random_rays(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays [R, 3] from a dome to points in and about the scene; float32 values in float64."""
    origin = rng.normal(size=(count, 3))
    origin[:, 2] = np.abs(origin[:, 2]) + 0.2
    origin *= 0.6 / np.linalg.norm(origin, axis=1, keepdims=True)
    through = rng.uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.25], (count, 3))
    direction = through - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin, direction = (rays.astype(np.float32) for rays in (origin, direction))
    return origin.astype(np.float64), direction.astype(np.float64)


def _random_scene(rng: np.random.Generator, geoms: int = 4, faces: int = 8) -> raycast.Polytopes:
    """Boxes cut by two random planes, turned at random."""
    box = np.concatenate([np.eye(3), -np.eye(3)])
    cuts = rng.normal(size=(geoms, faces - 6, 3))
    cuts /= np.linalg.norm(cuts, axis=-1, keepdims=True)
    quat = rng.normal(size=(geoms, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    position = rng.uniform([-0.15, -0.15, 0.0], [0.15, 0.15, 0.15], (geoms, 3))
    normal = np.concatenate([np.tile(box, (geoms, 1, 1)), cuts], axis=1)
    offset = rng.uniform(0.01, 0.05, (geoms, faces))
    normal, offset, position, quat = (
        jnp.asarray(leaf, jnp.float32) for leaf in (normal, offset, position, quat)
    )
    rotation = jax.vmap(geometry.quat_to_matrix)(quat)
    return raycast.Polytopes(normal, offset, position, rotation, jnp.zeros((geoms, 3)))


def _cast(polytopes: raycast.Polytopes, origin: np.ndarray, direction: np.ndarray) -> Hit:
    return _cast_all(polytopes, *(jnp.asarray(leaf, jnp.float32) for leaf in (origin, direction)))


def _assert_same(hit: Hit, clear: np.ndarray, distance: Any, geom: Any) -> np.ndarray:
    """Hits, geoms and distances of clear rays are C's; returns those that hit, [R] bool."""
    hit, met = jax.device_get(hit), clear & (geom > -2)
    np.testing.assert_array_equal(hit.valid[clear], geom[clear] > -2)
    np.testing.assert_array_equal(hit.geom[met], geom[met])
    np.testing.assert_allclose(hit.distance[met], distance[met], rtol=0, atol=1e-4)
    return met


def test_rays_agree_with_mujoco(reference):
    """Claim: geoms, distances (0.1 mm), normals are C's for rays 0.1 mm off edges or more."""
    origin, direction = _random_rays(np.random.default_rng(1), 4000)
    distance, geom, normal = reference.rays(origin, direction)
    hit = _cast(reference.polytopes, origin, direction)
    clear = ~reference.near_edge(origin, direction, shift=1e-4)
    assert clear.mean() > 0.95
    assert len(np.unique(geom[clear])) == 8  # six blocks, the table, and rays that miss
    met = _assert_same(hit, clear, distance, geom)
    np.testing.assert_allclose(np.asarray(hit.normal)[met], normal[met], rtol=0, atol=1e-3)
    assert np.all(np.isinf(np.asarray(hit.distance)[clear & (geom == -2)]))


def test_rays_along_the_axes_agree_with_mujoco(reference):
    """Claim: rays parallel to faces, where a slab gives 0 / 0, are told apart rightly too."""
    rng = np.random.default_rng(2)
    direction = np.repeat(np.concatenate([np.eye(3)[:2], -np.eye(3)]), 200, axis=0)
    origin = rng.uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.12], (1000, 3)) - 0.5 * direction
    polytopes = reference.polytopes.replace(rotation=jnp.tile(jnp.eye(3), (6, 1, 1)))
    upright = reference._replace(data=copy.copy(reference.data))
    upright.data.qpos[reference.world.block_qpos[:, 3:]] = [1.0, 0.0, 0.0, 0.0]
    mujoco.mj_kinematics(upright.data.model, upright.data)
    distance, geom, _ = upright.rays(origin, direction)
    hit = _cast(polytopes, origin, direction)
    clear = ~upright.near_edge(origin, direction, shift=1e-4)
    assert clear.mean() > 0.9
    assert len(np.unique(geom[clear])) >= 6
    _assert_same(hit, clear, distance, geom)


def test_unused_geoms_are_never_hit():
    """Claim: a geom of unused faces (zero normal, positive offset) is never hit, without NaN; a
    scene without geoms is the table alone."""
    rng = np.random.default_rng(3)
    polytopes = _random_scene(rng)
    empty = polytopes.replace(normal=jnp.zeros((4, 8, 3)), offset=jnp.full((4, 8), 1e3))
    origin, direction = _random_rays(rng, 500)
    hit = _cast(empty, origin, direction)
    np.testing.assert_array_equal(hit.geom, _TABLE)
    np.testing.assert_array_equal(hit.valid, direction[:, 2] < 0)
    assert not np.isnan(np.asarray(hit.distance)).any()
    none = _cast_one(
        jax.tree.map(lambda x: x[:0], polytopes),
        jnp.array([0.0, 0.0, 0.5]),
        jnp.array([0, 0, -1.0]),
    )
    assert (none.valid, none.geom, none.distance) == (True, _TABLE, 0.5)


def test_seen_from_outside_only(reference):
    """Claim: a ray from inside a block or under the table does not meet it."""
    down, up = jnp.array([0.0, 0.0, -1.0]), jnp.array([0.0, 0.0, 1.0])
    inside = jnp.array([0.02, 0.01, 0.025])
    hit = _cast_one(reference.polytopes, inside, down)
    assert hit.valid
    assert hit.geom == _TABLE
    assert not _cast_one(reference.polytopes, jnp.array([0.02, 0.01, 0.3]), up).valid
    assert not _cast_one(reference.polytopes, jnp.array([0.02, 0.01, -0.1]), down).valid


def test_a_broken_scene_spoils_no_other():
    """Claim: a geom whose pose is NaN is not hit, and the geoms beside it are seen as before."""
    rng = np.random.default_rng(4)
    polytopes = _random_scene(rng)
    origin, direction = _random_rays(rng, 300)
    broken = polytopes.replace(position=polytopes.position.at[1].set(jnp.nan))
    gone = polytopes.replace(offset=polytopes.offset.at[1].set(-1.0))
    seen = (_cast(scene, origin, direction) for scene in (broken, gone))
    jax.tree.map(np.testing.assert_array_equal, *seen)
