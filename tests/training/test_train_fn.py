"""Training as a pure function of a key."""

from pathlib import Path

import jax
import numpy as np
import pytest

import csac_jax
from csac_jax.io import checkpoint
from csac_jax.training import programs, trace_cache
from tests.agent import toys
from tests.training.test_step import leaves

SCENES, STEPS = 8, 12
CFG = toys.config("grasp_only", SCENES * STEPS, max_actions=2).change(train={"chunk": 4})


@pytest.mark.optax
def test_function_of_a_key_is_the_run_of_its_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Claim: `train_fn`, compiled and vmapped over keys, gives the run that `train` makes of each
    seed, to rounding; two keys differ. Pictures stand in for physics."""
    kinds = (toys.GOOD, toys.DUD) * 5
    monkeypatch.setattr(programs.environment, "make_env", lambda cfg: toys.Toy(cfg, kinds))
    monkeypatch.setattr(programs, "prepare", lambda _: None)
    monkeypatch.setattr(trace_cache, "_folder", lambda: None)
    run = csac_jax.train(CFG, tmp_path / "run", verbose=False)
    abstract = jax.eval_shape(lambda: programs.init(programs.make(CFG)))
    alone, _ = checkpoint.restore(run.run_dir, abstract)

    keys = jax.vmap(jax.random.key)(np.arange(2, dtype=np.uint32))
    with jax.debug_key_reuse(False):  # it takes a vmapped transpose of keys for a second use
        states, metrics = jax.jit(jax.vmap(csac_jax.train_fn(CFG)))(keys)
    assert metrics.reward.shape == (2, STEPS, SCENES)
    assert metrics.learned[:, -1].all()

    first = jax.tree.map(lambda leaf: leaf[0], states)
    for (name, got), (_, wanted) in zip(leaves(first), leaves(alone), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-4, err_msg=name)
    networks = [np.asarray(leaf) for leaf in jax.tree.leaves(states.learner.online.critic)]
    assert not any(np.array_equal(*leaf) for leaf in networks)
