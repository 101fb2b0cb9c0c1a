"""The environment by itself: random grasps in a batch of scenes, with automatic reset.

python examples/02_random_agent.py [PRESET] [STEPS]
"""

import sys

import jax
import jax.numpy as jnp

import csac_jax as csac

SCENES = 8


def main(preset="quick", steps="20"):
    scenes = csac.make_env(csac.presets.get(preset))
    env, bounds = csac.AutoResetEnv(scenes), scenes.action_spec.pose

    def step(state, key):
        key_act, key_reset = jax.random.split(key)
        pose = jax.random.uniform(key_act, (SCENES, 3), float, bounds.minimum, bounds.maximum)
        action = jax.vmap(csac.Action.grasp)(*pose.T)
        keys_reset = jax.random.split(key_reset, SCENES)
        state, after = jax.vmap(env.step)(keys_reset, state, action)
        return state, after.info.cleared

    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), SCENES))
    keys = jax.random.split(jax.random.key(1), int(steps))
    _, cleared = jax.jit(lambda state, keys: jax.lax.scan(step, state, keys))(state, keys)
    return jnp.sum(cleared) / cleared.size


if __name__ == "__main__":
    print(f"blocks cleared per random grasp: {main(*sys.argv[1:]):.3f}")
