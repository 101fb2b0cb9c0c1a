"""Protection against faults of JAX; imports nothing of JAX, so that it acts before JAX starts.

1. jax 0.10.2 computes wrong rows for `vmap(M @ row)` followed by a reduction (jax issue 39103), without a word.
2. So do 0.10.1 and earlier, in the plainer case: with M 3 x 3, `vmap(sum(M @ row))` is wrong in every row beyond the
   32,768th, up to some 40,000 rows. The fault lies in a fusion, which an XLA flag switches off.
3. Batched Cholesky factorisations, which batched MJX runs many of, wait for one another in the thread pool of
   jaxlib 0.10 and hang for ever if the pool is small: on 2 cores, two at once are enough. A pool with more threads
   than factorisations at once cures it and costs no speed. Its size is read from the environment, once, when the CPU
   client starts. Virtual devices (`DEVICES_FLAG`) share one pool and wait for one another in it.
4. jaxlib 0.11 ends the process with a segmentation fault as it compiles a `shard_map` that takes along a constant with
   no elements, and MJX's models have many: a pattern of Shardy, its default partitioner, seen on CPU devices; programs
   on several GPUs ended alike. The partitioner before Shardy compiles it.
"""

import importlib.metadata
import os
import re
import sys

BROKEN_JAX = ("0.10.2",)
FUSION_FLAG = (
    "--xla_cpu_experimental_ynn_fusion_type"  # given no types, it switches that kind of fusion off
)
FUSION_SERIES = "0.10."  # versions of jaxlib that are known to have the flag: XLA ends the process on one it lacks
POOL_VARIABLE = "PJRT_NPROC"  # goes before NPROC
USER_VARIABLES = (POOL_VARIABLE, "NPROC")  # what a user may have set
MIN_THREADS = 8  # ours: 2 hangs and 8 does not, on 2 cores with batches of 4 and 8 scenes
DEVICES_FLAG = "--xla_force_host_platform_device_count"
DEVICE_THREADS = 4  # ours, per virtual device: of eight that train together, 8 threads in all hung and 32 did not
PARTITIONER_VARIABLE = "JAX_USE_SHARDY_PARTITIONER"
PARTITIONER_SERIES = "0.11."  # versions of jaxlib whose Shardy is seen to end the process


def refuse_broken_jax() -> None:
    """Raises ImportError if the installed JAX is known to compute wrong numbers."""
    version = importlib.metadata.version("jax")
    if version in BROKEN_JAX:
        raise ImportError(
            f"jax {version} computes wrong results on the CPU (jax issue 39103); run: pip install 'jax!={version}'"
        )


def switch_off_broken_fusion() -> None:
    """Adds the flag to XLA's, unless the user has given it or this jaxlib may not know it."""
    flags = os.environ.get("XLA_FLAGS", "")
    if importlib.metadata.version("jaxlib").startswith(FUSION_SERIES) and FUSION_FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {FUSION_FLAG}=".lstrip()


def switch_off_broken_partitioner() -> None:
    """Has this jaxlib partition programs without Shardy, unless the user has chosen.

    A JAX that is imported already has read the variable, and is told.
    """
    if (
        not importlib.metadata.version("jaxlib").startswith(PARTITIONER_SERIES)
        or PARTITIONER_VARIABLE in os.environ
    ):
        return
    os.environ[PARTITIONER_VARIABLE] = "false"
    if "jax" in sys.modules:
        sys.modules["jax"].config.update(PARTITIONER_VARIABLE.lower(), False)


def widen_thread_pool() -> None:
    """Sets the pool's size to at least `needed_threads`, unless the user has chosen one."""
    if not any(name in os.environ for name in USER_VARIABLES):
        os.environ[POOL_VARIABLE] = str(max(needed_threads(), os.cpu_count() or 1))


def needed_threads() -> int:
    """Threads in the pool without which batched MJX may hang, by the virtual devices that XLA is
    told to make."""
    counts = re.findall(rf"{DEVICES_FLAG}=(\d+)", os.environ.get("XLA_FLAGS", "")) or ["1"]
    return max(MIN_THREADS, DEVICE_THREADS * int(counts[-1]))


def pool_setting() -> tuple[str, int]:
    """The variable that decides the size of the pool and its value, as JAX will read them."""
    for name in USER_VARIABLES:
        if os.environ.get(name, "").isdigit():
            return name, int(os.environ[name])
    return "number of cores", os.cpu_count() or 1
