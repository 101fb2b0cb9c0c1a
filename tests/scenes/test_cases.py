"""Case files: what is read, what is refused, and the shipped ones in C MuJoCo."""

import copy
import json
import re
import time
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from csac_jax.config import HeightmapConfig
from csac_jax.objects import library, shapes
from csac_jax.scenes import cases
from csac_jax.world import blocks, scene_state
from tests.world import placed

SHIPPED = ("hole", "pinwheel", "ridge", "row")
FLAT = [1, 0, 0, 0]


def _block(shape: str, position: list, colour: str = "red", turn: Any = FLAT, **more: Any) -> dict:
    return {"shape": shape, "colour": colour, "position": position, "quaternion": turn} | more


PAIR = {
    "name": "pair",
    "blocks": [
        _block("cube", [0.05, 0.0, 0.025], target=True),
        _block("arch", [-0.05, 0.0, 0.025], "blue"),
    ],
}


def _written(folder: Path, content: Any) -> Path:
    path = folder / "case.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def _load(folder: Path, *entries: dict) -> cases.Case:
    return cases.load(_written(folder, {"name": "test", "blocks": list(entries)}))


def test_names_are_those_of_the_files():
    """Claim: four cases are shipped, and each file bears its case's name; another is refused."""
    assert cases.names() == SHIPPED
    assert tuple(cases.load(cases.shipped(name)).name for name in cases.names()) == SHIPPED
    with pytest.raises(ValueError, match=r"'\.\./x'; choose one of: hole, pinwheel, ridge, row"):
        cases.shipped("../x")


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_case_stands_still(name: str):
    """Claim: after 1 s of C MuJoCo no block of a shipped case has moved by more than 2 mm; before,
    its target has a neighbour within 3 mm, and its last block none within 50 mm."""
    case = cases.load(cases.shipped(name))
    cases.require_target(case)
    world, exact, data = placed.case_in_c(case)
    gap = np.ones((len(case.slots),) * 2)
    for one, slot in zip(world.block_geoms, world.parts.slot, strict=True):
        for two, other in zip(world.block_geoms, world.parts.slot, strict=True):
            if slot != other:
                apart = mujoco.mj_geomDistance(exact, data, one, two, 1.0, None)
                gap[slot, other] = min(gap[slot, other], apart)
    assert gap[int(case.scene.target)].min() < 0.003
    assert gap[-1].min() > 0.05
    mujoco.mj_step(exact, data, nstep=round(1.0 / exact.opt.timestep))
    moved = data.qpos[world.block_qpos[:, :3]] - case.scene.position
    assert np.linalg.norm(moved, axis=1).max() < 0.002


def test_load_gives_what_the_file_says(tmp_path: Path):
    """Claim: shapes, colours, poses and target are those of the file, sizes and materials nominal,
    all at rest."""
    half_turn = [0, 0, 0, 2.0]  # brought to unit length
    places, shapes = [[0.1, -0.05, 0.0125], [-0.1, 0.05, 0.0125]], ("plank", "half_cylinder")
    first = _block(shapes[0], places[0], "pink", half_turn)
    case = _load(tmp_path, first, _block(shapes[1], places[1], "blue", target=True))
    assert (case.name, case.slots) == ("test", ("box", "half_cylinder"))
    scene, parked = case.scene, scene_state.parked(("box",))
    dtypes = [[leaf.dtype for leaf in jax.tree.leaves(each)] for each in (scene, parked)]
    assert dtypes[0] == dtypes[1]
    half = np.float32([blocks.SHAPES[shape].half_size for shape in shapes])
    np.testing.assert_array_equal(scene.position, np.float32(places))
    np.testing.assert_array_equal(scene.quaternion, np.float32([[0, 0, 0, 1], FLAT]))
    np.testing.assert_array_equal(scene.half_size, half)
    assert [blocks.COLOUR_NAMES[row] for row in scene.colour] == ["pink", "blue"]
    assert set(scene.density) == {np.float32(scene_state.NOMINAL_DENSITY)}
    assert set(scene.friction) == {np.float32(scene_state.NOMINAL_FRICTION)}
    assert scene.in_play.all()
    assert not scene.velocity.any()
    assert scene.target == 1


