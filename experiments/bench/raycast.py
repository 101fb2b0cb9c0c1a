"""Speed of the raycaster, as JSON: `csac-jax bench raycast [--size N] [--scenes N] [--repeats N]`.

One ray straight down per cell of the map, at random poses of the ten blocks of the preset `fast` on
the table. Ours gives distance and surface; `mjx.ray` gives distance and geom on the same model
without the hand. `mjx.ray` keeps every triangle of every ray in memory, so it runs on PEER_ROWS
rows of a scene at a time. It fails on models without a material, so it gets one. It ignores
cylinders; there are none, since round blocks are meshes. Calls alternate and the median counts.

The arithmetic limit is the rate of a float32 matrix product at full precision, 2 SIDE^3 operations,
timed in the same run. Operations per ray are counted from the code: each sum, product, comparison,
selection, minimum, maximum and logical operation is one. What depends on the direction alone has no
ray axis and does not count. Per plane (`enter_half_spaces`): depth 7 (3 products, 3 sums, a
difference), crossing 1, inwards 1, face 2, enter 1, leave 2: 14. Per geom: valid 3, closer 2,
number and selection of the surface 3, distance 1: 9. Padding planes count: they are computed.
"""

import json
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import geometry, presets
from csac_jax.cli.failures import BadArgumentsError
from csac_jax.config import HeightmapConfig, SimConfig
from csac_jax.runtime import provenance
from csac_jax.scene import blocks, model as models
from csac_jax.scene.model import World
from csac_jax.sim import mjx_physics
from csac_jax.vision import heightmap, raycast
from csac_jax.vision.raycast import Polytopes
from experiments.bench._options import read
from experiments.bench._timing import medians

PER_PLANE, PER_GEOM = 14, 9
PEER_ROWS = 8
SIDE = 1024 if jax.default_backend() == "cpu" else 4096
DOWN = np.array([0.0, 0.0, -1.0], np.float32)

Call = Callable[[], Any]


def _poses(rng: np.random.Generator, scenes: int, num: int) -> tuple[jax.Array, jax.Array]:
    """Positions [E, N, 3] m and unit quaternions [E, N, 4] of blocks in the workspace."""
    position = rng.uniform([-0.15, -0.15, 0.02], [0.15, 0.15, 0.1], (scenes, num, 3))
    quaternion = rng.normal(size=(scenes, num, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return jnp.asarray(position, jnp.float32), jnp.asarray(quaternion, jnp.float32)


def _origins(size: int) -> jax.Array:
    """Where the rays of a map start [R, 3] m."""
    xy = geometry.cell_centres(HeightmapConfig(size)).reshape(-1, 2)
    return jnp.concatenate([xy, jnp.full((size * size, 1), heightmap.VIEW_HEIGHT)], axis=1)


def _ours(world: World, poses: tuple[jax.Array, jax.Array], origin: jax.Array) -> Call:
    """Distances and surfaces, leaves [E, R]."""
    half_size = np.stack(
        [models.LARGEST * blocks.half_size_choices(kind).max(axis=0) for kind in world.slots]
    )
    normal, offset = blocks.half_spaces(world.slots, jnp.asarray(half_size))
    slot = world.parts.slot

    def cast(position: jax.Array, quaternion: jax.Array) -> Any:
        rotation = jax.vmap(geometry.quat_to_matrix)(quaternion)[slot]
        shapes = Polytopes(normal, offset, position[slot], rotation, jnp.zeros((len(slot), 3)))
        return jax.vmap(raycast.cast_polytopes, (None, 0, None))(shapes, origin, jnp.asarray(DOWN))

    compiled = jax.jit(jax.vmap(cast))
    return lambda: compiled(*poses)


def _peer(
    world: World, sim: SimConfig, poses: tuple[jax.Array, jax.Array], origin: jax.Array
) -> Call:
    """Distances and geoms, leaves [E, R]."""
    from mujoco import mjx  # after csac_jax.sim, which keeps it from complaining of optional parts

    physics = mjx_physics.make(world, sim)
    model = physics.model.replace(mat_rgba=jnp.ones((1, 4)))
    hand = sorted(set(range(1, world.model.nbody)) - set(world.block_bodies.tolist()))
    part = PEER_ROWS * round(len(origin) ** 0.5)

    def cast(position: jax.Array, quaternion: jax.Array) -> Any:
        pose = jnp.concatenate([position, quaternion], axis=1)
        qpos = physics.data.qpos.at[world.block_qpos].set(pose)
        data = mjx.kinematics(model, physics.data.replace(qpos=qpos))

        def ray(start: jax.Array) -> Any:
            return mjx.ray(model, data, start, jnp.asarray(DOWN), bodyexclude=hand)

        hits = jax.lax.map(jax.vmap(ray), origin.reshape(-1, part, 3))
        return jax.tree.map(jnp.ravel, hits)

    compiled = jax.jit(jax.vmap(cast))
    return lambda: compiled(*poses)


def _limit() -> Call:
    """A square matrix product."""
    compiled = jax.jit(lambda a, b: jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST))
    left, right = jax.random.normal(jax.random.key(0), (2, SIDE, SIDE))
    return lambda: compiled(left, right)


def measure(size: int, scenes: int, repeats: int) -> dict[str, Any]:
    """Rays per second of both casters and the arithmetic limit."""
    cfg = presets.get("fast").change(sim={"physics": "mjx"})
    world = models.build(cfg.scene, cfg.sim)
    poses, origin = _poses(np.random.default_rng(0), scenes, len(world.slots)), _origins(size)
    calls = {
        "ours": _ours(world, poses, origin),
        "mjx": _peer(world, cfg.sim, poses, origin),
        "matrix_product": _limit(),
    }
    seconds = medians(calls, repeats)
    ours, theirs = np.asarray(calls["ours"]()[0]), np.asarray(calls["mjx"]()[0])
    rays = scenes * size * size
    geoms = len(world.parts.slot)
    per_ray = geoms * (blocks.MAX_FACES * PER_PLANE + PER_GEOM)
    limit = 2.0 * SIDE**3 / seconds["matrix_product"]
    rate = rays / seconds["ours"]
    return {
        "size": size,
        "scenes": scenes,
        "blocks": len(world.slots),
        "geoms": geoms,
        "rays": rays,
        "median_seconds": seconds,
        "rays_per_second": {"ours": rate, "mjx": rays / seconds["mjx"]},
        "mjx_seconds_over_ours": seconds["mjx"] / seconds["ours"],
        "rays_further_apart_than_0.1_mm": float(np.mean(np.abs(ours - theirs) > 1e-4)),
        "operations_per_ray": per_ray,
        "operations_per_second": per_ray * rate,
        "arithmetic_limit": limit,
        "share_of_limit": per_ray * rate / limit,
    }


def main(arguments: list[str]) -> None:
    """Prints the result."""
    options = read("raycast", arguments, size=224, scenes=256, repeats=11)
    try:
        HeightmapConfig(options["size"])
    except ValueError as error:
        raise BadArgumentsError(f"bench raycast: --size: {error}") from error
    print(json.dumps(measure(**options) | provenance.record(), indent=2))
