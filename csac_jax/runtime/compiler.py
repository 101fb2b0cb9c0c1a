"""How a training program is traced, and which options XLA compiles it with.

On a CPU, XLA has a second library for convolutions, about twice as fast as Eigen at those of the
small net. It differs between versions of jaxlib, and is used only where it is seen to be right.
LLVM's second level of optimisation compiles sooner than the third, to as fast a program. So do
XLA's former emitters of kernels, where it still has them: its new ones build an MLIR module for
each of more than a thousand kernels. Functions are as exact with them. What `XLA_FLAGS` says of
either stays.

On a GPU, XLA would write and time many kernels of its own for each matrix product of DenseNet-121.
That takes half of the compilation, and the vendor's library is as fast (`experiments/bench`).
"""

import functools
import gc
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from csac_jax import _guard
from csac_jax.config import Config, SmallNet
from csac_jax.nets.convolution import conv2d

LIBRARY = {_guard.FUSION_FLAG.lstrip("-"): "LIBRARY_FUSION_TYPE_INDIVIDUAL_CONVOLUTION"}
SOONER = {"xla_backend_optimization_level": 2, "xla_cpu_use_fusion_emitters": False}
VENDOR = {"xla_gpu_enable_triton_gemm": False}
_BOUND = 1e-4  # largest error of a sum of 360 products of numbers near 1; float32 gives some 1e-5


def lower(jitted: Any, *given: Any) -> Any:
    """`jitted.lower(*given)` without Python's garbage collector: a quarter faster, as tracing makes
    hundreds of thousands of small objects and next to no garbage."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        return jitted.lower(*given)
    finally:
        if was_on:
            gc.enable()


def options(cfg: Config) -> dict[str, Any] | None:
    """Options of `jax.jit` for the config's training program, None for the defaults.

    The second library is slow at kernel gradients, which `conv2d` keeps from it.
    """
    if jax.default_backend() == "cpu":
        chosen = os.environ.get("XLA_FLAGS", "")
        sooner = {name: SOONER[name] for name in SOONER if f"--{name}=" not in chosen}
        known = {name: value for name, value in sooner.items() if knows(name, value)}
        return known | (LIBRARY if isinstance(cfg.net, SmallNet) and has_library() else {})
    vendor = jax.default_backend() == "gpu" and not isinstance(cfg.net, SmallNet)
    return dict(VENDOR) if vendor and all(map(knows, VENDOR, VENDOR.values())) else None


@functools.cache
def knows(name: str, value: Any) -> bool:
    """Whether this XLA has such an option."""
    try:
        jax.jit(jnp.negative, compiler_options={name: value}).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


@functools.cache
def has_library() -> bool:
    """Whether this is a CPU whose XLA knows the library and computes a small convolution right."""
    if jax.default_backend() != "cpu":
        return False
    rng = np.random.default_rng(0)
    shapes = ((1, 8, 8, 40), (3, 3, 40, 24))
    maps, kernel = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    try:
        program = jax.jit(lambda m, k: conv2d(m, k, 1, 1, 1), compiler_options=LIBRARY)
        got = np.asarray(program(maps, kernel))
    except jax.errors.JaxRuntimeError:
        return False
    padded = np.pad(maps.astype(np.float64), ((0, 0), (1, 1), (1, 1), (0, 0)))
    wanted = sum(padded[:, i : i + 8, j : j + 8] @ kernel[i, j] for i in range(3) for j in range(3))
    return bool(np.max(np.abs(got - wanted)) < _BOUND)
