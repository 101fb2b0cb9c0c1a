"""Arms and grippers assembled, and MJCF that does not match its numbers or that MJX lacks."""

import importlib
import inspect
import re
import shutil
import typing
from pathlib import Path

import mujoco
import numpy as np
import pytest

from csac_jax import grippers
from csac_jax.config import RobotKind, SceneConfig, SimConfig
from csac_jax.errors import SceneError
from csac_jax.sim import mjx_physics
from csac_jax.world import model

SCENE = SceneConfig(slots=("box",), min_blocks=1)


def _built(gripper: str, robot: RobotKind = "hand", physics: str = "c") -> model.World:
    return model.build(SCENE, SimConfig(gripper=gripper, robot=robot, physics=physics))


def _settled(gripper: str, half: float) -> mujoco.MjData:
    """Simulates the floating hand for a second with the fingers at this half opening, m."""
    world = _built(gripper)
    data = mujoco.MjData(world.model)
    data.ctrl[2], data.ctrl[4] = 0.5, world.gripper.set_point(half)
    data.qpos[world.robot_qpos[2]] = 0.5
    mujoco.mj_step(world.model, data, nstep=250)
    mujoco.mj_kinematics(world.model, data)
    return data


@pytest.mark.parametrize("name", grippers.shipped())
def test_hand_opens_as_its_numbers_say(name: str):
    """Claim: in C MuJoCo's physics the pads come within 1 mm of the opening that is asked for, stay
    upright, and are as low as the numbers say."""
    gripper = grippers.load(name)
    for share in (0.0, 0.4, 1.0):
        half = gripper.half[0] + share * (gripper.half[1] - gripper.half[0])
        data = _settled(name, half)
        low, high = (data.geom(f"hand/{pad}") for pad in gripper.pads)
        size = data.model.geom(f"hand/{gripper.pads[0]}").size
        apart = high.xpos - low.xpos
        assert apart[0] - 2.0 * size[0] == pytest.approx(2.0 * half, abs=0.001)
        assert np.abs(low.xmat[8] - 1.0) < 1e-3
        lowest = low.xpos[2] - size[2] - 0.5
        assert lowest == pytest.approx(-float(gripper.drop(half)), abs=0.001)


@pytest.mark.parametrize("name", grippers.shipped())
def test_gripper_hangs_at_the_flange(name: str):
    """Claim: the tip frame is adapter and depth from the arm's flange, fingers down, z back. The
    arm collides with nothing and is free of gravity."""
    gripper = grippers.load(name)
    sim = SimConfig(gripper=name, robot="ur5e", adapter=0.03, base=(0.5, -0.1, 0.4, 0.3))
    world = model.build(SCENE, sim)
    data = mujoco.MjData(world.model)
    mujoco.mj_kinematics(world.model, data)
    flange, hand = data.site("ur5e/flange"), data.body(f"hand/{gripper.body}")
    back = (flange.xpos - hand.xpos) @ hand.xmat.reshape(3, 3)
    np.testing.assert_allclose(back, [0.0, 0.0, 0.03 + gripper.depth[1]], atol=1e-9)
    base = data.body("ur5e/base")
    np.testing.assert_allclose(base.xpos, sim.base[:3])
    np.testing.assert_allclose(base.xmat[[0, 3]], [np.cos(0.3), np.sin(0.3)])
    foot = world.model.geom("ur5e/base")
    assert data.geom("ur5e/base").xpos[2] - foot.size[1] == pytest.approx(0.0, abs=1e-6)
    built = world.model
    arm = [i for i in range(built.ngeom) if built.geom(i).name.startswith("ur5e/")]
    assert len(arm) == 8
    assert not (built.geom_contype[arm] | built.geom_conaffinity[arm]).any()
    assert (built.body_gravcomp[built.geom_bodyid[arm][1:]] == 1.0).all()


def _changed(folder: Path, name: str, *changes: tuple[str, str]) -> str:
    """Copies a gripper with changes to its MJCF."""
    shutil.copytree(grippers.load(name).folder, folder)
    text = (folder / grippers.MJCF).read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / grippers.MJCF).write_text(text)
    return str(folder)


