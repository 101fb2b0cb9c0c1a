"""C MuJoCo as the reference: what is filmed of it is what it does."""

import dataclasses

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
