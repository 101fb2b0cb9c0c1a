"""Tracing of training programs, and the options that XLA compiles them with.

On a CPU, XLA has a second library for convolutions, about twice as fast as Eigen at those of the
small net. It is used only where it is seen to be right. LLVM's second level of optimisation
compiles sooner than the third, to as fast a program. So do XLA's former emitters of kernels: the
new ones build an MLIR module for each of a thousand kernels. Choices in `XLA_FLAGS` stay.

On a GPU, XLA would time many kernels of its own for each matrix product of DenseNet-121. That takes
half of the compilation, and the vendor's library is as fast (`experiments/bench`).
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

LIBRARY = {_guard.FUSION_FLAG.lstrip("-"): "LIBRARY_FUSION_TYPE_INDIVIDUAL_CONVOLUTION"}
SOONER = {"xla_backend_optimization_level": 2, "xla_cpu_use_fusion_emitters": False}
SOONEST = SOONER | {"xla_backend_optimization_level": 0}  # the program is slower by half
VENDOR = {"xla_gpu_enable_triton_gemm": False}
_BOUND = 1e-4  # largest error of a sum of 360 products of numbers near 1; float32 gives some 1e-5


def lower(jitted: Any, *inputs: Any) -> Any:
    """Lowers a jitted function without Python's garbage collector, which is a quarter faster."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        return jitted.lower(*inputs)
    finally:
        if was_on:
            gc.enable()


def options(cfg: Config, brief: bool = False) -> dict[str, Any] | None:
    """Returns the options of `jax.jit` for the config's training program; None for the defaults.

    The second library is slow at kernel gradients, which `nets.convolution` keeps from it. Args:
    brief, the program takes less time than to compile it.
    """
    small, backend = isinstance(cfg.net, SmallNet), jax.default_backend()
    if backend == "cpu":
        flags, wanted = os.environ.get("XLA_FLAGS", ""), SOONEST if brief else SOONER
        sooner = {k: v for k, v in wanted.items() if f"--{k}=" not in flags and knows(k, v)}
        return sooner | (LIBRARY if small and has_library() else {})
    vendor = backend == "gpu" and not small and all(map(knows, VENDOR, VENDOR.values()))
    return dict(VENDOR) if vendor else None


@functools.cache
def knows(name: str, value: Any) -> bool:
    """Returns True if this XLA has such an option."""
    try:
        jax.jit(jnp.negative, compiler_options={name: value}).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


@functools.cache
def has_library() -> bool:
    """Returns True on a CPU whose XLA has the library and computes a small convolution right."""
    if jax.default_backend() != "cpu":
        return False
    rng = np.random.default_rng(0)
    shapes = ((1, 8, 8, 40), (3, 3, 40, 24))
    maps, kernel = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    try:
        got = np.asarray(jax.jit(_convolve, compiler_options=LIBRARY)(maps, kernel))
    except jax.errors.JaxRuntimeError:
        return False
    padded = np.pad(maps.astype(np.float64), ((0, 0), (1, 1), (1, 1), (0, 0)))
    wanted = sum(padded[:, i : i + 8, j : j + 8] @ kernel[i, j] for i in range(3) for j in range(3))
    return bool(np.max(np.abs(got - wanted)) < _BOUND)


def _convolve(maps: jax.Array, kernel: jax.Array) -> jax.Array:
    layout = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(maps, kernel, (1, 1), "SAME", dimension_numbers=layout)
