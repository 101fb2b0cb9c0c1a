"""Primitives in MJX with its Warp implementation: the scan of `mjx_physics`, other contacts.

All scenes share one array of contacts, which a scene cannot read: touch sensors tell which block
the hand touches. Meshes have one size in all scenes. Results are not repeatable bit for bit.
"""

import functools

import jax
import jax.numpy as jnp

from csac_jax.config import WARP_WORLDS, SimConfig
from csac_jax.errors import SceneError
from csac_jax.scene.model import HAND_GEOMS, World
from csac_jax.sim.mjx_physics import MjxPhysics
from csac_jax.sim.quiet_mjx import mjx


def make(world: World, cfg: SimConfig) -> MjxPhysics:
    """Physics of a world on Warp. Raises SceneError where Warp is not installed."""
    try:
        import warp
    except ImportError:
        raise SceneError(
            "sim.physics: warp is an extra; run: pip install 'csac-jax[warp]'"
        ) from None
    from mujoco.mjx.third_party.mujoco_warp import OverflowType
    from mujoco.mjx.warp.types import GraphMode

    warp.config.log_level = warp.LOG_WARNING  # not a line for each of its kernels
    # On CUDA, MJX's own choice records a new graph for every set of buffers from XLA. A training
    # step has many: 1,024 scenes took 3.7 s an action. One graph with its own buffers takes 0.52 s
    # (H200, `experiments/bench`).
    graph_mode = GraphMode.WARP_STAGED if jax.default_backend() == "gpu" else None
    model = mjx.put_model(world.model, impl="warp", graph_mode=graph_mode)
    model = model.tree_replace({"opt._impl.warn_overflow": 0})
    data = mjx.make_data(
        world.model,
        impl="warp",
        naconmax=WARP_WORLDS * cfg.contacts,
        njmax=4 * cfg.contacts + 32,  # the edges of friction pyramids; joints and limits
    )
    stopped_early = OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS  # the solver, by design
    lost_contacts = int(OverflowType.ALL & ~stopped_early)
    return MjxPhysics(world, cfg, model, data, functools.partial(_sensor_touch, lost_contacts))


def _sensor_touch(lost_contacts: int, world: World, data: mjx.Data) -> tuple[jax.Array, jax.Array]:
    """See `MjxPhysics.touch`; the bits `lost_contacts` tell that an array of contacts ran over."""
    touching = data.sensordata.reshape(len(HAND_GEOMS), len(world.slots)) > 0.0
    return touching, jnp.any((data._impl.overflow & lost_contacts) != 0)
