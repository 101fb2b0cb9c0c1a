"""A sampler of your own: ranks of the TD error follow an exponential law.

python examples/03_own_sampler.py [PRESET] [RUN_DIR]
"""

import dataclasses
import sys

import jax
import jax.numpy as jnp

import csac_jax as csac


@dataclasses.dataclass(frozen=True)
class RankExponential(csac.Sampler):
    """P(rank) ~ exp(-rank / (share n)); rank 0 is the largest abs(TD error)."""

    share: float = 0.2

    def sample(self, key, state, progress, num):
        filled = jnp.arange(state.priority.shape[0]) < state.size
        order = jnp.argsort(jnp.where(filled, -state.priority, jnp.inf))
        ranks = jax.random.exponential(key, (num,)) * (self.share * state.size)
        slots = order[jnp.clip(ranks.astype(jnp.int32), 0, jnp.maximum(state.size - 1, 0))]
        return csac.Sample(slots=slots.astype(jnp.int32), weights=jnp.ones(num))


def main(preset="quick", run_dir=None):
    return csac.train(csac.presets.get(preset), run_dir, sampler=RankExponential())


if __name__ == "__main__":
    print(main(*sys.argv[1:]).summary)
