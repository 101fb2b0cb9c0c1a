"""C MuJoCo as the reference: what is filmed of it is what it does."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.scene import model
from csac_jax.sim import c_physics, primitives, robot
from csac_jax.sim.robot import Drive
from tests.sim import conftest

pytestmark = pytest.mark.mjx


@pytest.fixture(scope="module")
def pushed(world: model.World) -> tuple:
    """A scene of a cube in the way of a push, and the drive of that push."""
    cfg = conftest.CONFIG
    scene = conftest.place(cube=(0.06, 0.0, 0.0))
    action = jax.tree.map(jnp.asarray, conftest.push(0.0, 0.0))
    plan = primitives.plan(cfg.sim, cfg.heightmap, jnp.zeros((cfg.heightmap.size,) * 2), action)
    fields = jax.device_get(model.scene_fields(world, scene))
    return scene, fields, jax.device_get(robot.drive("hand", plan))


def test_film_goes_the_way_of_the_run(world: model.World, pushed: tuple):
    """Claim: a film has every substep, and its last is where a run leaves the blocks, bit for bit."""
    scene, fields, drive = pushed
    film = c_physics.film(world, fields, scene, drive)
    after, trace = jax.jit(c_physics.CPhysics(world, conftest.CONFIG.sim).run)(scene, drive)
    assert film.qpos.shape == (len(drive.control), world.model.nq)
    np.testing.assert_array_equal(film.qpos[-1][world.block_qpos[:, :3]].astype(np.float32)[0], after.position[0])
    moved = film.qpos[:, world.block_qpos[0, 0]]
    assert trace.touched
    assert moved[0] < 0.061 < moved[-1] - 0.04
    assert (np.diff(moved) > -1e-4).all()  # never back


def test_film_of_what_the_robot_cannot_follow_is_empty(world: model.World, pushed: tuple):
    """Claim: where the robot cannot follow, nothing moves: the film has no substep."""
    scene, fields, drive = pushed
    still: Drive = dataclasses.replace(drive, reachable=np.array(False))
    film = c_physics.film(world, fields, scene, still)
    assert (film.qpos.shape, film.qvel.shape) == ((0, world.model.nq), (0, world.model.nv))


def test_touches_are_those_of_every_contact(world: model.World, pushed: tuple):
    """Claim: a hand geom touches a block where any contact of the two is deeper than 0, in either order."""
    scene, fields, drive = pushed
    exact = model.with_blocks(world, fields)
    row_of_geom = np.full(world.model.ngeom, -1)
    row_of_geom[world.hand_geoms] = np.arange(3)
    seen = 0
    for data in c_physics._substeps(world, exact, scene, drive):
        wanted = np.zeros((3, len(world.slots)), bool)
        for i in range(data.ncon):
            contact = data.contact[i]
            for hand, other in (contact.geom, contact.geom[::-1]):
                if hand in world.hand_geoms and world.slot_of_geom[other] >= 0 and contact.dist < 0.0:
                    wanted[list(world.hand_geoms).index(hand), world.slot_of_geom[other]] = True
        np.testing.assert_array_equal(c_physics._touching(world, row_of_geom, data), wanted)
        seen += wanted.any()
    assert seen > 20


def test_touches_by_hand(world: model.World):
    """Claim: contacts count in either order, not those that are only near, nor those of hand and table or of blocks."""
    row_of_geom = np.full(world.model.ngeom, -1)
    row_of_geom[world.hand_geoms] = np.arange(3)
    (palm, low, high), block, table = world.hand_geoms, world.block_geoms, world.model.geom("table").id
    pairs = [[palm, block[0]], [block[1], low], [high, block[2]], [low, table], [block[0], block[1]]]
    contact = SimpleNamespace(geom=np.array(pairs), dist=np.array([-1e-3, -1e-4, 1e-4, -1e-3, -1e-3]))
    wanted = np.zeros((3, len(world.slots)), bool)
    wanted[0, world.slot_of_geom[block[0]]] = wanted[1, world.slot_of_geom[block[1]]] = True
    data: Any = SimpleNamespace(contact=contact)
    np.testing.assert_array_equal(c_physics._touching(world, row_of_geom, data), wanted)


def test_nothing_to_move(world: model.World, pushed: tuple):
    """Claim: an empty table and a drive that the robot cannot follow leave the scene as it is, with a blank trace."""
    scene, fields, drive = pushed
    cleared = dataclasses.replace(scene, in_play=np.zeros(len(world.slots), bool))
    still = dataclasses.replace(drive, reachable=np.array(False))
    for its, his in ((cleared, drive), (scene, still)):
        pose, velocity, trace = c_physics._run(world, 109, its, fields, his)
        np.testing.assert_array_equal(pose, np.concatenate([scene.position, scene.quaternion], axis=1))
        np.testing.assert_array_equal(velocity, scene.velocity)
        assert not trace.touched
        assert trace.gap_end == 0.0
