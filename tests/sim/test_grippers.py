"""Every gripper takes a cube, whatever computes its physics."""

import functools
import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import grippers, presets
from csac_jax.config import PhysicsKind
from csac_jax.constants import Outcome
from csac_jax.scene import layout, model
from csac_jax.scene.layout import Scene
from csac_jax.sim import outcome, physics as simulation
from csac_jax.sim.outcome import Trace
from csac_jax.sim.primitives import Action

HALF = 0.025  # m, half the side of the cube
PLACE = (0.02, -0.03)  # m


def _scene() -> Scene:
    """A cube on the table."""
    scene = layout.parked(("box",))
    return scene.replace(
        position=np.array([[*PLACE, HALF]], np.float32),
        half_size=np.full((1, 3), HALF, np.float32),
        in_play=np.array([True]),
    )


@functools.cache
def _grasped(gripper: str, physics: PhysicsKind) -> tuple[Scene, Trace, int]:
    """The scene after a grasp of the cube, what was seen, and the outcome."""
    cfg = presets.get("quick").change(
        scene={"slots": ("box",), "min_blocks": 1},
        sim={"gripper": gripper, "physics": physics, "geom_pairs": 4, "contacts": 16},
    )
    engine = simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    scene = jax.tree.map(jnp.asarray, _scene())
    height = jnp.zeros((64, 64)).at[24:31, 31:38].set(2.0 * HALF)
    run = jax.jit(lambda *given: simulation.execute(engine, cfg, *given))
    after, trace, plan = run(scene, height, Action.grasp(*PLACE, 0.0))
    rise = plan.start[2] - jnp.min(plan.control[:, 2])
    return after, trace, int(outcome.grasp_outcome(trace, plan.surface, rise))


@pytest.mark.mjx
@pytest.mark.parametrize("gripper", grippers.shipped())
def test_gripper_lifts_a_cube(gripper: str):
    """Claim: in C MuJoCo each gripper lifts a cube, and its joint tells the cube's width to 6 mm
    after the lift: pads and couplings give way."""
    after, trace, found = _grasped(gripper, "c")
    assert found == Outcome.LIFTED
    assert trace.gap_end == pytest.approx(2.0 * HALF, abs=0.006)
    assert after.position[0, 2] > 0.1


@pytest.mark.mjx
@pytest.mark.slow
@pytest.mark.parametrize("gripper", grippers.shipped())
@pytest.mark.parametrize("physics", ["mjx", "warp"])
def test_gripper_lifts_a_cube_as_in_c(gripper: str, physics: PhysicsKind):
    """Claim: in MJX and on Warp the cube ends within 3 mm of where C MuJoCo has it, and the gap is
    the same to 1 mm."""
    if physics == "warp" and importlib.util.find_spec("warp") is None:
        pytest.skip("Warp is an extra: pip install 'csac-jax[warp]'")
    after, trace, found = _grasped(gripper, physics)
    in_c, trace_c, _ = _grasped(gripper, "c")
    assert found == Outcome.LIFTED
    np.testing.assert_allclose(after.position, in_c.position, atol=0.003)
    assert trace.gap_end == pytest.approx(float(trace_c.gap_end), abs=0.001)
