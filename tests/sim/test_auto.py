"""`sim.physics auto`: what it stands for, whatever this machine has."""

import dataclasses

import pytest

from csac_jax import presets
from csac_jax.config import Config, PhysicsKind
from csac_jax.sim import auto, physics


def _config(kind: PhysicsKind, mesh_size_jitter: float = 0.0, scenes: int = 256) -> Config:
    fast = presets.fast()
    return dataclasses.replace(
        fast,
        scene=dataclasses.replace(fast.scene, mesh_size_jitter=mesh_size_jitter),
        sim=dataclasses.replace(fast.sim, physics=kind),
        train=dataclasses.replace(fast.train, scenes=scenes),
    )


def test_fast_runs_on_warp(monkeypatch: pytest.MonkeyPatch):
    """Claim: where Warp is installed, `fast` runs on it on a GPU, else in MJX's own physics."""
    monkeypatch.setattr(auto.jax, "default_backend", lambda: "gpu")
    for installed, chosen in ((True, "warp"), (False, "mjx")):
        monkeypatch.setattr(
            auto.importlib.util,
            "find_spec",
            lambda name, there=installed: object() if there else None,
        )
        assert auto.resolve(presets.fast()).sim.physics == chosen


@pytest.mark.parametrize(
    ("backend", "installed", "measured", "mesh_size_jitter", "scenes", "chosen"),
    [
        ("gpu", True, range(64, 5001), 0.0, 256, "warp"),
        ("cpu", True, range(64, 5001), 0.0, 256, "c"),
        ("gpu", False, range(64, 5001), 0.0, 256, "mjx"),
        ("gpu", True, range(64, 5001), 0.1, 256, "mjx"),
        ("gpu", True, range(64, 5001), 0.0, 32, "mjx"),
        ("gpu", True, range(64, 5001), 0.0, 5000, "mjx"),
        ("gpu", True, range(0), 0.0, 256, "mjx"),
    ],
)
def test_choice(
    monkeypatch: pytest.MonkeyPatch, backend, installed, measured, mesh_size_jitter, scenes, chosen
):
    """Claim: `auto` is `c` on a CPU, `warp` where measured to be faster, on CUDA, installed, able
    to do the scene; else `mjx`, also on several devices."""
    monkeypatch.setattr(auto.jax, "default_backend", lambda: backend)
    monkeypatch.setattr(
        auto.importlib.util, "find_spec", lambda name: object() if installed else None
    )
    monkeypatch.setattr(auto, "WARP_SCENES", measured)
    cfg = _config("auto", mesh_size_jitter, scenes)
    assert auto.resolve(cfg) == dataclasses.replace(
        cfg, sim=dataclasses.replace(cfg.sim, physics=chosen)
    )
    assert auto.resolve(cfg, 2).sim.physics == "mjx"
    if chosen == "warp":
        assert auto.resolve(cfg, 1, 5000 // scenes).sim.physics == "warp"
        assert auto.resolve(cfg, 1, 5001 // scenes + 1).sim.physics == "mjx"


def test_other_choices_stay():
    """Claim: what the user has chosen stays."""
    for kind in ("mjx", "warp", "c"):
        assert auto.resolve(_config(kind)) == _config(kind)


def test_auto_is_no_engine():
    """Claim: `auto` that nobody resolved is an error that says what to do, not the physics of some
    engine."""
    with pytest.raises(ValueError, match=r"sim\.physics: 'auto' .* mjx, warp or c"):
        physics.make(None, _config("auto").sim)