def _changed(block: int, key: str, value: Any = None) -> dict:
    """Changes a value of PAIR; None deletes the key."""
    content = copy.deepcopy(PAIR)
    content["blocks"][block][key] = value
    if value is None:
        del content["blocks"][block][key]
    return content


REFUSED = [
    ("{", "not a JSON file"),
    ("[" * 100_000, "maximum recursion"),
    (PAIR | {"extra": 1}, "'extra' is unknown"),
    ({"blocks": PAIR["blocks"]}, "'name' is missing"),
    (PAIR | {"name": "two\nlines"}, "'name' "),
    (PAIR | {"blocks": PAIR["blocks"] * 40}, "'blocks' "),
    (PAIR | {"blocks": [3]}, "block 1: "),
    ('{"name": "a", "name": "b", "blocks": []}', "key 'name' is given twice"),
    (_changed(1, "colour"), "block 2: 'colour' is missing"),
    (_changed(1, "object", "cup"), 'block 2: give a "shape", or an "object" and its "library"'),
    (_changed(1, "shape", "sphere"), "block 2: 'shape' should be 'cube', 'cuboid'"),
    (_changed(1, "position", [0.1, 0.1]), "block 2: 'position' "),
    (_changed(1, "position", [0.1, 0.1, float("nan")]), "block 2: 'position.2' "),
    (_changed(1, "position", [0.1, 0.1, 10**400]), "block 2: 'position.2' "),
    (_changed(1, "quaternion", [0, 0, 0.0, 0]), 'block 2: "quaternion" must not be all zero'),
    (_changed(1, "target", True), "block 2: block 1 is the target already"),
    (_changed(0, "position", [0.203, 0.0, 0.025]), "block 1: reaches 4.0 mm beyond the square"),
    (_changed(0, "position", [0.05, 0.0, 0.022]), "block 1: reaches 3.0 mm below the table"),
    (_changed(0, "position", [0.05, 0.0, 0.48]), "block 1: reaches 0.505 m above the table"),
    (_changed(0, "position", [0.0225, 0.0, 0.025]), "block 2: overlaps block 1 by 2.5 mm"),
    ('{"name": "a", "blocks": [' + "1, " * 100_000 + "1]}", "block"),
    ('{"name": "a", "blocks": 1' + "0" * 5000 + "}", "."),
    ('{"name": "\\ud800", "blocks": []}', "'name' "),
]