SPARE = '<joint name="spare" axis="0 1 0"/><geom name="palm"'
UNFIT = {
    "geom": ('name="pad_low"', 'name="left"', "geom 'pad_low' is missing; it has: palm, "),
    "body": ('<body name="hand"', '<body name="base"', "body 'hand' is missing; it has: "),
    "joint": ('joint name="finger_high"', 'joint name="f"', "joint 'finger_high' is missing"),
    "actuator": ('<position name="finger"', '<position name="f"', "must be finger, not f"),
    "spare": ('<geom name="palm"', SPARE, "joint 'spare' is not among 'joints' of gripper.json"),
    "reference": ('joint2="finger_high"', 'joint2="thumb"', "thumb"),
    "opening": ('pos="-0.006 0 0"', 'pos="-0.02 0 0"', "opening when closed is 14.0 mm, by "),
    "tips": ('pos="0 0 0.0375"', 'pos="0 0 0.0575"', "height of the tips when closed is 20.0 mm"),
}


@pytest.mark.parametrize("case", UNFIT)
def test_mjcf_that_does_not_fit_is_one_line(tmp_path: Path, case: str):
    """Claim: MJCF that lacks what the numbers name, has other numbers or does not compile gives one
    line with the file and what is wrong, whatever the robot and physics."""
    old, new, says = UNFIT[case]
    folder = _changed(tmp_path / "mine", "rg2", (old, new))
    for robot, physics in (("hand", "mjx"), ("ur5", "c")):
        with pytest.raises(SceneError, match=re.escape(says)) as error:
            _built(folder, robot, physics)
        assert str(error.value).startswith(f"{folder}/gripper.xml: ")
        assert "\n" not in str(error.value)


VARIED = '"finger_low" gravcomp="1">'
CANNOT_VARY = {
    "narrow": ([("0.010 0.013", "0.010 0.012")], "width of pad_low is 24.0 mm, by gripper.json 26"),
    "frame": (
        [(VARIED, VARIED[:-1] + ' pos="0.004 0 0">'), ("-0.010 0 0.009", "-0.014 0 0.009")],
        "inner face of pad_low in its finger's frame is 4.0 mm",
    ),
}


@pytest.mark.parametrize("case", CANNOT_VARY)
def test_pads_that_cannot_vary_are_refused(tmp_path: Path, case: str):
    """Claim: where fingers vary, MJCF whose pads are not the largest, or do not lie with their
    inner faces on the fingers' frames, gives one line: pads of an episode would be elsewhere."""
    changes, says = CANNOT_VARY[case]
    with pytest.raises(SceneError, match=re.escape(says)) as error:
        _built(_changed(tmp_path / "mine", "varied", *changes))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('<geom name="palm"', '<geom name="palm" gap="0.01"', "geom_gap"),
        ('joint name="finger_low"', 'joint name="finger_low" stiffness="0 9"', "jnt_stiffnesspoly"),
        ('<position name="finger"', '<position name="finger" armature="1"', "actuator_armature"),
        ('type="box"', 'type="ellipsoid"', "collisions not implemented"),
        ("</mujoco>", '<sensor><user dim="1"/></sensor></mujoco>', "not supported"),
    ],
)
def test_mjcf_that_mjx_cannot_run_is_one_line(tmp_path: Path, old: str, new: str, says: str):
    """Claim: what MJX would ignore in a gripper's MJCF, or has no code for, is one line with the
    remedy; C MuJoCo runs it."""
    folder = _changed(tmp_path / "mine", "rg2", (old, new))
    sim = SimConfig(gripper=folder, physics="mjx")
    with pytest.raises(SceneError, match=f"MJX .*{says}.*; .*take sim.physics c") as error:
        mjx_physics.MjxPhysics(model.build(SCENE, sim), sim)
    assert "\n" not in str(error.value)
    _built(folder)


def test_shipped_mjcf_has_nothing_that_mjx_ignores():
    """Claim: worlds of all robots and grippers pass, and MJX's code reads no field that is refused;
    it would be refused needlessly."""
    for gripper in grippers.shipped():
        _built(gripper, "hand", "mjx")
    for robot in typing.get_args(RobotKind):
        _built("rg2", robot, "mjx")
    names = "constraint derivative forward inverse passive scan sensor smooth solver support"
    modules = [importlib.import_module(f"mujoco.mjx._src.{name}") for name in names.split()]
    modules.append(importlib.import_module("mujoco.mjx._src.collision_driver"))
    code = "".join(map(inspect.getsource, modules))
    assert "m.geom_margin" in code
    assert not [field for field in model._MJX_IGNORES if f"m.{field}" in code]
