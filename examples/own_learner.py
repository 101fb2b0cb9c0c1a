"""A learner of your own: plain DQN on a dense map of grasps, with four yaws.

python examples/own_learner.py [PRESET] [RUN_DIR]
"""

import sys

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

import csac_jax as csac

YAWS, CELLS, GAMMA = 4, 16, 0.5  # of half a turn; along each side of the map


class QMap(nn.Module):
    """Height maps [N, H, H] m -> Q [N, CELLS, CELLS, YAWS]."""

    @nn.compact
    def __call__(self, height):
        stride = height.shape[1] // CELLS
        x = nn.relu(nn.Conv(32, (2 * stride, 2 * stride), strides=stride)(20 * height[..., None]))
        return nn.Dense(YAWS, kernel_init=nn.initializers.zeros)(nn.relu(nn.Conv(32, (5, 5))(x)))


class DQN(csac.Learner):
    """State: parameters, those of the target network, the optimiser's."""

    def __init__(self, cfg):
        self.cfg, self.optimiser = cfg, optax.adam(cfg.learn.learning_rate)

    def init(self, key):
        size = self.cfg.heightmap.size
        params = QMap().init(key, jnp.zeros((1, size, size)))
        return params, params, self.optimiser.init(params)

    def act(self, key, state, obs, steps_without_change, actions_taken=None):
        q = QMap().apply(state[0], obs.height).reshape(len(obs.height), -1)
        best, cell = jnp.argmax(q, axis=1), 0.448 / CELLS
        if actions_taken is not None:
            epsilon = jnp.maximum(0.05, 0.998**actions_taken)
            key_explore, key_cell = jax.random.split(key)
            elsewhere = jax.random.randint(key_cell, best.shape, 0, q.shape[1])
            best = jnp.where(
                jax.random.bernoulli(key_explore, epsilon, best.shape), elsewhere, best
            )
        row, col, yaw = jnp.unravel_index(best, (CELLS, CELLS, YAWS))
        x, y = ((index + 0.5 - 0.5 * CELLS) * cell for index in (col, row))
        return jax.vmap(csac.Action.grasp)(x, y, yaw * (jnp.pi / YAWS))

    def update(self, key, state, batch, weights):
        params, target, optimiser = state
        obs, next_obs = csac.unpack(batch.obs), csac.unpack(batch.next_obs)
        following = jnp.max(QMap().apply(target, next_obs.height), axis=(1, 2, 3))
        y = batch.reward + GAMMA * jnp.where(batch.terminated, 0.0, following)
        x, place_y, yaw = batch.action.pose.T
        col, row = (jnp.clip((c / 0.448 + 0.5) * CELLS, 0, CELLS - 1) for c in (x, place_y))
        index = (
            row.astype(int),
            col.astype(int),
            jnp.round(yaw * YAWS / jnp.pi).astype(int) % YAWS,
        )

        def loss(params):
            q = QMap().apply(params, obs.height)[(jnp.arange(len(y)), *index)]
            return jnp.mean(weights * (y - q) ** 2), q

        (value, q), gradient = jax.value_and_grad(loss, has_aux=True)(params)
        change, optimiser = self.optimiser.update(gradient, optimiser)
        params = optax.apply_updates(params, change)
        target = optax.incremental_update(params, target, 0.02)
        return (params, target, optimiser), csac.UpdateInfo(value, jnp.mean(q), y - q)


def main(preset="quick", run_dir=None):
    cfg = csac.presets.get(preset).change(reward=csac.algorithms.VPG_REWARD)
    return csac.train(cfg, run_dir, learner=DQN(cfg))


if __name__ == "__main__":
    print(main(*sys.argv[1:]).summary)
