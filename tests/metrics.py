"""What a training step reports, for tests that have no training step."""

from typing import Any

import jax.numpy as jnp

from csac_jax.training.transitions import StepMetrics


def step_metrics(scenes: int, loss: Any = 0.0, **given: Any) -> StepMetrics:
    """Metrics of one step in which nothing happened in any of E scenes, but for what is given.

    `loss` is the value of all four numbers of learning.
    """
    no, none = jnp.zeros(scenes, bool), jnp.zeros(scenes, jnp.int32)
    return StepMetrics(
        primitive=none,
        outcome=none,
        push_better=no,
        cleared=none,
        blocks_lost=none,
        terminated=no,
        truncated=no,
        reward=jnp.zeros(scenes),
        gap_disagrees=no,
        contact_overflow=none,
        physics_diverged=no,
        unreachable=no,
        learned=jnp.array(True),
        **dict.fromkeys(("critic_loss", "actor_loss", "td_error", "q_mean"), loss),
        finite=jnp.array(True),
    )._replace(**given)