@pytest.mark.parametrize(("content", "says"), REFUSED, ids=range(len(REFUSED)))
def test_bad_file_is_refused_in_one_line(tmp_path: Path, content: Any, says: str):
    """Claim: whatever is wrong with a case file, or hostile in it, is soon a ValueError of one line
    that names the file, the block and the key."""
    path, begun = _written(tmp_path, content), time.monotonic()
    with pytest.raises(ValueError, match=re.escape(says)) as error:
        cases.load(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert len(message) < len(str(path)) + 300
    assert time.monotonic() - begun < 2.0


def test_unreadable_file_is_refused_in_one_line(tmp_path: Path):
    """Claim: a file that is not there, or no text, is a ValueError too."""
    (tmp_path / "raw.json").write_bytes(b"\xff\xfe\x00")
    for name, says in {"none.json": "No such file", "raw.json": "'utf-8' codec"}.items():
        with pytest.raises(ValueError, match=f"^{tmp_path / name}: .*{says}"):
            cases.load(tmp_path / name)


@pytest.mark.parametrize("shape", blocks.SHAPES)
def test_corners_are_those_of_the_block(tmp_path: Path, shape: str):
    """Claim: a block of any shape, turned or not, may touch the border from inside, and reach no
    farther; it may overlap another by 2 mm, no more, and not lie inside it."""
    half = np.array(blocks.SHAPES[shape].half_size)
    border = 0.5 * HeightmapConfig().extent
    for turn, reach in ((0.0, half[0]), (90.0, half[1])):
        quaternion = Rotation.from_euler("z", turn, degrees=True).as_quat(scalar_first=True)
        at = [_block(shape, [x, 0.0, half[2]], "red", [*quaternion]) for x in (border - reach, 0.0)]
        _load(tmp_path, at[0])
        at[0]["position"][0] += 0.001
        with pytest.raises(ValueError, match=r"block 1: reaches 1\.0 mm beyond the square"):
            _load(tmp_path, at[0])
        with pytest.raises(ValueError, match="block 2: overlaps block 1"):
            _load(tmp_path, at[1], at[1])
    flat = blocks.SHAPES["plank"].half_size  # its side, against a side, edge or end
    first = _block(shape, [0.0, 0.0, half[2]])
    second = _block("plank", [0.0, half[1] + flat[1] - 0.0018, flat[2]])
    _load(tmp_path, first, second)
    second["position"][1] -= 0.0007
    with pytest.raises(ValueError, match=r"block 2: overlaps block 1 by 2\.[0-9] mm"):
        _load(tmp_path, first, second)


def test_square_and_target_are_the_callers(tmp_path: Path):
    """Claim: the side of the square is the caller's; without a target a case is for clearing."""
    path = _written(tmp_path, PAIR)
    cases.require_target(cases.load(path, 0.2))
    with pytest.raises(ValueError, match=r"block 1: reaches 5\.0 mm beyond the square of 0\.14 m"):
        cases.load(path, 0.14)
    loose = _load(tmp_path, PAIR["blocks"][1])
    assert int(loose.scene.target) == scene_state.ANY
    with pytest.raises(ValueError, match="case 'test' marks no target"):
        cases.require_target(loose)


def _with_object(tmp_path: Path, **changes: object) -> Path:
    """Writes a case of a cup of a library in the file's folder, with changes, and a cube."""
    if not (tmp_path / "lib").exists():
        library.save(tmp_path / "lib", shapes.draw(0, 14))
    cup = _block("cube", [0.05, 0.0, 0.0311]) | {"object": "cup-0-2", "library": "lib"} | changes
    del cup["shape"]
    cube = _block("cube", [-0.05, 0.0, 0.025], "blue", target=True)
    return _written(tmp_path, {"name": "cup", "blocks": [cup, cube]})


def test_a_case_names_objects(tmp_path: Path):
    """Claim: an object of a library in the file's folder stands at its place: the middle of its
    bounding box, not its centre of mass, is where the case says."""
    turned = _with_object(tmp_path, quaternion=[0.5, 0.5, 0.5, 0.5], position=[0, 0.1, 0.04])
    case = cases.load(turned)
    assert case.slots == ("object", "box")
    assert case.objects == str(tmp_path / "lib")
    corners = np.concatenate(cases._corners(case)[0])
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    np.testing.assert_allclose(middle, [0.0, 0.1, 0.04], atol=1e-6)
    assert np.linalg.norm(case.scene.position[0] - middle) > 1e-3
    assert case.scene.target == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"object": "mug"}, "no object 'mug' in the library; it has: bottle-0-0"),
        ({"library": "none"}, "no library of objects there"),
        ({"position": [0.05, 0.0, 0.02]}, "mm below the table"),
        ({"position": [-0.04, 0.0, 0.0311]}, "overlaps block 1"),
    ],
)
def test_an_unsound_object_is_named(tmp_path: Path, changes: dict[str, object], message: str):
    """Claim: an object that is unknown, lies wrong or overlaps is one line with the file."""
    path = _with_object(tmp_path, **changes)
    with pytest.raises(ValueError, match=message) as caught:
        cases.load(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
