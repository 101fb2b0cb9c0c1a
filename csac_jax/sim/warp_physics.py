"""Primitives in MJX with its Warp implementation: the scan of `mjx_physics`, the contacts of
another engine.

Contacts of all scenes share one array here, so that a scene cannot look its own up: sensors in the
model tell which block the hand touches. Meshes have one size in all scenes. Not repeatable bit for
bit.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx

from csac_jax.config import WARP_WORLDS, SimConfig
from csac_jax.errors import SceneError
from csac_jax.scene.model import HAND_GEOMS, World
from csac_jax.sim.mjx_physics import MjxPhysics

_ROWS = 4  # constraint rows of a contact: the edges of its friction pyramid
_OTHER_ROWS = 32  # of joints and limits


def make(world: World, cfg: SimConfig) -> MjxPhysics:
    """Physics of a world on Warp. Raises SceneError where Warp is not installed."""
    try:
        import warp
    except ImportError:
        raise SceneError(
            "sim.physics: warp is an extra; run: pip install 'csac-jax[warp]'"
        ) from None
    from mujoco.mjx.third_party.mujoco_warp import OverflowType

    warp.config.log_level = warp.LOG_WARNING  # not a line for each of its kernels
    model = mjx.put_model(world.model, impl="warp", graph_mode=_graph_mode())
    model = model.tree_replace({"opt._impl.warn_overflow": 0})
    data = mjx.make_data(
        world.model,
        impl="warp",
        naconmax=WARP_WORLDS * cfg.contacts,
        njmax=_ROWS * cfg.contacts + _OTHER_ROWS,
    )
    lost = OverflowType.ALL & ~(
        OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS
    )  # the solver stops early by design
    return MjxPhysics(world, cfg, model, data, functools.partial(_sensed, int(lost)))


def _graph_mode() -> Any:
    """How a step becomes a CUDA graph; None, MJX's choice, on a CPU.

    MJX's choice on CUDA records a graph anew for every set of buffers that XLA hands over, of which
    a training step has many: 1,024 scenes took 3.7 s an action so, 0.52 s with one graph and its
    own buffers (H200, `experiments/bench`).
    """
    if jax.default_backend() != "gpu":
        return None
    from mujoco.mjx.warp import types

    return types.GraphMode.WARP_STAGED


def _sensed(lost: int, world: World, data: mjx.Data) -> tuple[jax.Array, jax.Array]:
    """See `MjxPhysics.touch`; contacts may be missing once one of the arrays ran over that `lost`
    has a bit for."""
    touching = data.sensordata.reshape(len(HAND_GEOMS), len(world.slots)) > 0.0
    return touching, jnp.any((data._impl.overflow & lost) != 0)
