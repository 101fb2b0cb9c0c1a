"""`sim.physics auto`: what it stands for, whatever this machine has."""

import subprocess
import sys
import typing

import pytest

from csac_jax import presets
from csac_jax.config import Config, PhysicsKind
from csac_jax.sim import backend, physics


def _config(kind: PhysicsKind, mesh_jitter: float = 0.0, scenes: int = 256) -> Config:
    fast = presets.fast()
    jitter = (fast.scene.size_jitter[0], mesh_jitter)
    return fast.change(
        scene={"size_jitter": jitter}, sim={"physics": kind}, train={"scenes": scenes}
    )


def _machine(patch: pytest.MonkeyPatch, platform: str, has_warp: bool) -> None:
    patch.setattr(backend.jax, "default_backend", lambda: platform)
    spec = object() if has_warp else None
    patch.setattr(backend.importlib.util, "find_spec", lambda name: spec)


@pytest.mark.parametrize(
    ("platform", "installed", "measured", "mesh_jitter", "scenes", "chosen"),
    [
        ("gpu", True, 256, 0.0, 256, "warp"),
        ("cpu", True, 64, 0.0, 256, "c"),
        ("gpu", False, 64, 0.0, 256, "mjx"),
        ("gpu", True, 64, 0.1, 256, "mjx"),
        ("gpu", True, 257, 0.0, 256, "mjx"),
    ],
)
def test_choice(
    monkeypatch: pytest.MonkeyPatch, platform, installed, measured, mesh_jitter, scenes, chosen
):
    """Claim: `auto` is `c` on a CPU; `warp` if faster, on CUDA, installed and able; else `mjx`."""
    _machine(monkeypatch, platform, installed)
    monkeypatch.setattr(backend, "WARP_SCENES", measured)
    cfg = _config("auto", mesh_jitter, scenes)
    assert backend.resolve(cfg) == cfg.change(sim={"physics": chosen})
    assert backend.resolve(cfg, 2).sim.physics == "mjx"
    if (platform, installed, mesh_jitter) == ("gpu", True, 0.0):
        assert backend.resolve(cfg, 1, 2).sim.physics == "warp"


@pytest.mark.parametrize(
    ("platform", "scenes", "chosen"), [("gpu", 1024, "warp"), ("gpu", 8, "c"), ("cpu", 1024, "c")]
)
def test_choice_for_objects(monkeypatch: pytest.MonkeyPatch, platform, scenes, chosen):
    """Claim: objects are on Warp in many scenes on one GPU, else in C MuJoCo; never in MJX."""
    _machine(monkeypatch, platform, has_warp=True)
    cfg = presets.get("objects").change(train={"scenes": scenes}, replay={"capacity": 2048})
    assert backend.resolve(cfg).sim.physics == chosen
    assert backend.resolve(cfg, 2).sim.physics == "c"
    with pytest.raises(ValueError, match=r"sim\.physics: objects .* need c, warp or auto"):
        cfg.change(sim={"physics": "mjx"})


def test_other_choices_stay():
    """Claim: what the user has chosen stays; `auto` that nobody resolved is refused by its name;
    every physics of the config has its entry."""
    assert {*physics.PHYSICS, "auto"} == {*typing.get_args(PhysicsKind)}
    for kind in physics.PHYSICS:
        assert backend.resolve(_config(kind)) == _config(kind)
    with pytest.raises(ValueError, match=r"sim\.physics: 'auto' .* one of: mjx, warp, c"):
        physics.make(None, _config("auto").sim)


def test_choice_needs_no_mujoco():
    """Claim: `auto` is resolved without loading MuJoCo, which takes longer than JAX itself."""
    code = "import sys, csac_jax.sim.backend; assert 'mujoco' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
