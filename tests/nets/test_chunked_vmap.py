"""Networks of runs side by side, a chunk of them at a time."""

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

from csac_jax import presets
from csac_jax.nets import chunked_vmap


@pytest.mark.parametrize(
    ("runs", "size"), [(1, 1), (2, 2), (5, 5), (7, 1), (8, 4), (12, 4), (16, 4), (20, 5)]
)
def test_chunks_are_of_one_size(runs: int, size: int):
    """Claim: runs of DenseNet-121 are divided into equal chunks, as large as they may be; small
    nets are not."""
    assert chunked_vmap.chunk_size(presets.paper(), runs) == size
    assert chunked_vmap.chunk_size(presets.paper_small(), runs) is None


@pytest.mark.parametrize("size", [1, 2, 6])
def test_chunks_do_what_each_does(size: int):
    """Claim: in chunks, each of six runs has the value and the shapes that it has alone, what they
    share included."""
    runs, shared = jnp.arange(12.0).reshape(6, 2), jnp.arange(6.0).reshape(2, 3)
    keys = jax.random.split(jax.random.key(0), 6)

    def part(key: jax.Array, run: jax.Array, shared: jax.Array) -> dict[str, jax.Array]:
        return {"sum": run @ shared, "noise": jax.random.normal(key, (3,)) + run[0]}

    with jax.debug_key_reuse(False):  # keys are used twice, to compare
        got = jax.jit(jax.vmap(chunked_vmap.vmap_in_chunks(part, size), in_axes=(0, 0, None)))(
            keys, runs, shared
        )
        for i in range(6):
            for name, leaf in part(keys[i], runs[i], shared).items():
                assert_allclose(got[name][i], leaf, rtol=1e-6, err_msg=name)
