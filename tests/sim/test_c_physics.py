"""C MuJoCo as the reference: what is filmed of it is what it does."""

import concurrent.futures
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.scene import layout, model
from csac_jax.sim import c_physics, primitives, robot
from csac_jax.sim.robot import Drive
from tests.scene import placed
from tests.sim import conftest

pytestmark = pytest.mark.mjx


@pytest.fixture(scope="module")
def pushed(c_world: model.World) -> tuple:
    """A scene of a cube in the way of a push, and the drive of that push."""
    cfg = conftest.CONFIG
    scene = conftest.place(cube=(0.06, 0.0, 0.0))
    action = jax.tree.map(jnp.asarray, conftest.push(0.0, 0.0))
    plan = primitives.plan(cfg.sim, cfg.heightmap, jnp.zeros((cfg.heightmap.size,) * 2), action)
    fields = jax.device_get(model.scene_fields(c_world, scene))
    return scene, fields, jax.device_get(robot.drive("hand", plan))


def test_film_goes_the_way_of_the_run(c_world: model.World, pushed: tuple):
    """Claim: a film has every substep, and its last is where a run leaves the blocks, bit for
    bit."""
    scene, fields, drive = pushed
    film = c_physics.film(c_world, fields, scene, drive)
    after, trace = jax.jit(c_physics.CPhysics(c_world, conftest.CONFIG.sim).run)(scene, drive)
    assert film.qpos.shape == (len(drive.control), c_world.model.nq)
    np.testing.assert_array_equal(
        film.qpos[-1][c_world.block_qpos[:, :3]].astype(np.float32)[0], after.position[0]
    )
    moved = film.qpos[:, c_world.block_qpos[0, 0]]
    assert trace.touched
    assert moved[0] < 0.061 < moved[-1] - 0.04
    assert (np.diff(moved) > -1e-4).all()  # never back


def test_film_of_what_the_robot_cannot_follow_is_empty(c_world: model.World, pushed: tuple):
    """Claim: where the robot cannot follow, nothing moves: the film has no substep."""
    scene, fields, drive = pushed
    still: Drive = dataclasses.replace(drive, reachable=np.array(False))
    film = c_physics.film(c_world, fields, scene, still)
    assert (film.qpos.shape, film.qvel.shape) == ((0, c_world.model.nq), (0, c_world.model.nv))


def test_touches_are_those_of_every_contact(c_world: model.World, pushed: tuple):
    """Claim: a hand geom touches a block where any contact of the two is deeper than 0, in either
    order."""
    scene, fields, drive = pushed
    exact, seen = model.with_blocks(c_world, fields), 0
    for data in c_physics._substeps(c_world, exact, scene, drive):
        wanted = np.zeros((3, len(c_world.slots)), bool)
        for i in range(data.ncon):
            contact = data.contact[i]
            for hand, other in (contact.geom, contact.geom[::-1]):
                if (
                    hand in c_world.hand_geoms
                    and c_world.slot_of_geom[other] >= 0
                    and contact.dist < 0.0
                ):
                    wanted[list(c_world.hand_geoms).index(hand), c_world.slot_of_geom[other]] = True
        np.testing.assert_array_equal(data.sensordata.reshape(wanted.shape) > 0.0, wanted)
        seen += wanted.any()
    assert seen > 20


def test_trace_by_hand(c_world: model.World, pushed: tuple):
    """Claim: held is what both pads touch, its rise the highest while they do; parked blocks, which
    fall, rise by 0."""
    scene, _, _ = pushed
    steps, num = 4, len(c_world.slots)
    qpos = np.zeros((steps, c_world.model.nq))
    qpos[:, c_world.block_qpos[:, 2]] = scene.position[:, 2] - 1.0
    qpos[:, c_world.block_qpos[0, 2]] = scene.position[0, 2] + [0.0, 0.02, 0.03, 0.01]
    qpos[:, c_world.robot_qpos[-2]] = [0.05, 0.04, 0.03, 0.02]
    sensed = np.zeros((steps, 3, num))
    sensed[1:3, 1, 0], sensed[0:2, 2, 0] = 2.0, 1.0  # both pads in step 1 alone
    film = c_physics.Film(qpos, np.zeros((steps, c_world.model.nv)), sensed.reshape(steps, -1))
    _, _, trace = c_physics._judge(c_world, 1, scene, film)
    assert trace.touched
    assert not trace.held.any()
    np.testing.assert_allclose(trace.held_rise[0], 0.02, atol=1e-6)
    np.testing.assert_allclose(trace.rise[0], 0.01, atol=1e-6)
    np.testing.assert_array_equal(trace.held_rise[1:], 0.0)
    np.testing.assert_array_equal(trace.rise[1:], 0.0)
    np.testing.assert_allclose([trace.gap_closed, trace.gap_end], [0.08, 0.04], atol=1e-6)


