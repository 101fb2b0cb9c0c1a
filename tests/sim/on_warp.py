"""What the tests of Warp's physics share."""

import dataclasses
import functools
import importlib.util
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import presets
from csac_jax.config import Config, SimConfig, SlotKind
from csac_jax.constants import Outcome
from csac_jax.scene import layout, model, pool
from csac_jax.scene.layout import Scene
from csac_jax.sim import oracle, physics as simulation
from csac_jax.sim.outcome import Trace, grasp_outcome
from csac_jax.sim.physics import Physics
from csac_jax.vision import observe

SCENES = 4
SLOTS: tuple[SlotKind, ...] = ("box", "arch", "prism", "cylinder")

Make = Callable[[model.World, SimConfig], Physics]


def needs_warp(test: Any) -> Any:
    """Marks of a test that runs Warp."""
    skip = pytest.mark.skipif(
        importlib.util.find_spec("warp") is None,
        reason="Warp is an extra: pip install 'csac-jax[warp]'",
    )
    return pytest.mark.mjx(pytest.mark.slow(skip(test)))


def config(slots: tuple[SlotKind, ...] = SLOTS) -> Config:
    """Of Warp's physics, with meshes of one size."""
    quick = presets.get("quick")
    scene = dataclasses.replace(
        quick.scene, slots=slots, min_blocks=len(slots), size_jitter=(0.1, 0.0)
    )
    return dataclasses.replace(
        quick, scene=scene, sim=dataclasses.replace(quick.sim, physics="warp")
    )


def spinning() -> Scene:
    """Blocks that spin in the air, lighter than the model has them."""
    scene = layout.parked(SLOTS)
    rng = np.random.default_rng(0)
    return scene.replace(
        position=scene.position + np.float32([0.0, 0.0, 0.5]),
        velocity=rng.normal(0.0, [1, 1, 1, 20, 20, 20], (len(SLOTS), 6)).astype(np.float32),
        density=rng.uniform(450.0, 900.0, len(SLOTS)).astype(np.float32),
        in_play=np.ones(len(SLOTS), bool),
    )


def compare_grasps(make: Make) -> None:
    """Asserts that the planner's grasps of blocks of four kinds end as in C MuJoCo."""
    outcome, position, trace = _end(config(), make)
    outcome_c, position_c, _ = _end(config().change(sim={"physics": "c"}), simulation.make)
    assert (outcome_c == Outcome.LIFTED).all()
    np.testing.assert_array_equal(outcome, outcome_c)
    assert not trace.contact_overflow.any()
    assert np.median(np.linalg.norm(position - position_c, axis=2)) < 1e-3


def _end(cfg: Config, make: Make) -> tuple[np.ndarray, np.ndarray, Trace]:
    """Outcomes [E], ends [E, N, 3] m and traces of the planner's grasps in settled scenes."""
    scenes = pool.settled(cfg, 77, SCENES)
    height = jax.vmap(lambda scene: observe.observe(cfg, scene).height)(scenes)
    action = jax.vmap(functools.partial(oracle.grasp, cfg))(scenes, height)
    physics = make(model.build(cfg.scene, cfg.sim), cfg.sim)
    run = functools.partial(simulation.execute, physics, cfg)
    after, trace, plan = jax.jit(jax.vmap(run))(scenes, height, action)
    rise = plan.start[:, 2] - jnp.min(plan.control[:, :, 2], axis=1)
    outcome = jax.vmap(grasp_outcome)(trace, plan.surface, rise)
    return np.asarray(outcome), np.asarray(after.position), jax.tree.map(np.asarray, trace)
