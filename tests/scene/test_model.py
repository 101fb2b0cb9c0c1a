"""The model against MuJoCo's own compiler."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from csac_jax.config import SceneConfig, SimConfig
from csac_jax.scene import blocks, model

SLOTS = ("box", "box", "prism")
CONFIG = SceneConfig(slots=SLOTS, min_blocks=1)


@pytest.fixture(scope="module")
def world() -> model.World:
    return model.build(CONFIG, SimConfig())


def _fields(half: np.ndarray) -> model.BoxFields:
    return jax.tree.map(np.asarray, model.box_fields(jnp.asarray(half)))


@pytest.mark.parametrize("half", blocks.BOX_HALF_SIZES, ids=("cube", "cuboid", "plank", "tile"))
def test_box_fields_are_those_of_the_compiler(half: np.ndarray):
    """Claim: box_fields gives what MuJoCo's compiler derives from a box's size, for each size of the set."""
    size = " ".join(map(str, half))
    compiled = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom type="box" size="{size}" density="{model.DENSITY}"/>'
        "</body></worldbody></mujoco>"
    )
    fields = _fields(half[None])
    pairs = (
        (fields.size, compiled.geom_size),
        (fields.rbound, compiled.geom_rbound),
        (fields.mass, compiled.body_mass[1:]),
        (fields.inertia, compiled.body_inertia[1:]),
        (fields.invweight, compiled.body_invweight0[1:]),
        (np.repeat(fields.invweight, 3, axis=1)[0], compiled.dof_invweight0),
    )
    for ours, theirs in pairs:
        np.testing.assert_allclose(ours, theirs, rtol=1e-5)  # float32


def test_model_with_boxes_moves_as_a_compiled_one(world: model.World):
    """Claim: a world given box sizes afterwards moves as one that was compiled with them."""
    half = blocks.BOX_HALF_SIZES[[3, 2]]
    spec = model._spec(CONFIG, SimConfig())
    for slot in range(2):
        spec.geom(f"block{slot}").size = half[slot]
    ends = []
    for moved in (model.with_boxes(world, _fields(half)), spec.compile()):
        data = mujoco.MjData(moved)
        data.qpos[world.block_qpos[0, :3]] = [0.1, 0.0, 0.05]
        data.qpos[world.block_qpos[1]] = [-0.1, 0.05, 0.08, np.cos(0.2), 0.0, np.sin(0.2), 0.0]
        data.qvel[world.block_dofs[:2]] = [[0.3, 0.1, 0.0, 0.5, 1.0, -0.5]] * 2
        mujoco.mj_step(moved, data, nstep=75)  # 0.3 s: fall, tumble, first contacts
        ends.append(np.concatenate([data.qpos, data.subtree_com[world.block_bodies].ravel()]))
    np.testing.assert_allclose(*ends, atol=1e-4)


def test_with_boxes_leaves_the_world_unchanged(world: model.World):
    """Claim: with_boxes writes into a copy."""
    names = [name for name in dir(world.model) if isinstance(getattr(world.model, name), np.ndarray)]
    before = {name: getattr(world.model, name).copy() for name in names}
    changed = model.with_boxes(world, _fields(blocks.BOX_HALF_SIZES[[0, 3]]))
    assert not np.array_equal(changed.geom_size, before["geom_size"])
    for name in names:
        np.testing.assert_array_equal(getattr(world.model, name), before[name], err_msg=name)


def test_addresses_name_what_they_say(world: model.World):
    """Claim: the addresses of a world lead to its blocks, hand joints and pads, in order."""
    for slot in range(len(SLOTS)):
        assert world.model.body(world.block_bodies[slot]).name == f"block{slot}"
        assert world.model.geom(world.block_geoms[slot]).bodyid[0] == world.block_bodies[slot]
        joint = world.model.body(world.block_bodies[slot]).jntadr[0]
        assert world.block_qpos[slot, 0] == world.model.jnt_qposadr[joint]
        assert world.block_dofs[slot, 0] == world.model.jnt_dofadr[joint]
    for name, qpos, dof in zip(model.HAND_JOINTS, world.hand_qpos, world.hand_dofs, strict=True):
        joint = world.model.joint(f"hand/{name}")
        assert (joint.qposadr[0], joint.dofadr[0]) == (qpos, dof)
    assert [world.model.geom(i).name for i in world.hand_geoms] == ["hand/palm", "hand/pad_low", "hand/pad_high"]
