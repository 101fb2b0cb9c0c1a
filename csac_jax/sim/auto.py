"""What `sim.physics auto` means on this machine: decided once, before a run, whose config names
what it ran on."""

import dataclasses
import importlib.util

import jax

from csac_jax.config import WARP_WORLDS, Config

WARP_SCENES = range(1024, WARP_WORLDS + 1)
"""Scenes at a time, of all runs side by side, at which Warp was measured to be the faster one: an
action of 1,024 scenes of ten blocks takes 0.52 s on Warp, 1.46 s in MJX's own physics, of 4,096
scenes 0.73 s (a busy H200)."""


def resolve(cfg: Config, devices: int = 1, members: int = 1) -> Config:
    """The config with `c`, `warp` or `mjx` in place of `auto`, of so many runs side by side; any
    other as it is.

    C MuJoCo on a CPU, which steps through a scene several times as fast as MJX does there, if one
    device is used. Warp where it was measured to be faster, on one CUDA device, if it is installed
    and can do the scene. MJX else.
    """
    if cfg.sim.physics != "auto":
        return cfg
    c, mjx, warp = (dataclasses.replace(cfg.sim, physics=kind) for kind in ("c", "mjx", "warp"))
    if devices > 1:
        return dataclasses.replace(cfg, sim=mjx)
    if jax.default_backend() == "cpu":
        return dataclasses.replace(cfg, sim=c)
    if members * cfg.train.scenes in WARP_SCENES and _warp_runs_here():
        try:
            return dataclasses.replace(cfg, sim=warp)
        except ValueError:  # the scene is one that Warp cannot do
            pass
    return dataclasses.replace(cfg, sim=mjx)


def _warp_runs_here() -> bool:
    return jax.default_backend() == "gpu" and importlib.util.find_spec("warp") is not None
