"""The model against MuJoCo's own compiler."""

import operator
import re
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest

from csac_jax import grippers
from csac_jax.config import RobotKind, SceneConfig, SimConfig
from csac_jax.errors import SceneError
from csac_jax.robot import mjcf
from csac_jax.world import blocks, model, scene_state
from csac_jax.world.scene_state import SceneState
from tests.world import placed

SLOTS = ("box", "box", "arch", "prism", "half_cylinder", "cylinder")
CONFIG = SceneConfig(slots=SLOTS, min_blocks=1)
BOXES = [name for name, shape in blocks.SHAPES.items() if shape.kind == "box"]


@pytest.fixture(scope="module")
def world() -> model.World:
    return model.build(CONFIG, SimConfig())


def _scene(box: str = "plank", scale: float = 0.9) -> SceneState:
    """Creates one of each kind, not of nominal size, density or friction."""
    scene = scene_state.parked(SLOTS)
    half = scene.half_size.copy()
    half[:2] = blocks.SHAPES[box].half_size, blocks.SHAPES["tile"].half_size
    return scene.replace(
        half_size=half * np.float32(scale),
        density=np.full_like(scene.density, 800.0),
        friction=np.linspace(0.5, 1.0, len(SLOTS), dtype=np.float32),
    )


def _compiled(monkeypatch: pytest.MonkeyPatch, scene: SceneState, scale: float) -> mujoco.MjModel:
    """Compiles the same scene, sizes, densities and frictions written into the spec."""
    with monkeypatch.context() as patch:
        patch.setattr(model, "LARGEST", scale)
        spec = model._spec(CONFIG, SimConfig(), grippers.load("rg2"))
    for slot in range(len(SLOTS)):
        for geom in spec.body(f"block{slot}").geoms:
            geom.density = scene.density[slot]
            geom.friction[0] = scene.friction[slot]
            if slot < 2:
                geom.size = scene.half_size[slot]
    return spec.compile()


def _fields(world: model.World, scene: SceneState) -> model.BlockFields:
    return placed.fields_of(world, scene)


def test_mjcf_text_is_the_world(world: model.World):
    """Claim: `to_mjcf` writes the world that `build` compiles; another process can compile it."""
    theirs = mujoco.MjModel.from_xml_string(model.to_mjcf(CONFIG, SimConfig()))
    assert theirs.names == world.model.names
    for field in ("geom_size", "geom_solimp", "mesh_vert", "actuator_gainprm", "opt.timestep"):
        value = operator.attrgetter(field)
        np.testing.assert_allclose(value(theirs), value(world.model), rtol=1e-5, err_msg=field)


@pytest.mark.parametrize("box", BOXES)
def test_block_fields_are_those_of_the_compiler(
    world: model.World, monkeypatch: pytest.MonkeyPatch, box: str
):
    """Claim: scene_fields gives what MuJoCo's compiler derives, for every shape of the set, larger
    or smaller."""
    scale = 1.07
    scene = _scene(box, scale=scale)
    ours, theirs = _fields(world, scene), _compiled(monkeypatch, scene, scale)
    bodies, geoms = world.block_bodies, world.block_geoms
    is_box = theirs.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_BOX
    pairs = (
        (ours.size[is_box], theirs.geom_size[geoms[is_box]], 0.0),
        (ours.rbound, theirs.geom_rbound[geoms], 0.0),
        (ours.centre, theirs.geom_pos[geoms], 1e-8),
        (ours.friction, theirs.geom_friction[geoms, 0], 0.0),
        (ours.mass, theirs.body_mass[bodies], 0.0),
        (ours.com, theirs.body_ipos[bodies], 1e-8),
        (np.sort(ours.inertia), np.sort(theirs.body_inertia[bodies]), 0.0),
        (ours.body_invweight, theirs.body_invweight0[bodies], 0.0),
        (ours.dof_invweight, theirs.dof_invweight0[world.block_dofs], 0.0),
    )
    for mine, reference, atol in pairs:
        np.testing.assert_allclose(mine, reference, rtol=1e-5, atol=atol)  # float32


@pytest.mark.parametrize(
    ("robot", "file", "old", "new", "says"),
    [
        ("ur5", "ur5.xml", '<joint name="elbow"', '<joint name="e"', "joint 'elbow' is missing"),
        ("hand", "blocks.xml", 'class="block"', 'class="b"', "default class 'block' is missing"),
        ("hand", "table.xml", "<mujoco", "<mujocoo", "XML parse error"),
    ],
)
def test_names_of_other_mjcf_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: RobotKind, file, old, new, says
):
    """Claim: MJCF files that lack a name, or do not compile, give one line with the file and the
    fault."""
    folder = Path(shutil.copytree(model.assets(), tmp_path / "scenes"))
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    for module in (model, mjcf):
        monkeypatch.setattr(module, "assets", lambda: folder)
    for physics in ("c", "mjx"):
        with pytest.raises(SceneError, match=re.escape(says)) as error:
            model.build(CONFIG, SimConfig(robot=robot, physics=physics))
        assert str(error.value).startswith(str(folder))
        assert "\n" not in str(error.value)
