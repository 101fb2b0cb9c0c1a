"""C MuJoCo as the reference: its fast loop against a slow one, and the threads that share it."""

import concurrent.futures
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax.sim import c_physics
from csac_jax.sim.c_physics import CPhysics, Trajectory
from csac_jax.world import model, scene_state
from tests.sim import conftest, slow_loop

pytestmark = pytest.mark.mjx


@pytest.fixture(scope="module")
def pushed(c_world: model.World) -> tuple:
    """A scene of a cube in the way of a push, and the joints' way through that push."""
    cfg = conftest.CONFIG
    scene = conftest.place(cube=(0.06, 0.0, 0.0))
    action = jax.tree.map(jnp.asarray, conftest.push(0.0, 0.0))
    fields = jax.device_get(model.scene_fields(c_world, scene))
    return scene, fields, conftest.planned(cfg, np.zeros((cfg.heightmap.size,) * 2), action)


def _assert_equal(ours: Trajectory, theirs: Trajectory) -> None:
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


def _fields(world: model.World, scene: scene_state.SceneState) -> model.BlockFields:
    return jax.device_get(model.scene_fields(world, scene))


def test_trajectory_goes_the_way_of_the_run(world, c_world: model.World, pushed: tuple):
    """Claim: a trajectory has every substep; its last is the end of a run, bit for bit. A world of
    MJX, without touch sensors, moves in C as one that was built for C, but is refused as physics.
    """
    scene, fields, joints = pushed
    by_mjx = c_physics.trajectory(world, fields, scene, joints)
    with pytest.raises(ValueError, match=r"no touch sensors; build it with sim\.physics c"):
        CPhysics(world, conftest.CONFIG.sim)
    recorded = c_physics.trajectory(c_world, fields, scene, joints)
    np.testing.assert_array_equal(recorded.qpos, by_mjx.qpos)
    after, trace = jax.jit(CPhysics(c_world, conftest.CONFIG.sim).run)(scene, joints)
    assert recorded.qpos.shape == (len(joints.control), c_world.model.nq)
    last = recorded.qpos[-1][c_world.block_qpos[0, :3]].astype(np.float32)
    np.testing.assert_array_equal(last, after.position[0])
    moved = recorded.qpos[:, c_world.block_qpos[0, 0]]
    assert trace.touched
    assert moved[0] < 0.061 < moved[-1] - 0.04
    assert (np.diff(moved) > -1e-4).all()  # never back


def test_touches_are_those_of_every_contact(c_world: model.World, pushed: tuple):
    """Claim: a hand geom touches a block in any contact deeper than 0, in either order."""
    scene, fields, joints = pushed
    substeps_with_touch = 0
    for data in slow_loop.substeps(c_world, fields, scene, joints):
        wanted = np.zeros((3, len(c_world.slots)), bool)
        for i in range(data.ncon):
            contact = data.contact[i]
            for hand, other in (contact.geom, contact.geom[::-1]):
                is_touch = c_world.slot_of_geom[other] >= 0 and contact.dist < 0.0
                if hand in c_world.hand_geoms and is_touch:
                    wanted[list(c_world.hand_geoms).index(hand), c_world.slot_of_geom[other]] = True
        np.testing.assert_array_equal(data.sensordata.reshape(wanted.shape) > 0.0, wanted)
        substeps_with_touch += wanted.any()
    assert substeps_with_touch > 20


def test_scenes_of_a_batch_do_not_meet(c_world: model.World, pushed: tuple):
    """Claim: in a batch each scene ends as its own slow loop does; one with NaN stays as it is."""
    scene, _, joints = pushed
    large = dataclasses.replace(scene, half_size=1.1 * np.asarray(scene.half_size))
    spun = dataclasses.replace(scene, velocity=np.array(scene.velocity))
    spun.velocity[0, 3:] = [0.0, 0.0, 250.0]
    nowhere = np.where(np.arange(3) == 2, np.nan, scene.position).astype(np.float32)
    broken = dataclasses.replace(scene, position=nowhere)
    scenes = jax.tree.map(lambda *leaves: np.stack(leaves), scene, large, spun, broken, scene)
    batch = jax.tree.map(lambda leaf: np.stack([leaf] * 5), joints)
    run = jax.jit(jax.vmap(CPhysics(c_world, conftest.CONFIG.sim).run))
    after, _ = run(scenes, batch)
    ends = []
    for i, one in {0: scene, 1: large, 2: spun, 4: scene}.items():
        fields = _fields(c_world, one)
        end = slow_loop.trajectory(c_world, fields, one, joints).qpos[-1]
        ends.append(end[c_world.block_qpos[0]].astype(np.float32))
        pose = np.concatenate([after.position[i, 0], after.quaternion[i, 0]])
        np.testing.assert_array_equal(pose, ends[-1])
    assert len({tuple(end) for end in ends}) == 3
    np.testing.assert_array_equal(after.position[3, 0], broken.position[0])


