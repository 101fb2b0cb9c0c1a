"""Primitives in MJX: its model of a scene, and agreement with C MuJoCo; bounds of health."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from csac_jax.baselines import oracle
from csac_jax.config import MESH_KINDS, Config, SceneConfig
from csac_jax.sim import mjx_physics, outcome, physics as simulation
from csac_jax.world import model, scene_state
from tests.sim import conftest

pytestmark = pytest.mark.mjx


def _outcomes(run, trace=None) -> np.ndarray:
    """Outcomes by ground truth of a batch of runs, or of other traces of the same plans."""
    judge = jax.vmap(outcome.grasp_outcome)
    return np.asarray(judge(trace or run.trace, run.plan.surface, run.hand_rise))


def test_programs_keep_their_precision_and_ask_no_host(world):
    """Claim: no matrix product of physics or planner runs at a GPU's reduced precision; MJX itself
    asks for HIGH, three passes of the reduced one, in its box collisions. Nothing in it calls the
    host."""
    config = conftest.CONFIG
    scene = jax.tree.map(jnp.asarray, scene_state.parked(config.scene.slots))
    height = jnp.zeros((config.heightmap.size,) * 2)
    engine = mjx_physics.MjxPhysics(world, config.sim)

    def act(scene, height):
        action = oracle.grasp(config, scene, height)
        return simulation.execute(engine, config, scene, height, action)

    text = str(jax.make_jaxpr(act)(scene, height))
    products = re.findall(r"dot_general\[(.*?)\n *\] ", text, re.DOTALL)
    assert len(products) > 10
    assert all("precision=(Precision.HIGH" in product for product in products)
    assert not any(word in text for word in ("callback", "infeed", "outfeed", "debug_print"))


@pytest.mark.parametrize(
    ("field", "slot", "bad", "good"),
    [
        ("position", 0, (np.nan, 101.0), (3.0,)),  # thrown
        ("position", 1, (101.0,), (3.0,)),  # parked
        ("velocity", 0, (25.0, -25.0, np.inf), (15.0,)),
        ("quaternion", 0, (np.nan, 0.2), ()),
        ("quaternion", 1, (), (1e-4,)),
        ("half_size", 0, (0.0, 1e6), (0.3,)),
        ("half_size", 1, (np.nan,), ()),
        ("density", 1, (np.nan, np.inf, 1e6, 0.0, -1.0), (3000.0,)),
        ("friction", 1, (np.nan, np.inf, 1e6, 0.0, -1.0), (2.0,)),
        ("colour", 1, (-1, 10, 1_000_000), (9,)),
        ("target", (), (-2, -(2**31), 2, 1_000_000), (-1, 0, 1)),
    ],
)
def test_healthy_bounds(field: str, slot: int | tuple, bad: tuple, good: tuple):
    """Claim: healthy = finite, slower than 20 m/s, within 100 m of the origin, of unit
    quaternion, of a block's size, density, friction and colour, and the target a slot or ANY."""
    scene = jax.tree.map(jnp.asarray, scene_state.parked(("box", "box")))
    scene = scene.replace(position=jnp.zeros((2, 3)), in_play=jnp.array([True, False]))
    assert simulation.healthy(scene)
    place = (slot, 2) if getattr(scene, field).ndim > 1 else slot
    for value in (*bad, *good):
        changed = getattr(scene, field).at[place].set(value)
        assert simulation.healthy(scene.replace(**{field: changed})) == (value in good), value


