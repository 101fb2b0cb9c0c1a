"""The benchmarks' own arithmetic."""

import jax
import jax.numpy as jnp

from csac_jax import presets
from csac_jax.nets import dense
from experiments.bench import learner


def test_operations_are_those_of_the_net():
    """Claim: the operations of a pass are XLA's count of its convolutions and products, to 3 %:
    XLA leaves out the taps beyond the borders, and counts the norms."""
    net = presets.quick().net
    cells = 64
    maps = jnp.zeros((1, cells * net.stride, cells * net.stride, 4))
    critic = dense.Critic(net)
    variables = jax.eval_shape(critic.init, jax.random.key(0), maps)
    counted = jax.jit(critic.apply).lower(variables, maps).cost_analysis()["flops"]
    ours = sum(learner._operations(net, 4, cells).values())
    assert abs(ours / counted - 1.0) < 0.03, (ours, counted)