def test_scenes_of_a_batch_do_not_meet(c_world: model.World, pushed: tuple):
    """Claim: in a batch each scene ends as its own film does, one that spins too fast too; the
    physics_diverged stay as they are."""
    scene, _, drive = pushed
    large = dataclasses.replace(scene, half_size=1.1 * np.asarray(scene.half_size))
    spun = dataclasses.replace(scene, velocity=np.array(scene.velocity))
    spun.velocity[0, 3:] = [0.0, 0.0, 250.0]
    physics_diverged = dataclasses.replace(
        scene, position=np.where(np.arange(3) == 2, np.nan, scene.position).astype(np.float32)
    )
    scenes = jax.tree.map(
        lambda *leaves: np.stack(leaves), scene, large, spun, physics_diverged, scene
    )
    drives = jax.tree.map(lambda leaf: np.stack([leaf] * 5), drive)
    after, _ = jax.jit(jax.vmap(c_physics.CPhysics(c_world, conftest.CONFIG.sim).run))(
        scenes, drives
    )
    ends = []
    for i, one in {0: scene, 1: large, 2: spun, 4: scene}.items():
        film = c_physics.film(c_world, jax.device_get(model.scene_fields(c_world, one)), one, drive)
        ends.append(film.qpos[-1][c_world.block_qpos[0]].astype(np.float32))
        np.testing.assert_array_equal(
            np.concatenate([after.position[i, 0], after.quaternion[i, 0]]), ends[-1]
        )
    assert len({tuple(end) for end in ends}) == 3
    np.testing.assert_array_equal(after.position[3, 0], physics_diverged.position[0])


@pytest.mark.parametrize("metres", [0.02, 0.1, 0.3])
def test_limit_of_speed_is_held_after_every_substep(
    c_world: model.World, pushed: tuple, monkeypatch: pytest.MonkeyPatch, metres: float
):
    """Claim: MuJoCo's own loop, stopped and gone on with, gives the bits of one that limits the
    speed as it goes."""
    scene, fields, drive = pushed
    limit = np.array([metres] * 3 + [10.0 * metres] * 3, np.float32)
    monkeypatch.setattr(layout, "SPEED_LIMIT", limit)
    wanted = c_physics.film(c_world, fields, scene, drive)
    (seen,) = _roll(c_world, c_physics.Workers(c_world.model), [(scene, fields, drive)])
    places, dofs = (
        c_world.block_qpos[0],
        c_world.block_dofs[0],
    )  # the cube's: parked blocks fall in one alone
    at_limit = (np.abs(wanted.qvel[:, dofs]) == limit).any(axis=1)
    assert at_limit.any()
    assert (at_limit[:-1] & ~at_limit[1:]).any()  # and below it again
    np.testing.assert_array_equal(seen.qpos[:, places], wanted.qpos[:, places])
    np.testing.assert_array_equal(seen.qvel[:, dofs], wanted.qvel[:, dofs])
    np.testing.assert_array_equal(
        seen.qpos[:, c_world.robot_qpos], wanted.qpos[:, c_world.robot_qpos]
    )
    np.testing.assert_array_equal(seen.sensed, wanted.sensed)


def _roll(
    world: model.World, workers: c_physics.Workers, rows: list[tuple]
) -> list[c_physics.Film]:
    """The films of scenes, each in a room that a thread finds."""

    def film(row: tuple) -> c_physics.Film:
        with workers.room() as room:
            return c_physics._roll(world, room, *row)

    return workers.each(film, rows)