@pytest.mark.parametrize("scale", [0.9, 1.1])
def test_meshes_are_as_large_as_the_blocks(scale: float):
    """Claim: corners and faces that MJX collides span the block's bounding box at any size."""
    config = Config(scene=SceneConfig(slots=MESH_KINDS, min_blocks=1))
    world = model.build(config.scene, config.sim)
    scene = scene_state.parked(config.scene.slots)
    scene = scene.replace(half_size=scene.half_size * np.float32(scale))
    scaled = mjx_physics.scene_model(mjx_physics.MjxPhysics(world, config.sim), scene)
    for slot, geom in enumerate(world.block_geoms):
        mesh = scaled._impl.mesh_convex[world.model.geom_dataid[geom]]
        turn = Rotation.from_quat(world.model.geom_quat[geom], scalar_first=True)
        for corners in (np.asarray(mesh.vert), np.asarray(mesh.face).reshape(-1, 3)):
            placed = turn.apply(corners) + np.asarray(scaled.geom_pos[geom])
            np.testing.assert_allclose(placed.max(axis=0), scene.half_size[slot], atol=1e-6)
            np.testing.assert_allclose(placed.min(axis=0), -scene.half_size[slot], atol=1e-6)


def test_all_that_follows_from_blocks_is_the_scenes():
    """Claim: all numbers that C MuJoCo derives from a scene's blocks, MJX's model of it has too.

    Except `dof_M0` and `light_poscom0`, which MJX does not read, `geom_aabb`, which bounds the
    largest block, and corners of meshes, which MJX scales in its own arrays (above).
    """
    slots = ("box", "arch", *MESH_KINDS)
    config = Config(scene=SceneConfig(slots=slots, min_blocks=1))
    world, rng = model.build(config.scene, config.sim), np.random.default_rng(0)
    scene = scene_state.parked(slots)
    scene = scene.replace(
        half_size=scene.half_size * rng.uniform(0.9, 1.1, (len(slots), 1)).astype(np.float32),
        density=rng.uniform(450.0, 900.0, len(slots)).astype(np.float32),
        friction=rng.uniform(0.5, 1.0, len(slots)).astype(np.float32),
    )
    ours = mjx_physics.scene_model(mjx_physics.MjxPhysics(world, config.sim), scene)
    exact = model.with_blocks(world, jax.device_get(model.scene_fields(world, scene)))
    changed = set()
    for field in dataclasses.fields(ours):
        wanted, nominal = getattr(exact, field.name, None), getattr(world.model, field.name, None)
        is_float = isinstance(wanted, np.ndarray) and wanted.dtype.kind == "f"
        if is_float and not np.array_equal(wanted, nominal):
            changed.add(field.name)
            if field.name not in ("dof_M0", "light_poscom0", "geom_aabb", "mesh_vert"):
                got = np.asarray(getattr(ours, field.name)).reshape(wanted.shape)
                np.testing.assert_allclose(got, wanted, rtol=2e-5, atol=1e-7, err_msg=field.name)
    expected = {"geom_size", "body_mass", "body_subtreemass", "body_inertia", "dof_invweight0"}
    assert expected <= changed


@pytest.mark.slow
def test_grasps_agree_with_c(grasped, grasped_in_c):
    """Claim: a grasp has the same outcome in C MuJoCo in at least 95 of 100 scenes, and blocks move
    as far: to 1 mm in the median scene, 5 mm on average."""
    ours, theirs = _outcomes(grasped), _outcomes(grasped, grasped_in_c[1])
    assert len(set(theirs.tolist())) >= 3  # else agreement is cheap
    assert np.mean(ours == theirs) >= 0.95, np.stack([ours, theirs])
    play, before = grasped.scene.in_play, grasped.scene.position
    ours, theirs = (
        np.linalg.norm(end - before, axis=-1) for end in (grasped.after.position, grasped_in_c[0])
    )
    worst = np.where(play, np.abs(ours - theirs), 0.0).max(axis=1)
    assert np.median(worst) < 0.001
    assert abs(ours[play].mean() - theirs[play].mean()) < 0.005


@pytest.mark.slow
def test_contact_caps_are_wide_enough(doubled_caps):
    """Claim: twice the default contact caps give the same outcomes, and no slot was missing."""
    capped, wide = doubled_caps
    np.testing.assert_array_equal(capped.scene.position, wide.scene.position)
    np.testing.assert_array_equal(_outcomes(capped), _outcomes(wide))
    assert not capped.trace.contact_overflow.any()
