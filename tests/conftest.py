"""Strict JAX in every test, and one cache of programs for the session."""

import atexit
import contextlib
import gc
import os
import shutil
import tempfile
from collections.abc import Iterator
from typing import Any

import pytest

if "PYTEST_XDIST_WORKER" not in os.environ:
    # What this session compiles, its workers and their processes compile once. JAX finds a program
    # by all that it is made of: a test of another program than before has it compiled.
    folder = tempfile.mkdtemp(prefix="csac-jax-programs-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
    os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"] = str(2**32)  # with a limit, JAX locks the folder
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # else XLA logs a line for each one found

import csac_jax  # noqa: F401  (before JAX: it sets up the thread pool)

import jax  # isort: skip

from csac_jax import presets
from csac_jax.io import policy_file
from tests.networks import random_params

gc.set_threshold(100_000, 20, 100)  # to trace makes many objects that live; 700 collects too often


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


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Writes a policy that grasps and takes no time, for tests that need any; returns its file."""
    grasps: Any = {"policy": {"primitive": "grasp"}, "explore": {"push_fraction": 0.0}}
    cfg, path = presets.smoke().change(**grasps), tmp_path_factory.mktemp("policies") / "tiny"
    policy_file.save(path.with_suffix(".safetensors"), random_params(cfg), cfg)
    return str(path.with_suffix(".safetensors"))
