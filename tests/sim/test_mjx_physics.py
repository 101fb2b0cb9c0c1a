"""Primitives in MJX: scripted scenes, health, and agreement with C MuJoCo."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from csac_jax.config import MESH_KINDS, Config, SceneConfig
from csac_jax.constants import Outcome
from csac_jax.scene import layout, model
from csac_jax.sim import c_physics, mjx_physics, oracle, outcome, physics as simulation, primitives

pytestmark = pytest.mark.mjx

CONFIG = Config()


def _outcomes(run, trace=None) -> np.ndarray:
    """Outcomes by ground truth of a batch of runs, or of other traces of the same plans."""
    return np.asarray(
        jax.vmap(outcome.grasp_outcome)(trace or run.trace, run.plan.surface, run.hand_rise)
    )


@pytest.mark.parametrize("level", list(Outcome), ids=lambda level: level.name.lower())
def test_every_outcome_is_reached(executed, level: Outcome):
    """Claim: physics reaches all five levels of a grasp (CSAC eq. 15), with the block set as it
    is."""
    run = executed.case(level.name.lower())
    assert simulation.healthy(run.after)
    assert outcome.grasp_outcome(run.trace, run.plan.surface, run.hand_rise) == level


def test_lifted_block_alone_hangs_in_the_hand(executed):
    """Claim: after a grasp the lifted block is still in play and hangs at the hand's height; the
    other one lies."""
    run = executed.case("lifted")
    np.testing.assert_array_equal(run.after.in_play, [True, True, False])
    np.testing.assert_array_equal(
        outcome.lifted_blocks(run.trace, run.hand_rise), [True, False, False]
    )
    rise = run.after.position[:, 2] - run.scene.position[:, 2]
    np.testing.assert_allclose(rise[:2], [run.hand_rise, 0.0], atol=0.005)
    assert abs(run.trace.gap_end - 0.05) < 0.005  # the cube's width


def test_dropped_block_lies_again(executed):
    """Claim: a dropped block rose by more than a centimetre and ends on the table."""
    run = executed.case("dropped")
    assert run.trace.held_rise[2] >= outcome.GRIP_RISE
    assert abs(run.trace.rise[2]) < 0.01
    assert not run.trace.held[2]


def test_push_moves_a_block_with_the_hand(executed):
    """Claim: a push shoves what stands in its way as far as the finger goes beyond first contact,
    straight ahead."""
    run = executed.case("push")
    moved = run.after.position[0] - run.scene.position[0]
    finger, face = (
        0.012,
        0.06 - 0.025,
    )  # m ahead of the place: closed fingers' front, the cube's near face
    np.testing.assert_allclose(moved, [0.10 - (face - finger), 0.0, 0.0], atol=0.006)
    np.testing.assert_allclose(run.after.position[2], run.scene.position[2], atol=0.001)
    assert run.trace.touched


def test_push_that_misses_moves_nothing(executed):
    """Claim: a push beside a block leaves it where it is."""
    run = executed.case("miss")
    assert not run.trace.touched
    np.testing.assert_allclose(run.after.position, run.scene.position, atol=0.001)


def test_parked_blocks_never_move(executed):
    """Claim: a block that is out of play stays at its place, at rest, whatever happens in the
    scene, and stays out."""
    parked = ~executed.scene.in_play
    assert parked.sum() > 10
    np.testing.assert_array_equal(executed.after.in_play, executed.scene.in_play)
    places = np.broadcast_to(layout.parking(3), executed.scene.position.shape)
    np.testing.assert_array_equal(executed.after.position[parked], places[parked])
    assert not executed.after.velocity[parked].any()
    sane = np.isfinite(executed.trace.rise).all(axis=1)
    assert not executed.trace.rise[parked & sane[:, None]].any()  # nor on the way


def test_failed_physics_is_flagged_alone(executed):
    """Claim: `healthy` is false for a scene that went NaN or exploded, and true for every other one
    of the batch."""
    health = np.asarray(jax.vmap(simulation.healthy)(executed.after))
    names = ["nan", "exploded"]
    assert np.isfinite(executed.case("exploded").after.position).all()  # bounds, not isnan
    for name in names:
        assert not simulation.healthy(executed.case(name).after)
    assert health.sum() == len(health) - len(names)


def test_products_keep_their_precision(config, world):
    """Claim: no product of matrices of the physics or the planner runs at a GPU's reduced
    precision.

    MJX itself asks for HIGH, three passes of the reduced one, in its box collisions.
    """
    scene = jax.tree.map(jnp.asarray, layout.parked(config.scene.slots))
    height = jnp.zeros((config.heightmap.size,) * 2)
    engine = simulation.make(world, config.sim)

    def act(scene, height):
        action = oracle.grasp(config, scene, height)
        return simulation.execute(engine, config, scene, height, action)

    text = str(jax.make_jaxpr(act)(scene, height))
    products = re.findall(r"dot_general\[(.*?)\n *\] ", text, re.DOTALL)
    assert len(products) > 10
    assert all("precision=(Precision.HIGH" in product for product in products)


def test_fast_spin_does_not_blow_up(executed, c_world):
    """Claim: a thin block that comes in spinning at 250 rad/s is held to the speed limit, in MJX
    and in C."""
    run = executed.case("spinning")
    joints = primitives.joint_trajectory(CONFIG.sim, run.plan)
    end, _ = c_physics.CPhysics(c_world, CONFIG.sim).run(run.scene, joints)
    for after in (run.after, end):
        assert simulation.healthy(after)
        assert (np.abs(after.velocity) <= layout.SPEED_LIMIT).all()


@pytest.mark.parametrize(
    ("field", "value", "slot", "good"),
    [
        ("position", np.nan, 0, False),
        ("position", 1.1, 0, False),
        ("position", 3.0, 1, True),  # parked
        ("velocity", 25.0, 0, False),
        ("velocity", -25.0, 0, False),
        ("velocity", 15.0, 0, True),
        ("velocity", np.inf, 0, False),
        ("quaternion", np.nan, 0, False),
        ("quaternion", 0.2, 0, False),
        ("quaternion", 1e-4, 1, True),
        ("position", 101.0, 1, False),
        ("half_size", np.nan, 1, False),
        ("half_size", 0.0, 0, False),
        ("half_size", 1e6, 0, False),
        ("half_size", 0.3, 0, True),
    ],
)
def test_healthy_bounds(field: str, value: float, slot: int, good: bool):
    """Claim: healthy = finite, slower than 20 m/s, within 1 m of the origin if in play, of unit
    quaternion and of a block's size."""
    scene = jax.tree.map(jnp.asarray, layout.parked(("box", "box")))
    scene = scene.replace(position=jnp.zeros((2, 3)), in_play=jnp.array([True, False]))
    assert simulation.healthy(scene)
    changed = getattr(scene, field).at[slot, 2].set(value)
    assert simulation.healthy(dataclasses.replace(scene, **{field: changed})) == good


