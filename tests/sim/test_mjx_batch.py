"""MJX in batches of one size and of another: the same physics, rounded otherwise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco import mjx

from csac_jax import env, presets
from csac_jax.constants import Primitive
from csac_jax.robot import primitives
from csac_jax.robot.primitives import Action
from csac_jax.sim import mjx_physics

pytestmark = [pytest.mark.slow, pytest.mark.mjx]

SCENES = 8


def _pushes(program: env.Env):
    """Scenes [E], joints [E] of a low push through a block of each, data [E] before substep 0."""
    cfg = program.cfg
    scenes = jax.tree.map(lambda leaf: jnp.asarray(leaf[:SCENES]), program.scenes)
    place = scenes.position[:, 0, :2] - jnp.array([[0.05, 0.0]])
    pose = jnp.concatenate([place, jnp.zeros((SCENES, 1))], axis=1)
    bare = jnp.zeros((cfg.heightmap.size, cfg.heightmap.size))

    def push(pose: jax.Array):
        action = Action(primitive=jnp.int32(Primitive.PUSH), pose=pose)
        plan = primitives.plan(cfg.sim, cfg.heightmap, bare, action)
        return primitives.joint_trajectory(cfg.sim, plan)

    joints = jax.vmap(push)(pose)
    begin = jax.vmap(lambda scene, one: mjx_physics.initial_data(program.physics, scene, one))
    return scenes, joints, begin(scenes, joints)


def test_batches_round_otherwise_and_contacts_amplify_it():
    """Claim: a scene in a batch and alone are apart by rounding after a step, less than 1e-6 m, and
    by more than 1e-4 m after a push: two layouts are two runs."""
    program = env.make_env(presets.smoke())
    physics = program.physics
    given = jax.jit(lambda: _pushes(program))()

    def substep(scene, joints, initial, data, index):
        model = mjx_physics.scene_model(physics, scene)
        with jax.default_matmul_precision("highest"):
            after = mjx.step(model, data.replace(ctrl=joints.control[index]))
        return mjx_physics._restrain(physics.world, ~scene.in_play, initial, after)

    run = jax.jit(jax.vmap(substep, (0, 0, 0, 0, None)))
    together, apart = given[2], []
    each = [jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], given) for i in range(SCENES)]
    alone = [one[2] for one in each]
    for index in np.arange(program.cfg.sim.substeps):
        together = run(*given, together, index)
        alone = [run(*one, data, index) for one, data in zip(each, alone, strict=True)]
        separate = np.concatenate([data.qpos for data in alone])
        apart.append(float(np.max(np.abs(together.qpos - separate))))
    assert 0.0 < apart[0] < 1e-6
    assert apart[-1] > 1e-4
