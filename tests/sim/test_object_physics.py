"""Actions among objects of a library: what moves them, and the planner that reads their poses."""

from pathlib import Path

import jax
import numpy as np
import pytest

from csac_jax.baselines import oracle
from csac_jax.config import Config
from csac_jax.env import Env
from csac_jax.robot import primitives
from csac_jax.scenes import pool
from csac_jax.sim import c_physics, physics
from csac_jax.world import model
from csac_jax.world.scene_state import SceneState
from tests.sim.conftest import TWO_OBJECTS, bar, grasped_bar, thrown_objects
from tests.world import placed

pytestmark = pytest.mark.mjx  # ranks are promoted in `physics.healthy`
SCENE = {"slots": ("object",) * 3, "min_blocks": 3, "objects": "procedural:0:42"}
CONFIG = Config().change(
    scene=SCENE | {"drop_extent": (0.3, 0.3), "settle_time": 1.0},
    sim={"physics": "c"},
    task={"kind": "clear"},
)


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Env:
    """Six scenes of three objects side by side."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("pool")))
        scenes = pool.settled(CONFIG, 1, 6, packed=True)
    return Env(CONFIG, physics.make(model.build(CONFIG.scene, CONFIG.sim), CONFIG.sim), scenes)


@pytest.fixture(scope="module")
def stepped(env: Env):
    """The scenes before and after the planner's grasp; the same in another order, which follows."""

    @jax.jit
    @jax.vmap
    def run(scene):
        state = env.reset_to(scene)
        return state, env.step(state, oracle.grasp(CONFIG, state.scene, state.obs.height))

    order = np.array([3, 4, 5, 0, 1, 2])
    return run(env.scenes), run(jax.tree.map(lambda leaf: leaf[order], env.scenes)), order


def test_the_planner_lifts_objects(stepped):
    """Claim: the planner lifts an object in most scenes of objects side by side."""
    (_, after), *_ = stepped
    assert np.sum(after.info.cleared) >= 4
    assert not np.any(after.info.physics_diverged)


def test_scenes_of_a_batch_have_their_own_objects(env: Env, stepped):
    """Claim: a scene moves the same in another batch, to the bit."""
    (_, after), (_, other), order = stepped
    assert len(np.unique(env.scenes.object_id)) > 6
    for name in ("position", "quaternion"):
        theirs = np.asarray(getattr(other.scene, name))
        np.testing.assert_array_equal(np.asarray(getattr(after.scene, name))[order], theirs)


def _grasp(env: Env, scene: SceneState) -> tuple:
    """The scene, its fields, and the joints of the planner's grasp; NumPy."""

    @jax.jit
    def planned(scene: SceneState) -> tuple:
        height = env.reset_to(scene).obs.height
        grasp = oracle.grasp(CONFIG, scene, height)
        plan = primitives.plan(CONFIG.sim, CONFIG.heightmap, height, grasp)
        fields = model.scene_fields(env.physics.world, scene)
        return scene, fields, primitives.joint_trajectory(CONFIG.sim, plan)

    return jax.device_get(planned(scene))


def test_objects_at_rest_sleep_until_they_are_touched(env: Env):
    """Claim: while the hand is far away nothing moves at all, to the bit; what it grasps moves."""
    world = env.physics.world
    scene, fields, joints = _grasp(env, jax.tree.map(lambda leaf: leaf[0], env.scenes))
    qvel = c_physics.trajectory(world, fields, scene, joints).qvel
    speed = np.abs(qvel[:, world.block_dofs]).max(axis=(1, 2))
    asleep = slice(20, 35)  # of the 60 substeps that the hand comes down in
    assert (speed[asleep] == 0.0).all()
    assert speed[60:].max() > 0.05


@pytest.mark.slow
def test_a_scene_moves_the_same_after_any_other(env: Env):
    """Claim: what slept in a simulator's last scene does not show in the next one, to the bit."""
    used = c_physics.CSimulator(env.physics.world)
    for i in range(6):
        row = _grasp(env, jax.tree.map(lambda leaf, i=i: leaf[i], env.scenes))
        fresh = c_physics.CSimulator(env.physics.world)
        np.testing.assert_array_equal(used.rollout(*row).qpos, fresh.rollout(*row).qpos)


def _slip(cfg: Config) -> float:
    """Distance, m, that a bar of 140 g slips down in the hand while it hangs there for a second."""
    world = model.build(cfg.scene, cfg.sim)
    scene, joints = grasped_bar(cfg)
    fields = placed.fields_of(world, scene)
    qpos = c_physics.trajectory(world, fields, scene, joints).qpos
    hangs = qpos[:, world.block_qpos[0, 2]] - qpos[:, world.robot_qpos[2]]
    closed = sum(cfg.sim.grasp_phases[:2])
    assert qpos[-1, world.block_qpos[0, 2]] > 0.1  # it was lifted
    return float(hangs[closed] - hangs[-1])


def test_held_objects_do_not_slip(tmp_path: Path):
    """Claim: a held object of 1.4 N hangs still, by Coulomb's law (40 N at a friction of 1.2). A
    block of its shape and weight creeps less than 1 mm in a second, by friction pyramids."""
    a_second = CONFIG.change(sim={"grasp_phases": (60, 50, 250)})
    still = _slip(a_second.change(scene=bar(tmp_path)))
    block = {"slots": ("box",), "min_blocks": 1, "objects": ""}
    assert abs(still) < 3e-4
    assert abs(_slip(a_second.change(scene=block))) < 1e-3


def test_more_iterations_change_nothing():
    """Claim: objects that meet or land end where a converged solver leaves them."""
    cfg = TWO_OBJECTS.change(sim={"physics": "c"})
    ends = []
    for most in (None, 200):
        world = model.build(cfg.scene, cfg.sim)
        if most is not None:
            world.model.opt.iterations = world.model.opt.ls_iterations = most
        run = jax.jit(jax.vmap(physics.make(world, cfg.sim).run))
        ends.append(run(*thrown_objects(cfg))[0].position)
    np.testing.assert_allclose(*ends, atol=1e-6)
