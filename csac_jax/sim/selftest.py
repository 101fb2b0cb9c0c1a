"""A self-test of this machine: computations that are wrong on some, against other code."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from csac_jax.sim.quiet_mjx import mjx

ROWS = 32_775  # rows beyond 32,768 are those that go wrong
STEPS = 25  # of falling balls, 0.1 s: each has hit the table, none has come to rest
SCENES = 4
BALL = """<mujoco>
  <option timestep="0.004" solver="Newton" iterations="8" ls_iterations="8"/>
  <worldbody><geom type="plane" size="1 1 0.1"/>
  <body pos="0 0 0.025"><freejoint/><geom type="sphere" size="0.02" mass="0.1"/></body></worldbody>
</mujoco>"""


class Check(NamedTuple):
    """A computation: its largest error and how large it may be."""

    name: str
    error: float
    bound: float

    @property
    def passed(self) -> bool:
        """Returns True if the error is within the bound; NaN is not."""
        return self.error <= self.bound


def rows_error() -> float:
    """Returns the largest relative error of `vmap(sum(M @ row))`, see jax issue 39103."""
    rows = np.random.default_rng(0).uniform(1.0, 2.0, (ROWS, 3)).astype(np.float32)
    matrix = np.array([[1.0, 0.5, 0.25], [2.0, 1.0, 0.5], [0.5, 2.0, 1.0]], np.float32)
    got = jax.jit(jax.vmap(lambda row: jnp.sum(jnp.asarray(matrix) @ row)))(rows)
    wanted = np.sum(rows.astype(np.float64) @ matrix.T, axis=1)
    return float(np.max(np.abs(np.asarray(got) - wanted) / wanted))


def cholesky_error() -> float:
    """Returns the largest error of a batch of 64 Choleskys of 66 x 66, as MJX has them."""
    factors = np.random.default_rng(0).normal(size=(64, 66, 66))
    matrices = factors @ factors.transpose(0, 2, 1) / 66 + np.eye(66)
    got = jax.jit(jnp.linalg.cholesky)(matrices.astype(np.float32))
    return float(np.max(np.abs(np.asarray(got) - np.linalg.cholesky(matrices))))


def falling_balls_error() -> float:
    """Returns the largest difference of MJX and C MuJoCo in a coordinate after STEPS, m or 1."""
    model = mujoco.MjModel.from_xml_string(BALL)
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


CHECKS: tuple[tuple[str, Callable[[], float], float], ...] = (
    # Bounds are ten times what float32 gives, or more; for products, what a GPU's TF32 gives.
    ("rows of a vmapped matrix product against NumPy", rows_error, 5e-3),
    ("batched Cholesky against NumPy", cholesky_error, 1e-4),
    ("batched MJX against C MuJoCo", falling_balls_error, 5e-4),
)


def run() -> list[Check]:
    """Runs every check."""
    return [Check(name, error(), bound) for name, error, bound in CHECKS]
