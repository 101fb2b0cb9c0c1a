"""MJX on Warp beside C MuJoCo, where Warp is installed; without a GPU it runs on the CPU,
slowly."""

import dataclasses
import functools
import importlib.util
import sys
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.config import Config
from csac_jax.constants import Outcome
from csac_jax.errors import SceneError
from csac_jax.scene import layout, model, pool
from csac_jax.sim import mjx_physics, oracle, physics as simulation, warp_physics
from csac_jax.sim.outcome import Trace, grasp_outcome
from csac_jax.vision import observe

SCENES = 4
SLOTS = ("box", "arch", "prism", "cylinder")


def needs_warp(test: Any) -> Any:
    """Marks of a test that runs Warp."""
    skip = pytest.mark.skipif(
        importlib.util.find_spec("warp") is None,
        reason="Warp is an extra: pip install 'csac-jax[warp]'",
    )
    return pytest.mark.mjx(pytest.mark.slow(skip(test)))


def _config() -> Config:
    quick = presets.get("quick")
    scene = dataclasses.replace(
        quick.scene, slots=SLOTS, min_blocks=len(SLOTS), size_jitter=(0.1, 0.0)
    )
    return dataclasses.replace(
        quick, scene=scene, sim=dataclasses.replace(quick.sim, physics="warp")
    )


def test_missing_warp_is_one_line(monkeypatch: pytest.MonkeyPatch):
    """Claim: physics on Warp without Warp names the extra to install."""
    monkeypatch.setitem(sys.modules, "warp", None)  # importing it raises ImportError
    cfg = _config()
    with pytest.raises(SceneError, match=r"pip install 'csac-jax\[warp\]'"):
        warp_physics.make(model.build(cfg.scene, cfg.sim), cfg.sim)


def test_meshes_of_two_sizes_are_refused():
    """Claim: Warp's meshes have one size, and a config that asks for several is refused, one of
    boxes alone is not."""
    cfg = _config()
    with pytest.raises(ValueError, match=r"scene\.size_jitter: the second must be 0"):
        cfg.change(scene={"size_jitter": (0.1, 0.1)})
    boxes = {"slots": ("box", "arch"), "min_blocks": 2, "size_jitter": (0.1, 0.1)}
    assert cfg.change(scene=boxes).sim.physics == "warp"


@needs_warp
def test_grasps_go_as_in_c():
    """Claim: the planner's grasps of blocks of four kinds end on Warp as they do in C MuJoCo."""
    outcome, position, trace = _end(_config(), "warp")
    outcome_c, position_c, _ = _end(_config(), "c")
    assert (outcome_c == Outcome.LIFTED).all()
    np.testing.assert_array_equal(outcome, outcome_c)
    assert not trace.contact_overflow.any()
    assert np.median(np.linalg.norm(position - position_c, axis=2)) < 1e-3


@needs_warp
def test_spinning_block_goes_as_in_c():
    """Claim: blocks that spin in the air, lighter than the model has them, are after a step as fast
    as in C."""
    cfg = _config()
    world = model.build(cfg.scene, cfg.sim)
    scene = layout.parked(cfg.scene.slots)
    rng = np.random.default_rng(0)
    scene = scene.replace(
        position=scene.position + np.float32([0.0, 0.0, 0.5]),
        velocity=rng.normal(0.0, [1, 1, 1, 20, 20, 20], (len(SLOTS), 6)).astype(np.float32),
        density=rng.uniform(450.0, 900.0, len(SLOTS)).astype(np.float32),
        in_play=np.ones(len(SLOTS), bool),
    )
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


def _end(cfg: Config, physics: Any) -> tuple[np.ndarray, np.ndarray, Trace]:
    """Outcomes [E], ends [E, N, 3] m and traces of the planner's grasps in settled scenes."""
    cfg = cfg.change(sim={"physics": physics})
    world = model.build(cfg.scene, cfg.sim)
    scenes = pool.settled(cfg, 77, SCENES)
    height = jax.vmap(lambda scene: observe.observe(cfg, scene).height)(scenes)
    action = jax.vmap(functools.partial(oracle.grasp, cfg))(scenes, height)
    run = functools.partial(simulation.execute, simulation.make(world, cfg.sim), cfg)
    after, trace, plan = jax.jit(jax.vmap(run))(scenes, height, action)
    rise = plan.start[:, 2] - jnp.min(plan.control[:, :, 2], axis=1)
    outcome = jax.vmap(grasp_outcome)(trace, plan.surface, rise)
    return np.asarray(outcome), np.asarray(after.position), jax.tree.map(np.asarray, trace)
