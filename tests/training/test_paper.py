"""DenseNet-121 in the training step: the preset `paper` as far as a CPU goes, and a run at the
smallest size."""

import dataclasses
import re
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.config import Config, DenseNet121
from csac_jax.io import checkpoint
from csac_jax.nets import chunked_vmap
from csac_jax.sweeps import replicas
from csac_jax.training import programs, step
from tests.sweeps.test_replicas import assert_close
from tests.training.test_step import Still, assert_same, copy, equal, leaves

pytestmark = pytest.mark.mjx
TRUNK = 7_037_504


class Tiny(DenseNet121):
    """The network with few channels and layers."""

    block_layers: ClassVar[tuple[int, int, int, int]] = (1, 1, 1, 1)
    block_growth: ClassVar[int] = 4
    pad_fraction: ClassVar[float] = 0.0


TINY = Tiny(rotations=4, head=8)


def _still(cfg: Config) -> step.Program:
    program = programs.make(cfg)
    env = Still(cfg, program.env.physics, program.env.scenes)
    return dataclasses.replace(program, env=env)


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


@pytest.mark.slow
def test_run_with_batch_norm_resumes(tmp_path):
    """Claim: a run of DenseNet with batch norm learns, moves its statistics, and goes on after a
    checkpoint as if nothing had happened, in every bit of every leaf."""
    cfg = presets.smoke().change(net=dataclasses.replace(TINY, norm="batch"))
    program = _still(cfg)
    begun = programs.init(program)
    chunk = programs.compile_chunk(program, 4).lower(begun).compile()
    first, _ = chunk(copy(begun))
    second, metrics = chunk(copy(first))
    assert np.all(np.isfinite(metrics.critic_loss))
    for name in ("critic", "actor"):
        nets = [getattr(state.learner.online, name) for state in (first, second)]
        assert not equal(*(net["batch_stats"] for net in nets)), name
    checkpoint.save(tmp_path, 4, first, cfg, {})
    restored, _ = checkpoint.restore(tmp_path, jax.eval_shape(lambda: begun))
    again, repeated = chunk(restored)
    assert_same(again, second)
    assert_same(repeated, metrics)
    assert jnp.any(again.learner.updates > 0)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 2])
def test_runs_side_by_side_work_in_chunks(size: int, monkeypatch: pytest.MonkeyPatch):
    """Claim: each of four DenseNet runs side by side is the run that `train` makes of its seed, to
    rounding, and their products are made for so many at a time; those of runs whose numbers differ
    are vmapped.

    Products are rounded otherwise, and where a gradient is next to nothing Adam takes a step, 1e-4,
    either way: so a wide bound for all, and a narrow one for all but a few in a thousand
    numbers.
    """
    monkeypatch.setattr(chunked_vmap, "_LARGEST", size)
    configs = [presets.smoke().change(net=TINY, seed=k) for k in range(4)]
    program = _still(configs[0])

    def lowered(configs):
        (group,) = replicas.group_configs(configs)
        together = replicas.SweepProgram(program, replicas.group_replicas(group))
        begun = together.init()
        return begun, together.compile_chunk(6).lower(begun)

    with jax.debug_key_reuse(False):  # it takes a vmapped transpose of keys for a second use
        begun, chunk = lowered(configs)
    assert _runs_together(chunk) == ({2} if size == 2 else set())
    after, metrics = chunk.compile()(begun)
    for k, cfg in enumerate(configs):
        one = dataclasses.replace(program, cfg=cfg)
        alone, seen = programs.compile_chunk(one, 6)(programs.init(one))
        measured = jax.tree.map(lambda leaf, k=k: leaf[:, k], metrics)
        for mine, want in ((replicas.replica(after, k), alone), (measured, seen)):
            assert_close(mine, want, 1e-3, 1e-3)
            assert _share_apart(mine, want, 1e-5) < 2e-3
        for name in ("primitive", "outcome", "reward"):
            assert np.array_equal(getattr(measured, name), getattr(seen, name)), name
        assert np.all(np.isfinite(seen.critic_loss))

    slower = configs[3].change(learn={"tau": 0.5})
    with jax.debug_key_reuse(False):
        _, vmapped = lowered([*configs[:3], slower])
    assert _runs_together(vmapped) == {4}


def _share_apart(mine: Any, want: Any, bound: float) -> float:
    """Returns the share of numbers in two trees that are further apart than the bound."""
    pairs = [(a, b) for (_, a), (_, b) in zip(leaves(mine), leaves(want), strict=True)]
    apart = sum(np.sum(~np.isclose(*pair, bound, bound)) for pair in pairs)
    return apart / sum(a.size for a, _ in pairs)


def _runs_together(lowered) -> set[int]:
    """Returns for how many runs at a time the first convolution's products are made."""
    two = r"dot_general.* batching_dims = \[\d+, \d+\] .*: \(tensor<(\d+)x\d+x\d+x48xf32>,"
    return {int(runs) for runs in re.findall(two, lowered.as_text())}
