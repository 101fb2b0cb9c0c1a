"""Resolves a config's physics and gripper for this machine, before a run."""

import contextlib
import importlib.util

import jax

from csac_jax import grippers
from csac_jax.config import Config, PhysicsKind

WARP_SCENES = 1024  # scenes at a time, over all runs, from which Warp is faster (measured)


def resolve(cfg: Config, devices: int = 1, runs: int = 1) -> Config:
    """Replaces physics `auto` by `c`, `warp` or `mjx`, and the folder of a gripper by its numbers.

    A single CPU device takes C MuJoCo, several times as fast as MJX. A single CUDA device takes
    Warp for WARP_SCENES or more, of `runs` configs that share a program, if it is installed and can
    do the scene. Otherwise MJX, with objects C. Raises SettingsError for a folder without gripper.
    """
    if (gripper := grippers.resolve(cfg.sim.gripper)) != cfg.sim.gripper:
        cfg = cfg.change(sim={"gripper": gripper})
    if cfg.sim.physics != "auto":
        return cfg
    others: PhysicsKind = "c" if cfg.scene.has_objects else "mjx"
    platform = jax.default_backend() if devices == 1 else None
    if platform == "cpu":
        return cfg.change(sim={"physics": "c"})
    faster_on_warp = platform == "gpu" and runs * cfg.train.scenes >= WARP_SCENES
    if faster_on_warp and importlib.util.find_spec("warp"):
        with contextlib.suppress(ValueError):  # the config refuses scenes that Warp cannot do
            return cfg.change(sim={"physics": "warp"})
    return cfg.change(sim={"physics": others})
