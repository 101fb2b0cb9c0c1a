"""The contract of every physics engine: scripted scenes, and each gripper's grasp of a cube."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import grippers, presets
from csac_jax.config import PhysicsKind
from csac_jax.constants import Outcome
from csac_jax.robot.primitives import Action
from csac_jax.sim import outcome, physics as simulation
from csac_jax.sim.outcome import Trace
from csac_jax.world import model, scene_state
from csac_jax.world.scene_state import SceneState
from tests.sim.conftest import WARP, Run

pytestmark = pytest.mark.mjx
HALF, PLACE = 0.025, (0.02, -0.03)  # m, half the side of the grippers' cube, and where it stands


@pytest.mark.parametrize("level", list(Outcome), ids=lambda level: level.name.lower())
def test_every_outcome_is_reached(cases: Run, level: Outcome):
    """Claim: physics reaches all five levels of a grasp (CSAC eq. 15)."""
    run = cases.case(level.name.lower())
    assert simulation.healthy(run.after)
    assert outcome.grasp_outcome(run.trace, run.plan.surface, run.hand_rise) == level
    if level != Outcome.TOUCHED:  # where the finger gap can tell
        by_gap = outcome.grasp_outcome_by_gap(run.trace, run.plan.surface, jnp.array(False))
        assert by_gap == level


def test_lifted_block_alone_hangs_in_the_hand(cases: Run):
    """Claim: a lifted block stays in play at the hand's height, the other one lies; a dropped block
    rose by more than a centimetre and ends on the table."""
    run = cases.case("lifted")
    np.testing.assert_array_equal(run.after.in_play, [True, True, False])
    lifted = outcome.lifted_blocks(run.trace, run.hand_rise)
    np.testing.assert_array_equal(lifted, [True, False, False])
    rise = run.after.position[:, 2] - run.scene.position[:, 2]
    np.testing.assert_allclose(rise[:2], [run.hand_rise, 0.0], atol=0.005)
    assert abs(run.trace.gap_end - 0.05) < 0.005  # the cube's width
    dropped = cases.case("dropped").trace
    assert dropped.held_rise[2] >= outcome.GRIP_RISE
    assert abs(dropped.rise[2]) < 0.01
    assert not dropped.held[2]


def test_push_moves_a_block_with_the_hand(cases: Run):
    """Claim: a push shoves a block straight ahead, as far as the finger passes first contact; one
    that misses leaves a block where it is."""
    run = cases.case("push")
    moved = run.after.position[0] - run.scene.position[0]
    finger, face = 0.012, 0.06 - 0.025  # m ahead of the place: fingers' front, the cube's near face
    np.testing.assert_allclose(moved, [0.10 - (face - finger), 0.0, 0.0], atol=0.006)
    np.testing.assert_allclose(run.after.position[2], run.scene.position[2], atol=0.001)
    assert run.trace.touched
    miss = cases.case("miss")
    assert not miss.trace.touched
    np.testing.assert_allclose(miss.after.position, miss.scene.position, atol=0.001)


def test_parked_blocks_never_move(cases: Run):
    """Claim: a block out of play stays at its place, at rest and out, whatever happens."""
    parked = ~cases.scene.in_play
    assert parked.sum() > 10
    np.testing.assert_array_equal(cases.after.in_play, cases.scene.in_play)
    places = np.broadcast_to(scene_state.parking(3), cases.scene.position.shape)
    np.testing.assert_array_equal(cases.after.position[parked], places[parked])
    assert not cases.after.velocity[parked].any()
    sane = np.isfinite(cases.trace.rise).all(axis=1)
    assert not cases.trace.rise[parked & sane[:, None]].any()  # nor on the way


def test_failed_physics_is_flagged_alone(cases: Run):
    """Claim: `healthy` is false for a scene that went NaN, and for no other one; a block kicked at
    1 km/s leaves the table; one that spins at 250 rad/s is held to the speed limit; no contact slot
    was missing."""
    health = np.asarray(jax.vmap(simulation.healthy)(cases.after))
    assert not simulation.healthy(cases.case("nan").after)
    assert health.sum() == len(health) - 1
    kicked = cases.case("kicked").after
    inside = scene_state.inside(kicked.position, 0.448)
    assert (kicked.in_play & ~inside).any()
    assert (np.abs(cases.case("spinning").after.velocity) <= scene_state.SPEED_LIMIT).all()
    assert not cases.trace.contact_overflow.any()


@functools.cache
def _grasped(gripper: str, physics: PhysicsKind) -> tuple[SceneState, Trace, int]:
    """Grasps the cube: the scene after it, the trace and the outcome."""
    cfg = presets.get("quick").change(
        scene={"slots": ("box",), "min_blocks": 1},
        sim={"gripper": gripper, "physics": physics, "geom_pairs": 4, "contacts": 16},
    )
    engine = simulation.make(model.build(cfg.scene, cfg.sim), cfg.sim)
    scene = scene_state.parked(("box",)).replace(
        position=np.array([[*PLACE, HALF]], np.float32),
        half_size=np.full((1, 3), HALF, np.float32),
        in_play=np.array([True]),
    )
    height = jnp.zeros((64, 64)).at[24:31, 31:38].set(2.0 * HALF)
    run = jax.jit(lambda *inputs: simulation.execute(engine, cfg, *inputs))
    action = Action.grasp(*PLACE, 0.0)
    after, trace, plan = run(jax.tree.map(jnp.asarray, scene), height, action)
    rise = plan.start[2] - jnp.min(plan.control[:, 2])
    return after, trace, int(outcome.grasp_outcome(trace, plan.surface, rise))


@pytest.mark.parametrize("gripper", grippers.shipped())
@pytest.mark.parametrize("physics", ["c", pytest.param("mjx", marks=pytest.mark.slow), WARP])
def test_gripper_lifts_a_cube(gripper: str, physics: PhysicsKind):
    """Claim: each gripper lifts a cube, the gap tells its width to 6 mm (pads and couplings give
    way), and the cube ends within 3 mm, the gap within 1 mm, of C MuJoCo's."""
    after, trace, result = _grasped(gripper, physics)
    assert result == Outcome.LIFTED
    assert trace.gap_end == pytest.approx(2.0 * HALF, abs=0.006)
    assert after.position[0, 2] > 0.1
    in_c, trace_c, _ = _grasped(gripper, "c")
    np.testing.assert_allclose(after.position, in_c.position, atol=0.003)
    assert trace.gap_end == pytest.approx(float(trace_c.gap_end), abs=0.001)
