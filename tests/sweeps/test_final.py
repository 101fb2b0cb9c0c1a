"""The evaluation of a sweep's final policies."""

from pathlib import Path
from typing import Any

import jax
import pytest

from csac_jax import presets
from csac_jax.evaluation import suites
from csac_jax.runtime import signals
from csac_jax.sweeps import final


@pytest.mark.parametrize(("trained", "measured"), [("c", "c"), ("mjx", "mjx"), ("warp", "mjx")])
def test_policies_are_measured_in_the_physics_of_their_training(
    monkeypatch: pytest.MonkeyPatch, trained: Any, measured: str
):
    """Claim: on a GPU, too, what was trained in C MuJoCo is evaluated in C MuJoCo."""
    cfg = presets.smoke().change(sim={"physics": trained}, scene={"size_jitter": (0.1, 0.0)})
    seen: list[str] = []
    suite = suites.Suite(lambda cfg, *_: {"part": seen.append(cfg.sim.physics)})
    monkeypatch.setitem(suites.SUITES, final.OWN, suite)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    stop = signals.Stop()
    stop.signal = 15  # no policy is read
    final._measure_point(4, final.OWN, cfg, {Path("unused"): cfg}, stop)
    assert seen == [measured]
