"""A learner in one file, on the Gymnasium environment: policy gradient of a Gaussian.

python examples/06_gym_policy_gradient.py [PRESET] [STEPS] [SCENES]

It learns where to grasp from the height map; each action is paid for by itself.
"""

import sys

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax

import csac_jax.gym

STD = 0.2  # of the actions, which lie in -1 .. 1


class Actor(nn.Module):  # height map [E, H, W], m -> mean action [E, 4]
    @nn.compact
    def __call__(self, height):
        pooled = nn.avg_pool(20.0 * height[..., None], (4, 4), strides=(4, 4))
        hidden = nn.tanh(nn.Dense(64)(pooled.reshape(len(height), -1)))
        return jnp.tanh(nn.Dense(4)(hidden))


def main(preset="quick", steps="200", scenes="16", seed=0):
    config = csac_jax.presets.get(preset)
    envs = gymnasium.make_vec("csac_jax/Clutter-v0", num_envs=int(scenes), config=config)
    obs, _ = envs.reset(seed=seed)
    actor, optimiser, rng = Actor(), optax.adam(1e-2), np.random.default_rng(seed)
    params = actor.init(jax.random.key(seed), obs["height"])
    state, returns = optimiser.init(params), []

    def loss(params, height, action, advantage):
        distance = (action - actor.apply(params, height)) / STD
        return jnp.mean(advantage * jnp.sum(0.5 * distance**2, axis=-1))

    @jax.jit
    def update(params, state, *batch):
        change, state = optimiser.update(jax.grad(loss)(params, *batch), state)
        return optax.apply_updates(params, change), state

    for _ in range(int(steps)):
        height, mean = obs["height"], np.asarray(jax.jit(actor.apply)(params, obs["height"]))
        action = (mean + STD * rng.normal(size=mean.shape)).astype(np.float32)
        obs, reward, *_ = envs.step(np.clip(action, -1.0, 1.0))
        returns.append(float(reward.mean()))
        advantage = (reward - np.mean(returns[-20:])).astype(np.float32) / (reward.std() + 0.1)
        params, state = update(params, state, height, action, advantage)
    return returns


if __name__ == "__main__":
    returns = main(*sys.argv[1:])
    print(f"blocks per action: {np.mean(returns[:20]):.3f} -> {np.mean(returns[-20:]):.3f}")
