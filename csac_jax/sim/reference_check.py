"""Compares MJX with C MuJoCo on this machine: balls fall on a table in a few scenes."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from csac_jax.sim.quiet_mjx import mjx

STEPS = 25  # 0.1 s: each ball has hit the table, none has come to rest
SCENES = 4
MODEL = """
<mujoco>
  <option timestep="0.004" solver="Newton" iterations="8" ls_iterations="8"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.025"><freejoint/><geom type="sphere" size="0.02" mass="0.1"/></body>
  </worldbody>
</mujoco>
"""


def largest_error() -> float:
    """Returns the largest difference of a coordinate after STEPS steps, over all scenes, m or 1."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    qpos = np.tile(model.qpos0, (SCENES, 1))
    qpos[:, 2] += 0.01 * np.arange(SCENES)  # another height in each scene
    rest = np.pad(qpos, ((0, 0), (1, model.nv)))  # MuJoCo's states: time, positions, speeds
    states, _ = rollout.rollout(model, mujoco.MjData(model), rest, nstep=STEPS)
    put, blank = mjx.put_model(model), mjx.make_data(model)

    def fall(start: jax.Array) -> jax.Array:
        first = blank.replace(qpos=start)
        return jax.lax.fori_loop(0, STEPS, lambda _, data: mjx.step(put, data), first).qpos

    by_mjx = np.asarray(jax.vmap(fall)(jnp.asarray(qpos, jnp.float32)))
    return float(np.abs(by_mjx - states[:, -1, 1 : 1 + model.nq]).max())
