"""Settings of the replay that cannot work are refused by name."""

import jax
import jax.numpy as jnp
import pytest

from csac_jax import presets
from csac_jax.config import BetaReplay
from csac_jax.replay import ring, samplers
from csac_jax.training import programs


@pytest.mark.parametrize(
    ("name", "value"),
    [("start", (float("nan"), 1.0)), ("middle", (1.0, -1.0)), ("end", (1.0, 0.0)), ("capacity", 1)],
)
def test_values_out_of_range(name, value):
    """Claim: a value out of range is a ValueError that begins with the setting's name."""
    with pytest.raises(ValueError, match=rf"^replay\.{name}:"):
        BetaReplay(**{name: value})


@pytest.mark.parametrize("preset", ["smoke", "quick"])
def test_bytes_are_those_of_the_ring(preset):
    """Claim: the predicted memory is that of the arrays: two maps of 6 bytes per cell, and 26 bytes
    besides."""
    cfg = presets.get(preset)
    example = programs.example(cfg)
    sampler = samplers.make(cfg.replay)
    state = jax.eval_shape(lambda: ring.init(sampler.init(cfg.replay.capacity), example))
    arrays = [*jax.tree.leaves(state.items), state.priority]
    expected = sum(leaf.size * leaf.dtype.itemsize for leaf in arrays)
    assert ring.bytes_needed(cfg.replay.capacity, example) == expected
    assert ring.bytes_needed(1, example) == 2 * 6 * cfg.heightmap.size**2 + 4 + 3 * 4 + 4 + 1 + 4
    assert ring.bytes_needed(3, {"id": jnp.int32(0)}) == 3 * 8