@pytest.mark.parametrize(
    ("field", "value", "good"),
    [
        *(
            (field, value, False)
            for field in ("density", "friction")
            for value in (np.nan, np.inf, 1e6, 0.0, -1.0)
        ),
        ("density", 3000.0, True),
        ("friction", 2.0, True),
        *(("colour", value, False) for value in (-1, 10, 1_000_000)),
        ("colour", 9, True),
    ],
)
def test_healthy_materials(field: str, value: float, good: bool):
    """Claim: a healthy scene has densities and frictions of solid things, and colours that there
    are."""
    scene = jax.tree.map(jnp.asarray, layout.parked(("box", "box")))
    changed = getattr(scene, field).at[1].set(value)
    assert simulation.healthy(dataclasses.replace(scene, **{field: changed})) == good


@pytest.mark.parametrize("scale", [0.9, 1.1])
def test_meshes_are_as_large_as_the_blocks(scale: float):
    """Claim: corners and faces that MJX collides span the block's bounding box, whatever its size
    in the scene."""
    config = dataclasses.replace(CONFIG, scene=SceneConfig(slots=MESH_KINDS, min_blocks=1))
    world = model.build(config.scene, config.sim)
    scene = layout.parked(config.scene.slots)
    scene = scene.replace(half_size=scene.half_size * np.float32(scale))
    scaled = mjx_physics.scene_model(mjx_physics.make(world, config.sim), scene)
    for slot, geom in enumerate(world.block_geoms):
        mesh = scaled._impl.mesh_convex[world.model.geom_dataid[geom]]
        turn = Rotation.from_quat(world.model.geom_quat[geom], scalar_first=True)
        for corners in (np.asarray(mesh.vert), np.asarray(mesh.face).reshape(-1, 3)):
            placed = turn.apply(corners) + np.asarray(scaled.geom_pos[geom])
            np.testing.assert_allclose(placed.max(axis=0), scene.half_size[slot], atol=1e-6)
            np.testing.assert_allclose(placed.min(axis=0), -scene.half_size[slot], atol=1e-6)


