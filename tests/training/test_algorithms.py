"""Every algorithm through the compiled step and physics, with the smallest preset."""

import jax
import numpy as np
import pytest

from csac_jax import algorithms, presets
from csac_jax.constants import Primitive
from csac_jax.io import checkpoint
from csac_jax.training import programs
from tests.training.test_step import assert_same, copy

pytestmark = [pytest.mark.mjx, pytest.mark.slow]


@pytest.mark.parametrize("algo", algorithms.ALGORITHMS)
def test_algorithm_runs_and_resumes(algo, tmp_path):
    """Claim: every algorithm trains in one compiled program, its losses are finite, it has learned
    something after the warm-up, and a run saved and restored is the uninterrupted one in every
    bit."""
    cfg = algorithms.configure(presets.smoke(), algo)
    program = programs.make(cfg)
    begun = programs.init(program)
    chunk = programs.compile_chunk(program, cfg.train.chunk).lower(begun).compile()
    first, _ = chunk(copy(begun))
    kept = copy(first)
    second, metrics = chunk(first)
    for name in ("critic_loss", "actor_loss", "td_error", "q_mean"):
        assert np.all(np.isfinite(getattr(metrics, name))), name
    assert np.all(metrics.learned)
    assert second.learner.updates > 0
    if cfg.policy.primitive == "grasp":
        assert np.all(metrics.primitive == Primitive.GRASP)
    if not cfg.learn.actor:
        assert np.all(metrics.actor_loss == 0.0)
        assert_same(second.learner.online.actor, begun.learner.online.actor)

    checkpoint.save(tmp_path, cfg.train.chunk, kept, cfg, {})
    restored, _ = checkpoint.restore(tmp_path, jax.eval_shape(lambda: kept))
    again, seen = chunk(restored)
    assert_same(again, second)
    assert_same(seen, metrics)
