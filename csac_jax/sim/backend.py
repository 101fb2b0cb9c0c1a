"""The physics that `sim.physics auto` stands for on this machine, chosen before a run."""

import contextlib
import dataclasses
import importlib.util

import jax

from csac_jax.config import WARP_WORLDS, Config, PhysicsKind

WARP_SCENES = range(1024, WARP_WORLDS + 1)
"""Scenes at a time, of all runs, at which Warp was measured to be faster.

An action of 1,024 scenes of ten blocks takes 0.52 s on Warp and 1.46 s in MJX's own physics. An
action of 4,096 scenes takes 0.73 s on Warp (a busy H200)."""


def resolve(cfg: Config, devices: int = 1, runs: int = 1) -> Config:
    """The config with `c`, `warp` or `mjx` in place of `auto`; any other choice stays.

    `runs` configs of this kind share one program. C MuJoCo serves a single CPU device, where it
    is several times as fast as MJX. Warp serves a single CUDA device where it was measured to be
    faster, is installed and can do the scene. MJX serves the rest.
    """
    if cfg.sim.physics != "auto":
        return cfg
    if devices == 1 and jax.default_backend() == "cpu":
        return _with_physics(cfg, "c")
    if devices == 1 and runs * cfg.train.scenes in WARP_SCENES and _warp_runs_here():
        with contextlib.suppress(ValueError):  # the config refuses scenes that Warp cannot do
            return _with_physics(cfg, "warp")
    return _with_physics(cfg, "mjx")


def _with_physics(cfg: Config, kind: PhysicsKind) -> Config:
    return dataclasses.replace(cfg, sim=dataclasses.replace(cfg.sim, physics=kind))


def _warp_runs_here() -> bool:
    return jax.default_backend() == "gpu" and importlib.util.find_spec("warp") is not None
