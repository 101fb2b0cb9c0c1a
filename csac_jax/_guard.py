"""Protection against faults of JAX, before JAX is imported.

1. jax 0.10.2 computes wrong rows for `vmap(M @ row)` followed by a reduction (jax issue 39103).
2. So do 0.10.1 and earlier in a plainer case: with M 3 x 3, `vmap(sum(M @ row))` is wrong in every
   row beyond the 32,768th, up to some 40,000 rows. An XLA flag switches that fusion off.
3. Batched MJX runs many batched Cholesky factorisations. In jaxlib 0.10 they wait for one another
   in the thread pool and hang for ever if it is small. A larger pool cures it at no cost. Its size
   is read once, when the CPU client starts. Virtual devices (`DEVICES_FLAG`) share one pool.
4. jaxlib 0.11 ends the process as it compiles a `shard_map` with a constant of no elements, and
   MJX's models have many. The fault is Shardy's; the partitioner before it compiles them.
"""

import importlib.metadata
import os
import re
import sys

BROKEN_JAX = ("0.10.2",)
# Given no types, the flag switches that kind of fusion off. XLA ends the process on a flag that it
# does not know, so only versions of jaxlib that are known to have it get it.
FUSION_FLAG = "--xla_cpu_experimental_ynn_fusion_type"
FUSION_SERIES = "0.10."
POOL_VARIABLE = "PJRT_NPROC"  # goes before NPROC
USER_VARIABLES = (POOL_VARIABLE, "NPROC")  # what a user may have set
MIN_THREADS = 8  # ours: 2 hangs and 8 does not, on 2 cores with batches of 4 and 8 scenes
DEVICES_FLAG = "--xla_force_host_platform_device_count"
DEVICE_THREADS = 4  # ours, per virtual device: eight that train together hang with 8, not with 32
PARTITIONER_VARIABLE = "JAX_USE_SHARDY_PARTITIONER"
PARTITIONER_SERIES = "0.11."  # versions of jaxlib whose Shardy is seen to end the process


def refuse_broken_jax() -> None:
    """Raises ImportError if the installed JAX is known to compute wrong numbers."""
    version = importlib.metadata.version("jax")
    if version in BROKEN_JAX:
        raise ImportError(
            f"jax {version} computes wrong results on the CPU (jax issue 39103); "
            f"run: pip install 'jax!={version}'"
        )


def switch_off_broken_fusion() -> None:
    """Adds the flag to XLA's, unless it is there or this jaxlib may not know it."""
    flags = os.environ.get("XLA_FLAGS", "")
    if importlib.metadata.version("jaxlib").startswith(FUSION_SERIES) and FUSION_FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {FUSION_FLAG}=".lstrip()


def switch_off_broken_partitioner() -> None:
    """Selects the partitioner before Shardy, unless the user has chosen."""
    broken = importlib.metadata.version("jaxlib").startswith(PARTITIONER_SERIES)
    if broken and PARTITIONER_VARIABLE not in os.environ:
        os.environ[PARTITIONER_VARIABLE] = "false"
        if "jax" in sys.modules:  # it has read the variable already
            sys.modules["jax"].config.update(PARTITIONER_VARIABLE.lower(), False)


def widen_thread_pool() -> None:
    """Sets the pool's size to at least `needed_threads`, unless the user has chosen one."""
    if not any(name in os.environ for name in USER_VARIABLES):
        os.environ[POOL_VARIABLE] = str(max(needed_threads(), os.cpu_count() or 1))


def needed_threads() -> int:
    """Returns the threads that batched MJX needs, by the number of XLA's virtual devices."""
    counts = re.findall(rf"{DEVICES_FLAG}=(\d+)", os.environ.get("XLA_FLAGS", "")) or ["1"]
    return max(MIN_THREADS, DEVICE_THREADS * int(counts[-1]))


def pool_setting() -> tuple[str, int]:
    """Returns the variable that decides the size of the pool, and its value."""
    for name in USER_VARIABLES:
        if os.environ.get(name, "").isdigit():
            return name, int(os.environ[name])
    return "number of cores", os.cpu_count() or 1
