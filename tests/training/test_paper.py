"""DenseNet-121 in the training step: the preset `paper` as far as a CPU goes, and a run at the
smallest size."""

import jax
import pytest

from csac_jax import presets
from csac_jax.training import programs

pytestmark = pytest.mark.mjx
TRUNK = 7_037_504


@pytest.mark.slow
def test_paper_can_be_traced():
    """Claim: the training step of `paper` can be traced, and gives back a state of the same types:
    a trunk each for colour, height and target mask, online and target, and a ring that holds all
    2,500 actions."""
    program = programs.make(presets.paper().change(scene={"pool": 1}))
    state = jax.eval_shape(lambda: programs.init(program))
    for params in (state.learner.online, state.learner.target):
        trunks = [params.critic[kind]["trunk"] for kind in ("params", "batch_stats")]
        assert sum(leaf.size for leaf in jax.tree.leaves(trunks)) == 3 * TRUNK
        assert params.critic["params"]["head"]["conv0"]["kernel"].shape == (1, 3072, 64)
    assert state.replay.items.obs.height.shape == (2500, 224, 224)
    assert program.cfg.train.steps == program.cfg.train.actions == 2500
    after, metrics = jax.eval_shape(programs.compile_chunk(program, 1), state)
    kind = lambda leaf: (leaf.shape, leaf.dtype)  # noqa: E731
    assert jax.tree.map(kind, after) == jax.tree.map(kind, state)
    assert metrics.critic_loss.shape == (1,)
