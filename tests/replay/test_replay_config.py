"""Settings of the replay that cannot work are refused by name."""

import jax
import jax.numpy as jnp
import pytest

from csac_jax import presets
from csac_jax.config import ReplayConfig
from csac_jax.replay import ring
from csac_jax.training import step


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("capacity", 0),
        ("capacity", 1),
        ("capacity", 2**30 + 1),
        ("alpha", -0.1),
        ("alpha", 1.1),
        ("alpha", float("nan")),
        ("floor", 0.0),
        ("floor", -1.0),
        ("floor", 2.0),
        ("is_beta_start", -0.1),
        ("is_beta_start", 1.1),
        ("is_beta_end", -0.1),
        ("is_beta_end", 1.1),
        ("beta_start", (0.0, 1.0)),
        ("beta_middle", (1.0, -1.0)),
        ("beta_end", (1.0, 0.0)),
        ("beta_middle_at", 0.0),
        ("beta_middle_at", 1.0),
    ],
)
def test_values_out_of_range(name, value):
    """Claim: a value out of range is a ValueError that begins with the setting's name."""
    with pytest.raises(ValueError, match=rf"^replay\.{name}:"):
        ReplayConfig(**{name: value})


@pytest.mark.parametrize("preset", ["smoke", "quick"])
def test_bytes_are_those_of_the_ring(preset):
    """Claim: the predicted memory is that of the arrays: two maps of 6 bytes per cell, and 26 bytes
    besides."""
    cfg = presets.get(preset)
    example = step.example(cfg)
    state = jax.eval_shape(lambda: ring.init(cfg.replay, example))
    arrays = [*jax.tree.leaves(state.items), state.priority]
    expected = sum(leaf.size * leaf.dtype.itemsize for leaf in arrays)
    assert ring.bytes_needed(cfg.replay.capacity, example) == expected
    assert ring.bytes_needed(1, example) == 2 * 6 * cfg.heightmap.size**2 + 4 + 3 * 4 + 4 + 1 + 4
    assert ring.bytes_needed(3, {"id": jnp.int32(0)}) == 3 * 8
