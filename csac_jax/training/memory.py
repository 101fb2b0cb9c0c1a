"""Memory of a run: that of its state is known before anything is compiled."""

import math
import os
from typing import Any

import jax

from csac_jax.config import Config
from csac_jax.errors import SettingsError
from csac_jax.replay import ring
from csac_jax.training import programs, split_step

GIB = 2**30


def limit() -> int:
    """Returns all bytes of the first device; this machine's memory if it states none (CPUs)."""
    stats = jax.devices()[0].memory_stats() or {}
    return stats.get("bytes_limit") or os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def state_bytes(cfg: Config) -> dict[str, int]:
    """Returns the bytes of a run's state by part; tracing the networks takes seconds."""
    state = programs.abstract_state(cfg)
    parts = {"replay": state.replay, "scenes": state.scenes, "networks": state.learner}
    return {name: tree_bytes(part) for name, part in parts.items()}


def tree_bytes(tree: Any) -> int:
    """Returns the bytes of all leaves."""
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def check(cfg: Config, runs: int = 1) -> None:
    """Raises SettingsError if a device cannot hold the rings of `runs` runs side by side."""
    available, slot = limit(), ring.bytes_needed(1, programs.example(cfg))
    needed, capacity = runs * cfg.replay.capacity * slot, available // (runs * slot)
    if needed <= available:
        return
    taken = f"the replay takes {needed / GIB:.1f} GiB, there are {available / GIB:.1f}"
    remedy = f"lower replay.capacity from {cfg.replay.capacity} to {capacity} at most"
    if capacity < max(cfg.train.scenes, cfg.learn.batch):
        remedy = "lower heightmap.size"
    if runs > 1:
        taken = f"{taken}, enough for {available // (needed // runs)} of {runs} runs side by side"
        remedy = f"{remedy}, lower seeds, set together or raise devices"
    raise SettingsError(f"replay.capacity: {taken}; {remedy}")


def compiled_text(compiled: Any) -> str:
    """Describes the memory of a compiled chunk, by XLA's own numbers."""
    acts = compiled.act if isinstance(compiled, split_step.Chunk) else compiled
    stats = acts.memory_analysis()
    state, temporary = stats.argument_size_in_bytes / GIB, stats.temp_size_in_bytes / GIB
    rest = f" and {temporary:.2f} GiB besides" if acts is compiled else "; learning still compiles"
    return f"the program takes {state:.2f} GiB for states{rest}"