@pytest.mark.parametrize("metres", [0.02, 0.1, 0.3])
def test_limit_of_speed_is_held_after_every_substep(
    c_world: model.World, pushed: tuple, monkeypatch: pytest.MonkeyPatch, metres: float
):
    """Claim: MuJoCo's interrupted loop gives the bits of one that limits speed each substep."""
    scene, fields, joints = pushed
    limit = np.array([metres] * 3 + [10.0 * metres] * 3, np.float32)
    monkeypatch.setattr(scene_state, "SPEED_LIMIT", limit)
    wanted = slow_loop.trajectory(c_world, fields, scene, joints)
    at_limit = (np.abs(wanted.qvel[:, c_world.block_dofs[0]]) == limit).any(axis=1)
    assert at_limit.any()
    assert (at_limit[:-1] & ~at_limit[1:]).any()  # and below it again
    _assert_equal(c_physics.trajectory(c_world, fields, scene, joints), wanted)


def test_simulators_are_used_again(
    c_world: model.World, pushed: tuple, monkeypatch: pytest.MonkeyPatch
):
    """Claim: calls leave nothing behind: other sizes, parked blocks, two at the same time."""
    scene, _, joints = pushed
    half = np.asarray(scene.half_size)
    larger = [dataclasses.replace(scene, half_size=k * half) for k in (1.0, 1.1, 1.2)]
    rows = [(one, _fields(c_world, one), joints) for one in larger]
    wanted = [slow_loop.trajectory(c_world, fields, one, joints) for one, fields, _ in rows]
    monkeypatch.setattr(c_physics.os, "sched_getaffinity", lambda _: range(3))
    physics = CPhysics(c_world, conftest.CONFIG.sim)

    def one(row: tuple) -> Trajectory:
        with physics._simulator() as simulator:
            return simulator.rollout(*row)

    def check(chosen: list[int]) -> None:
        recorded = physics._threads.map(one, [rows[i] for i in chosen])
        for i, trajectory in zip(chosen, recorded, strict=True):
            _assert_equal(trajectory, wanted[i])

    for chosen in ([0], [2, 1, 0], [1], [0, 2]):
        check(chosen)
    list(
        physics._threads.map(one, [(conftest.place(prism=(-0.1, 0.1, 0)), rows[0][1], joints)] * 3)
    )
    check([0])
    with concurrent.futures.ThreadPoolExecutor() as threads:
        list(threads.map(check, [[0, 1, 2], [2, 0], [1]] * 4))


def test_nothing_to_move(c_world: model.World, pushed: tuple, capfd: pytest.CaptureFixture):
    """Claim: an empty table, an unreachable plan and set-points of NaN, as networks of NaN plan
    them, leave the scene as it is and the trace blank, without a word."""
    scene, fields, joints = pushed
    cleared = dataclasses.replace(scene, in_play=np.zeros(len(c_world.slots), bool))
    unreachable = dataclasses.replace(joints, reachable=np.array(False))
    lost = dataclasses.replace(joints, control=np.full_like(joints.control, np.nan))
    assert c_physics.trajectory(c_world, fields, scene, unreachable).qpos.shape[0] == 0
    physics = CPhysics(c_world, conftest.CONFIG.sim)
    for its, way in ((cleared, joints), (scene, unreachable), (scene, lost)):
        row = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (its, fields, way))
        after, seen = physics._run_batch(*row)
        jax.tree.map(np.testing.assert_array_equal, after, row[0])
        assert not any(leaf.any() for leaf in jax.tree.leaves(seen))
        _, trace = jax.jit(physics.run)(its, way)
        assert not any(np.any(leaf) for leaf in jax.tree.leaves(trace))
    assert capfd.readouterr() == ("", "")
