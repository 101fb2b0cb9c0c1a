"""A self-test of this machine: sums that are wrong on some, against other code."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax.sim import reference_check

ROWS = 32_775  # rows beyond 32,768 are those that go wrong


class Check(NamedTuple):
    """One sum: its largest error and how large it may be."""

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


CHECKS: tuple[tuple[str, Callable[[], float], float], ...] = (
    # Bounds are ten times what float32 gives, or more; for products, what a GPU's TF32 gives.
    ("rows of a vmapped matrix product against NumPy", rows_error, 5e-3),
    ("batched Cholesky against NumPy", cholesky_error, 1e-4),
    ("batched MJX against C MuJoCo", reference_check.largest_error, 5e-4),
)


def run() -> list[Check]:
    """Runs every check."""
    return [Check(name, error(), bound) for name, error, bound in CHECKS]
