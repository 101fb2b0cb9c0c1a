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
from csac_jax.config import DenseNet121
from csac_jax.env import Env
from csac_jax.io import checkpoint
from csac_jax.nets import chunked_vmap
from csac_jax.sweeps import replicas
from csac_jax.training import program as programs
from tests.sweeps.test_replicas import assert_close
from tests.training.test_step import assert_same, copy, equal

pytestmark = pytest.mark.mjx
TRUNK = 7_037_504


class Tiny(DenseNet121):
    """The network with few channels and layers."""

    block_layers: ClassVar[tuple[int, int, int, int]] = (1, 1, 1, 1)
    block_growth: ClassVar[int] = 4


TINY = Tiny(rotations=4, margin=0.0, head=8, zoom=2)


class Still(Env):
    """The environment without physics: compiles fast."""

    def step(self, state, action):
        """The scene as it was."""
        return state.replace(actions=state.actions + 1)


@pytest.mark.slow
def test_paper_has_densenet_121_three_times():
    """Claim: the state of the preset `paper` can be made: a trunk each for colour, height and
    target mask, online and target, and a ring that holds all 2,500 actions."""
    cfg = presets.paper()
    state = programs.abstract_state(cfg)
    for params in (state.learner.online, state.learner.target):
        trunks = [params.critic[kind]["trunk"] for kind in ("params", "batch_stats")]
        assert sum(leaf.size for leaf in jax.tree.leaves(trunks)) == 3 * TRUNK
        assert params.critic["params"]["head"]["conv0"]["kernel"].shape == (1, 3072, 64)
    assert state.replay.items.obs.height.shape == (2500, 224, 224)
    assert cfg.train.steps == cfg.train.actions == 2500


@pytest.mark.slow
def test_paper_can_be_traced():
    """Claim: the whole training step of `paper` can be traced, and gives back a state of the same
    shapes and types."""
    program = programs.make(presets.paper().change(scene={"pool": 1}))
    state = jax.eval_shape(lambda: programs.init(program))
    after, metrics = jax.eval_shape(programs.compile_chunk(program, 1), state)
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), after) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), state
    )
    assert metrics.critic_loss.shape == (1,)


@pytest.mark.slow
def test_run_with_batch_norm_resumes(tmp_path):
    """Claim: a run of DenseNet with batch norm learns, moves its statistics, and goes on after a
    checkpoint as if nothing had happened, in every bit of every leaf."""
    cfg = presets.smoke().change(net=dataclasses.replace(TINY, norm="batch"))
    program = programs.make(cfg)
    program = dataclasses.replace(program, env=Still(cfg, program.env.physics, program.env.scenes))
    begun = programs.init(program)
    chunk = programs.compile_chunk(program, 4).lower(begun).compile()
    first, _ = chunk(copy(begun))
    second, metrics = chunk(copy(first))
    assert np.all(np.isfinite(metrics.critic_loss))
    for name in ("critic", "actor"):
        before, after = (
            getattr(state.learner.online, name)["batch_stats"] for state in (first, second)
        )
        assert not equal(before, after), name
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
    either way: hence a wide bound for all, and a narrow one for all but a few in a thousand
    numbers.
    """
    monkeypatch.setattr(chunked_vmap, "_LARGEST", size)
    configs = [presets.smoke().change(net=TINY, seed=k) for k in range(4)]
    program = programs.make(configs[0])
    program = dataclasses.replace(
        program, env=Still(configs[0], program.env.physics, program.env.scenes)
    )

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
        for mine, want in (
            (replicas.replica(after, k), alone),
            (jax.tree.map(lambda leaf, k=k: leaf[:, k], metrics), seen),
        ):
            assert_close(mine, want, 1e-3, 1e-3)
            assert _share_apart(mine, want, 1e-5) < 2e-3
        for name in ("primitive", "outcome", "reward"):
            np.testing.assert_array_equal(
                getattr(metrics, name)[:, k], getattr(seen, name), err_msg=name
            )
        assert np.all(np.isfinite(seen.critic_loss))

    slower = configs[3].change(learn={"tau": 0.5})
    with jax.debug_key_reuse(False):
        _, vmapped = lowered([*configs[:3], slower])
    assert _runs_together(vmapped) == {4}


def _share_apart(mine: Any, want: Any, bound: float) -> float:
    """Share of all numbers in two trees that are further apart than this, relative or absolute."""
    pairs = [
        (np.asarray(one), np.asarray(other))
        for one, other in zip(jax.tree.leaves(mine), jax.tree.leaves(want), strict=True)
        if not jax.dtypes.issubdtype(one.dtype, jax.dtypes.prng_key)
    ]
    return sum(np.sum(~np.isclose(*pair, bound, bound)) for pair in pairs) / sum(
        one.size for one, _ in pairs
    )


def _runs_together(lowered) -> set[int]:
    """Of how many runs the first convolution's products are made at a time, of 48 numbers a
    cell."""
    two = r"dot_general.* batching_dims = \[\d+, \d+\] .*: \(tensor<(\d+)x\d+x\d+x48xf32>,"
    return {int(runs) for runs in re.findall(two, lowered.as_text())}