def test_all_that_follows_from_blocks_is_the_scenes():
    """Claim: whatever numbers of its model C MuJoCo derives from a scene's blocks, MJX's model of
    the scene has too.

    Not `dof_M0`, `light_poscom0` and `geom_aabb`, the first two of which neither engine of MJX
    reads and the last of which bounds the largest block, nor corners of meshes, which MJX scales in
    arrays of its own (above).
    """
    slots = ("box", "arch", *MESH_KINDS)
    config = dataclasses.replace(CONFIG, scene=SceneConfig(slots=slots, min_blocks=1))
    world, rng = model.build(config.scene, config.sim), np.random.default_rng(0)
    scene = layout.parked(slots)
    scene = scene.replace(
        half_size=scene.half_size * rng.uniform(0.9, 1.1, (len(slots), 1)).astype(np.float32),
        density=rng.uniform(450.0, 900.0, len(slots)).astype(np.float32),
        friction=rng.uniform(0.5, 1.0, len(slots)).astype(np.float32),
    )
    ours = mjx_physics.scene_model(mjx_physics.make(world, config.sim), scene)
    exact = model.with_blocks(world, jax.device_get(model.scene_fields(world, scene)))
    changed = set()
    for field in dataclasses.fields(ours):
        wanted, nominal = getattr(exact, field.name, None), getattr(world.model, field.name, None)
        if (
            isinstance(wanted, np.ndarray)
            and wanted.dtype.kind == "f"
            and not np.array_equal(wanted, nominal)
        ):
            changed.add(field.name)
            if field.name not in ("dof_M0", "light_poscom0", "geom_aabb", "mesh_vert"):
                got = np.asarray(getattr(ours, field.name)).reshape(wanted.shape)
                np.testing.assert_allclose(got, wanted, rtol=2e-5, atol=1e-7, err_msg=field.name)
    assert {
        "geom_size",
        "body_mass",
        "body_subtreemass",
        "body_inertia",
        "dof_invweight0",
    } <= changed


def test_no_contact_was_dropped(executed):
    """Claim: with few blocks the contact slots are never all in use."""
    assert not executed.trace.contact_overflow.any()


def test_grasps_agree_with_c(grasped, grasped_in_c):
    """Claim: the same grasp of the same scene ends the same in C MuJoCo, in at least 95 of 100."""
    ours, theirs = _outcomes(grasped), _outcomes(grasped, grasped_in_c[1])
    assert len(set(theirs.tolist())) >= 3  # else agreement is cheap
    assert np.mean(ours == theirs) >= 0.95, np.stack([ours, theirs])


def test_displacements_agree_with_c(grasped, grasped_in_c):
    """Claim: blocks move as far as in C MuJoCo: within 1 mm in the median scene, within 5 mm on
    average."""
    play, before = grasped.scene.in_play, grasped.scene.position
    ours, theirs = (
        np.linalg.norm(end - before, axis=-1) for end in (grasped.after.position, grasped_in_c[0])
    )
    worst = np.where(play, np.abs(ours - theirs), 0.0).max(axis=1)
    assert np.median(worst) < 0.001
    assert abs(ours[play].mean() - theirs[play].mean()) < 0.005


@pytest.mark.slow
def test_contact_caps_are_wide_enough(doubled_caps):
    """Claim: twice the contact caps of the default configuration give the same outcomes, and no
    slot was wanting."""
    capped, wide = doubled_caps
    np.testing.assert_array_equal(capped.scene.position, wide.scene.position)
    np.testing.assert_array_equal(_outcomes(capped), _outcomes(wide))
    assert not capped.trace.contact_overflow.any()
