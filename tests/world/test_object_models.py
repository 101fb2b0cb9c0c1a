"""Objects of a library in C MuJoCo: other ones in every scene of one model."""

import dataclasses
import itertools

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from csac_jax import grippers
from csac_jax.config import Config
from csac_jax.objects import body, library, shapes, solid
from csac_jax.scenes import pool
from csac_jax.world import model, object_slots
from csac_jax.world.scene_state import SceneState

SLOTS = [0, 2, 4]  # of objects
HEAVY = 1500.0  # kg/m^3, of all but the first object


@pytest.fixture(scope="module")
def cfg(tmp_path_factory: pytest.TempPathFactory) -> Config:
    """Makes a library that begins with a tiny cube, with which the model is compiled.

    Its frame is the body's and its size small, which holds for no other object.
    """
    cube = 0.004 * np.array([*itertools.product((0.0, 1.0), repeat=3)])
    tiny = body.make("tiny", [solid.convex(cube)])
    folder = tmp_path_factory.mktemp("library") / "lib"
    heavy = [dataclasses.replace(member, density=HEAVY) for member in shapes.draw(1, 28)]
    library.save(folder, [tiny, *heavy])
    kinds = ("object", "box", "object", "prism", "object")
    scene = {"slots": kinds, "min_blocks": 5, "objects": str(folder), "split": "all"}
    return Config().change(scene=scene, sim={"physics": "c"})


@pytest.fixture(scope="module")
def world(cfg: Config) -> model.World:
    return model.build(cfg.scene, cfg.sim)


def dropped(cfg: Config, seed: int) -> SceneState:
    return pool._drop(cfg.scene, np.random.default_rng(seed), 5)


def compiled(cfg: Config, scene: SceneState) -> mujoco.MjModel:
    """Compiles a model with the scene's objects in its slots."""
    spec = model._spec(cfg.scene, cfg.sim, grippers.load("rg2"))
    objects = object_slots.library(cfg.scene).objects
    for slot in SLOTS:
        number = int(scene.object_id[slot])
        body, member = spec.body(f"block{slot}"), objects[number]
        density = float(scene.density[slot]) * member.density / 600.0
        body.mass, inertia = density * member.volume, density * member.inertia
        body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        for part, geom in enumerate(body.geoms):
            geom.friction[0] = scene.friction[slot]
            if part < len(member.parts):
                geom.meshname = f"object{number}/{part}"
            else:
                geom.contype = geom.conaffinity = 0
    return spec.compile()


def inertias(exact: mujoco.MjModel) -> np.ndarray:
    """Returns inertias [bodies, 3, 3] in the frames of the bodies."""
    axes = Rotation.from_quat(exact.body_iquat, scalar_first=True).as_matrix()
    return np.einsum("bij,bj,bkj->bik", axes, exact.body_inertia, axes)


def fall(exact: mujoco.MjModel, world: model.World, scene: SceneState) -> np.ndarray:
    """Simulates poses of the objects [T, 3, 7] while they fall."""
    data = mujoco.MjData(exact)
    data.qpos[world.robot_qpos[2]] = data.ctrl[2] = model.HAND_PARK_HEIGHT
    data.qpos[world.block_qpos] = np.concatenate([scene.position, scene.quaternion], axis=1)
    for number, slot in enumerate(SLOTS):  # one above the other
        data.qpos[world.block_qpos[slot, :3]] = 0.0, 0.005 * number, 0.09 + 0.17 * number
    # Blocks have other sizes in the compiled model, and the solver has all contacts at once.
    exact.geom_contype[world.block_geoms] = exact.geom_conaffinity[world.block_geoms] = 0
    path = []
    for _ in range(300):
        mujoco.mj_step(exact, data)
        path.append(data.qpos[world.block_qpos[SLOTS]])
    return np.array(path)


def test_swapped_objects_fall_as_compiled_ones(cfg: Config, world: model.World):
    """Claim: objects that are written into a model move as those that it is compiled with."""
    touching = 0
    for seed in range(6):
        scene = dropped(cfg, seed)
        fields = jax.device_get(model.scene_fields(world, scene))
        swapped, own = model.with_blocks(world, fields), compiled(cfg, scene)
        bodies = world.block_bodies[SLOTS]
        geoms = np.flatnonzero(own.geom_contype & np.isin(world.slot_of_geom, SLOTS))
        tensors = (inertias(each)[bodies] for each in (swapped, own))
        np.testing.assert_allclose(*tensors, rtol=1e-9, atol=1e-12)
        own.body_inertia[bodies] = swapped.body_inertia[bodies]  # the axes in another order
        own.body_iquat[bodies] = swapped.body_iquat[bodies]
        own.geom_sameframe[geoms] = 0  # no geom has the frame of that inertia now
        np.testing.assert_allclose(swapped.body_mass[bodies], own.body_mass[bodies], rtol=1e-12)
        own.body_mass[bodies] = swapped.body_mass[bodies]
        for name in ("pos", "quat", "size", "aabb", "rbound", "friction", "dataid"):
            ours, theirs = (getattr(each, f"geom_{name}") for each in (swapped, own))
            np.testing.assert_allclose(ours[geoms], theirs[geoms], atol=1e-8, err_msg=name)
            theirs[geoms] = ours[geoms]  # the compiler had corners in float64
        mujoco.mj_setConst(own, mujoco.MjData(own))
        path = fall(swapped, world, scene)
        np.testing.assert_allclose(path, fall(own, world, scene), rtol=0, atol=1e-9)
        touching += (path[-1, :, 2] < 0.15).sum()
    assert touching >= 14  # they have met the table and one another


def test_blocks_beside_objects_are_as_without(cfg: Config, world: model.World):
    """Claim: the fields of blocks do not depend on objects in other slots."""
    scene = dropped(cfg, 2)
    kinds = tuple(kind for kind in cfg.scene.slots if kind != "object")
    alone = cfg.change(scene={"slots": kinds, "min_blocks": 1, "objects": ""})
    rows = jax.tree.map(lambda leaf: leaf if leaf.ndim == 0 else leaf[[1, 3]], scene)
    own = model.build(alone.scene, alone.sim)
    ours = jax.device_get(model.scene_fields(own, rows.replace(object_id=None)))
    beside = jax.device_get(model.scene_fields(world, scene))
    for name in ("size", "centre", "rbound", "friction"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(beside, name))
    for name in ("mass", "inertia", "com", "body_invweight", "dof_invweight"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(beside, name)[[1, 3]])
    np.testing.assert_array_equal(ours.mesh_scale, beside.mesh_scale)
