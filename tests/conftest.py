"""Strict JAX in every test."""

import contextlib
import os
from collections.abc import Iterator

import pytest

os.environ.setdefault(
    "JAX_ENABLE_COMPILATION_CACHE", "0"
)  # tests compile what they test, their own processes too

import csac_jax  # noqa: F401  (before JAX: it sets up the thread pool)

import jax  # isort: skip


@pytest.fixture(autouse=True)
def strict_jax(request: pytest.FixtureRequest) -> Iterator[None]:
    """Silent broadcasting, promotion and key reuse are errors, except through the code of MJX and
    optax."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(jax.debug_key_reuse(True))
        if not request.node.get_closest_marker("mjx"):
            stack.enter_context(jax.numpy_rank_promotion("raise"))
            if not request.node.get_closest_marker("optax"):
                stack.enter_context(jax.numpy_dtype_promotion("strict"))
        yield
