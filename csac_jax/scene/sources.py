"""The scenes that an environment draws from: settled blocks and packed arrangements.

`stream` numbers the stream of random numbers: training takes 0, evaluation others.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.config import Config, SceneConfig
from csac_jax.errors import SceneError
from csac_jax.scene import arrange, families, layout, model, pool
from csac_jax.scene.layout import Scene

MIN_ARRANGED = 4  # blocks in an arrangement


def scenes(cfg: Config, stream: int, count: int | None = None) -> Scene:
    """At least `count` scenes at rest, NumPy leaves [P, N, ...], as many of each number of blocks.

    The last `scene.arranged` of them are arrangements. Without a count, `scene.pool` of each number
    of blocks. Raises SceneError where blocks do not come to rest or allow no arrangement.
    """
    block_counts = 1 + len(cfg.scene.slots) - cfg.scene.min_blocks
    each = cfg.scene.pool if count is None else -(-count // block_counts)
    arranged = round(cfg.scene.arranged * each)
    parts = []
    if arranged < each:
        parts.append(settled(cfg, stream, each - arranged))
    if arranged:
        extent = cfg.heightmap.extent
        parts.append(arrangements(cfg.scene, extent, stream, arranged * block_counts))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def settled(cfg: Config, stream: int, count: int, poured: bool = False) -> Scene:
    """`pool.settled`, with the floating hand whatever robot the config names."""
    floating = model.build(cfg.scene, dataclasses.replace(cfg.sim, robot="hand"))
    dropped = dataclasses.replace(cfg.scene, arranged=0.0)
    return pool.settled(floating, dropped, cfg.heightmap.extent, stream, count, poured)


def arrangements(cfg: SceneConfig, extent: float, stream: int, count: int) -> Scene:
    """`count` packed arrangements, NumPy leaves [P, N, ...], easy ones first.

    Where there is room, each has at least MIN_ARRANGED blocks, or `cfg.min_blocks` if that is less.
    Raises SceneError where the slots allow no arrangement.
    """
    try:
        families.available(cfg.slots)
    except ValueError as error:
        raise SceneError(f"scene.arranged: {error}") from None
    cfg = dataclasses.replace(cfg, min_blocks=min(cfg.min_blocks, MIN_ARRANGED))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(stream), jnp.arange(count))
    draw = jax.vmap(lambda key, level: arrange.arrange(key, cfg, extent, level))
    return jax.device_get(jax.jit(draw)(keys, jnp.linspace(0.0, 1.0, count)))


def randomise_pose(
    key: jax.Array, scene: Scene, extent: float, any_yaw: bool, has_target: bool
) -> Scene:
    """The scene rotated by a random yaw, and with a target or none.

    The yaw is a quarter turn unless `any_yaw` and every block stays within the square of side
    `extent` m. With `has_target` the scene keeps its target, or gets a random one.
    """
    key_yaw, key_target = jax.random.split(key)
    yaw = jax.random.uniform(key_yaw, (), maxval=2.0 * np.pi)
    near = jnp.linalg.norm(scene.position[:, :2], axis=1) <= 0.5 * extent
    free = any_yaw & jnp.all(near | ~scene.in_play)
    quarters = jnp.round(yaw / (0.5 * np.pi)) * (0.5 * np.pi)
    rotated = layout.rotate(scene, jnp.where(free, yaw, quarters))
    if not has_target:
        return rotated.replace(target=jnp.full_like(scene.target, layout.ANY))
    has_own = scene.target != layout.ANY
    marked = layout.mark_target(key_target, rotated)
    return jax.tree.map(lambda own, new: jnp.where(has_own, own, new), rotated, marked)