def test_workers_are_used_again(
    c_world: model.World, pushed: tuple, monkeypatch: pytest.MonkeyPatch
):
    """Claim: calls leave nothing behind: small ones after large ones, and two at the same time,
    give the same bits.

    Nor does a scene in which the cube is out of play, and meets nothing.
    """
    scene, _, drive = pushed
    larger = [
        dataclasses.replace(scene, half_size=k * np.asarray(scene.half_size))
        for k in (1.0, 1.1, 1.2)
    ]
    rows = [(one, jax.device_get(model.scene_fields(c_world, one)), drive) for one in larger]
    place = c_world.block_qpos[0]
    wanted = [c_physics.film(c_world, its, one, drive).qpos[:, place] for one, its, _ in rows]
    monkeypatch.setattr(c_physics.os, "sched_getaffinity", lambda _: range(3))
    roll = functools.partial(_roll, c_world, c_physics.Workers(c_world.model))

    def check(chosen: list[int]) -> None:
        for i, film in zip(chosen, roll([rows[i] for i in chosen]), strict=True):
            np.testing.assert_array_equal(film.qpos[:, place], wanted[i])

    for chosen in ([0], [2, 1, 0], [1], [0, 2]):
        check(chosen)
    roll([(conftest.place(prism=(-0.1, 0.1, 0.0)), rows[0][1], drive)] * 3)
    check([0])
    with concurrent.futures.ThreadPoolExecutor() as threads:
        list(threads.map(check, [[0, 1, 2], [2, 0], [1]] * 4))


def test_scenes_leave_nothing_behind_in_a_room(c_world: model.World, pushed: tuple):
    """Claim: after any scene a room's model is, byte for byte, that of a room that never saw
    another."""
    _, _, drive = pushed
    scenes = [
        conftest.place(cube=(0.06, 0.0, 0.0)),
        conftest.place(prism=(-0.1, 0.1, 0.4)),
        conftest.place(cube=(0.06, 0.0, 0.0), other=(-0.1, 0.0, 0.0), prism=(0.0, 0.1, 0.0)),
    ]
    scenes.append(dataclasses.replace(scenes[2], half_size=1.1 * np.asarray(scenes[2].half_size)))
    rows = [(one, jax.device_get(model.scene_fields(c_world, one)), drive) for one in scenes]

    def after(workers: c_physics.Workers, row: tuple) -> bytes:
        with workers.room() as room:
            c_physics._roll(c_world, room, *row)
            return placed.model_bytes(room.exact)

    wanted = [after(c_physics.Workers(c_world.model), row) for row in rows]
    assert len(set(wanted)) == len(rows)
    used = c_physics.Workers(c_world.model)
    for i in (0, 1, 2, 3, 2, 1, 3, 0, 2, 0):
        assert after(used, rows[i]) == wanted[i]


def test_world_of_mjx_is_refused(world: model.World):
    """Claim: a world without touch sensors is one line that says how to build another."""
    with pytest.raises(ValueError, match=r"no touch sensors; build it with sim\.physics c"):
        c_physics.CPhysics(world, conftest.CONFIG.sim)


def test_nothing_to_move(c_world: model.World, pushed: tuple):
    """Claim: an empty table and a drive that the robot cannot follow leave the scene as it is, with
    a blank trace."""
    scene, fields, drive = pushed
    workers = c_physics.Workers(c_world.model)
    cleared = dataclasses.replace(scene, in_play=np.zeros(len(c_world.slots), bool))
    still = dataclasses.replace(drive, reachable=np.array(False))
    for its, his in ((cleared, drive), (scene, still)):
        one = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (its, fields, his))
        pose, velocity, trace = jax.tree.map(
            lambda leaf: leaf[0], c_physics._run_batch(c_world, workers, 109, *one)
        )
        np.testing.assert_array_equal(
            pose, np.concatenate([scene.position, scene.quaternion], axis=1)
        )
        np.testing.assert_array_equal(velocity, scene.velocity)
        assert not trace.touched
        assert trace.gap_end == 0.0
