"""Settings of the replay that cannot work are refused by name."""

import jax
import jax.numpy as jnp
import pytest

from csac_jax import presets
from csac_jax.replay import ring, samplers
from csac_jax.training import programs


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
