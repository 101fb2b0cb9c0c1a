"""The evaluation of a sweep's final policies."""

from pathlib import Path
from typing import Any

import jax
import pytest

from csac_jax import presets
from csac_jax.evaluation import suites
from csac_jax.runtime import signals
from csac_jax.sweeps import final
from csac_jax.sweeps.grid import SweepPoint
from csac_jax.sweeps.runner import SweepPlan, runs_of


@pytest.mark.parametrize(("trained", "measured"), [("c", "c"), ("mjx", "mjx"), ("warp", "mjx")])
def test_policies_are_measured_in_the_physics_of_their_training(
    monkeypatch: pytest.MonkeyPatch, trained: Any, measured: str
):
    """Claim: on a GPU, too, what was trained in C MuJoCo is evaluated in C MuJoCo."""
    cfg = presets.smoke().change(sim={"physics": trained}, scene={"size_jitter": (0.1, 0.0)})
    plan = SweepPlan(1, [SweepPoint("one", {}, cfg)], 4)
    seen: list[str] = []

    def environments(cfg: Any, *_: Any) -> dict[str, Any]:
        seen.append(cfg.sim.physics)
        return {}

    stop = signals.Stop()
    stop.signal = 15  # no policy is read
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(suites, "environments", environments)
    final._measure_point(4, final.OWN, plan.points[0], Path("unused"), runs_of(plan), stop)
    assert seen == [measured]
