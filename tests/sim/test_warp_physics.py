"""MJX on Warp beside C MuJoCo, where Warp is installed; without a GPU it runs on the CPU,
slowly."""

import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax.errors import SceneError
from csac_jax.scene import model
from csac_jax.sim import mjx_physics, physics as simulation, warp_physics
from tests.sim import on_warp


def test_missing_warp_is_one_line(monkeypatch: pytest.MonkeyPatch):
    """Claim: physics on Warp without Warp names the extra to install."""
    monkeypatch.setitem(sys.modules, "warp", None)  # importing it raises ImportError
    cfg = on_warp.config()
    with pytest.raises(SceneError, match=r"pip install 'csac-jax\[warp\]'"):
        warp_physics.make(model.build(cfg.scene, cfg.sim), cfg.sim)


def test_meshes_of_two_sizes_are_refused():
    """Claim: Warp's meshes have one size, and a config that asks for several is refused, one of
    boxes alone is not."""
    cfg = on_warp.config()
    with pytest.raises(ValueError, match=r"scene\.size_jitter: the second must be 0"):
        cfg.change(scene={"size_jitter": (0.1, 0.1)})
    boxes = {"slots": ("box", "arch"), "min_blocks": 2, "size_jitter": (0.1, 0.1)}
    assert cfg.change(scene=boxes).sim.physics == "warp"


@on_warp.needs_warp
def test_grasps_go_as_in_c():
    """Claim: the planner's grasps of blocks of four kinds end on Warp as they do in C MuJoCo."""
    on_warp.compare_grasps(simulation.make)


@on_warp.needs_warp
def test_spinning_block_goes_as_in_c():
    """Claim: blocks that spin in the air, lighter than the model has them, are after a step as fast
    as in C."""
    cfg = on_warp.config()
    world = model.build(cfg.scene, cfg.sim)
    scene = on_warp.spinning()
    fields = jax.device_get(model.scene_fields(world, scene))
    exact = model.with_blocks(world, fields)
    data = mujoco.MjData(exact)
    data.qpos[world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
    data.qvel[world.block_dofs] = scene.velocity
    mujoco.mj_forward(exact, data)
    begun = data.qpos.copy(), data.qvel.copy()
    mujoco.mj_step(exact, data)

    physics = simulation.make(world, cfg.sim)
    assert isinstance(physics, mjx_physics.MjxPhysics)

    def step(scene):
        blank = physics.data.replace(qpos=jnp.asarray(begun[0]), qvel=jnp.asarray(begun[1]))
        return physics.step(mjx_physics.scene_model(physics, scene), blank).qvel

    after = jax.jit(jax.vmap(step))(jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene))[0]
    np.testing.assert_allclose(after[world.block_dofs], data.qvel[world.block_dofs], atol=2e-3)
