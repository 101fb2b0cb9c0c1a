"""Functions of the host in compiled programs: values, errors, and programs from the cache."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.runtime import host_call

ROOT = Path(host_call.__file__).parents[2]
RESULT = {
    "y": jnp.zeros(3),
    "count": jnp.zeros((), jnp.int32),
    "positive": jnp.zeros((), bool),
    "none": jnp.zeros((0, 2)),
}


def _function(inputs: dict[str, Any], number: Any) -> dict[str, Any]:
    """Computes some result of a batch of any shape."""
    x, axes = inputs["x"], np.shape(number)
    return {
        "y": np.sin(x) + number[..., None],
        "count": np.full(axes, x.shape[-1], np.int32),
        "positive": number > 0.0,
        "none": np.zeros((*axes, 0, 2), np.float32),
    }


def _ours(x: jax.Array) -> Any:
    return host_call.call(_function, "test", RESULT, {"x": x}, x[0])


def _theirs(x: jax.Array) -> Any:
    return jax.pure_callback(_function, RESULT, {"x": x}, x[0], vmap_method="broadcast_all")


@pytest.mark.parametrize("shape", [(3,), (4, 3), (2, 5, 3)], ids=str)
def test_call_is_that_of_jax(shape: tuple[int, ...]):
    """Claim: results are those of `jax.pure_callback`, of one call, of a batch and of a scan, for
    all types and an array without elements."""
    x = jnp.linspace(-1.0, 1.0, int(np.prod(shape))).reshape(shape)
    results = []
    for call in (_ours, _theirs):
        for _ in shape[1:]:
            call = jax.vmap(call)
        body = lambda c, _, call=call: (call(c)["y"], call(c))  # noqa: E731
        results.append(jax.jit(lambda x, body=body: jax.lax.scan(body, x, length=3))(x))
    jax.tree.map(np.testing.assert_array_equal, *results)


@pytest.mark.parametrize(
    ("result", "error"),
    [(np.zeros(2, np.float32), "ValueError: a result has the shape"), (None, "KeyError: 'lost'")],
)
def test_error_of_the_function_is_raised(result: np.ndarray | None, error: str):
    """Claim: what the function raises, or returns in a wrong shape, is an error of the program that
    says so; the process continues."""

    def function(x: np.ndarray) -> np.ndarray:
        if result is None:
            raise KeyError("lost")
        return result

    called = jax.jit(lambda x: host_call.call(function, f"bad {error}", x, x))
    with pytest.raises(jax.errors.JaxRuntimeError, match=error):
        jax.block_until_ready(called(jnp.zeros(3)))
    assert _ours(jnp.zeros(3))["count"] == 3


PROGRAM = """
import csac_jax, jax, numpy as np, sys
from csac_jax.runtime import cache, host_call
cache.enable()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
factor = float(sys.argv[1])
called = jax.jit(lambda x: host_call.call(lambda x: factor * x, "key", x, x))
x = np.arange(3, dtype=np.float32)
program = called.lower(x).compile()
before = cache.hits()
print(before, *program(x).tolist())
"""


def test_second_process_finds_the_program(tmp_path: Path):
    """Claim: a program that calls the host is taken from the cache by the next process, and calls
    that process's function."""
    settings = {"XDG_CACHE_HOME": str(tmp_path), "JAX_COMPILATION_CACHE_DIR": ""}
    command = [sys.executable, "-W", "ignore", "-c", PROGRAM]
    pipes: Any = {"env": {**os.environ, **settings}, "cwd": ROOT, "timeout": 120}
    first, second = (
        subprocess.check_output([*command, factor], text=True, **pipes) for factor in "23"
    )
    assert first.split() == ["0", "0.0", "2.0", "4.0"]
    assert second.split() == ["1", "0.0", "3.0", "6.0"]
