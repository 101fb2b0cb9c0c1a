"""Whether this machine computes right: sums that go wrong somewhere, against other code."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.sim import reference_check as physics

ROWS = 32_775  # rows beyond 32,768 are those that go wrong


class Check(NamedTuple):
    """One sum: its largest error and how large it may be."""

    name: str
    error: float
    bound: float

    @property
    def passed(self) -> bool:
        """Whether the error is within the bound; NaN is not."""
        return self.error <= self.bound


def rows_error() -> float:
    """Largest relative error of `vmap(sum(M @ row))`, the plain case of jax issue 39103."""
    rows = np.random.default_rng(0).uniform(1.0, 2.0, (ROWS, 3)).astype(np.float32)
    matrix = np.array([[1.0, 0.5, 0.25], [2.0, 1.0, 0.5], [0.5, 2.0, 1.0]], np.float32)
    got = jax.jit(jax.vmap(lambda row: jnp.sum(jnp.asarray(matrix) @ row)))(rows)
    wanted = np.sum(rows.astype(np.float64) @ matrix.T, axis=1)
    return float(np.max(np.abs(np.asarray(got) - wanted) / wanted))


def cholesky_error() -> float:
    """Largest error of 64 Choleskys of 66 x 66 in one batch, as MJX has them, against NumPy."""
    factors = np.random.default_rng(0).normal(size=(64, 66, 66))
    matrices = factors @ factors.transpose(0, 2, 1) / 66 + np.eye(66)
    got = jax.jit(jnp.linalg.cholesky)(matrices.astype(np.float32))
    return float(np.max(np.abs(np.asarray(got) - np.linalg.cholesky(matrices))))


CHECKS: tuple[tuple[str, Callable[[], float], float], ...] = (
    # Bounds are ten times what float32 gives, or more; for products, what a GPU's TF32 gives.
    ("rows of a vmapped matrix product against NumPy", rows_error, 5e-3),
    ("batched Cholesky against NumPy", cholesky_error, 1e-4),
    ("batched MJX against C MuJoCo", physics.largest_error, 5e-4),
)


def run() -> list[Check]:
    """Every check, in turn."""
    return [Check(name, error(), bound) for name, error, bound in CHECKS]
