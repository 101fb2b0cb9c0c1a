"""A learner of your own: Q-learning on a dense map of grasps.

python examples/05_own_learner.py [PRESET] [RUN_DIR]"""

import sys

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

import csac_jax as csac

YAWS, SIDE, ADAM = 4, 0.448, optax.adam(1e-3)  # yaws of half a turn; side of the workspace, m


class QMap(nn.Module):  # height maps [N, H, H] m -> Q of grasps [N, H / 4, H / 4, YAWS]
    @nn.compact
    def __call__(self, height):
        x = nn.relu(nn.Conv(32, (8, 8), strides=4)(20 * height[..., None]))
        return nn.Dense(YAWS, kernel_init=nn.initializers.zeros)(nn.relu(nn.Conv(32, (5, 5))(x)))


class QLearner(csac.Learner):  # state: parameters, and the optimiser's state
    def init(self, key):
        params = QMap().init(key, jnp.zeros((1, 64, 64)))
        return params, ADAM.init(params)

    def act(self, key, state, obs, steps_without_change, actions_taken=None):
        q = QMap().apply(state[0], obs.height)
        if actions_taken is not None:  # explore, by noise that fades
            q += 0.998**actions_taken * jax.random.normal(key, q.shape)
        row, col, yaw = jnp.unravel_index(jnp.argmax(q.reshape(len(q), -1), 1), q.shape[1:])
        x, y = (((cell + 0.5) / q.shape[1] - 0.5) * SIDE for cell in (col, row))
        return csac.Action.grasp(x, y, yaw * jnp.pi / YAWS)

    def update(self, key, state, batch, weights):
        next_q = QMap().apply(state[0], csac.unpack(batch.next_obs).height)
        target = batch.reward + 0.5 * jnp.where(batch.terminated, 0.0, next_q.max((1, 2, 3)))
        x, y, yaw = batch.action.pose.T
        row, col = (((place / SIDE + 0.5) * next_q.shape[1]).astype(int) for place in (y, x))
        index = jnp.arange(len(y)), row, col, jnp.round(yaw * YAWS / jnp.pi).astype(int) % YAWS

        def loss(params):
            error = target - QMap().apply(params, csac.unpack(batch.obs).height)[index]
            value = jnp.mean(weights * error**2)
            return value, csac.UpdateInfo(value, jnp.mean(target - error), error)

        gradient, info = jax.grad(loss, has_aux=True)(state[0])
        change, adam = ADAM.update(gradient, state[1])
        return (optax.apply_updates(state[0], change), adam), info


def main(preset="quick", run_dir=None):
    cfg = csac.presets.get(preset).change(reward=csac.algorithms.VPG_REWARD)
    return csac.train(cfg, run_dir, learner=QLearner())


if __name__ == "__main__":
    print(main(*sys.argv[1:]).summary)
