"""The physics that `sim.physics auto` stands for on this machine, chosen before a run."""

import contextlib
import importlib.util

import jax

from csac_jax.config import Config, PhysicsKind

WARP_SCENES = 1024
"""Scenes at a time, of all runs, from which Warp was measured to be faster."""


def resolve(cfg: Config, devices: int = 1, runs: int = 1) -> Config:
    """The config with `c`, `warp` or `mjx` in place of `auto`; any other choice stays.

    `runs` configs of this kind share one program. C MuJoCo serves a single CPU device, where it
    is several times as fast as MJX. Warp serves a single CUDA device where it was measured to be
    faster, is installed and can do the scene. The rest goes to MJX, with objects to C.
    """
    if cfg.sim.physics != "auto":
        return cfg
    others: PhysicsKind = "c" if cfg.scene.has_objects else "mjx"
    platform = jax.default_backend() if devices == 1 else None
    if platform == "cpu":
        return cfg.change(sim={"physics": "c"})
    faster_on_warp = platform == "gpu" and runs * cfg.train.scenes >= WARP_SCENES
    if faster_on_warp and importlib.util.find_spec("warp") is not None:
        with contextlib.suppress(ValueError):  # the config refuses scenes that Warp cannot do
            return cfg.change(sim={"physics": "warp"})
    return cfg.change(sim={"physics": others})
