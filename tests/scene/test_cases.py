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
from csac_jax.objects import families, library
from csac_jax.scene import blocks, cases, layout
from tests.scene import placed

SHIPPED = ("hole", "pinwheel", "ridge", "row")
FLAT = [1, 0, 0, 0]


def _block(
    shape: str, position: list[float], colour: str = "red", quaternion: Any = FLAT, **more: Any
) -> dict:
    return {"shape": shape, "colour": colour, "position": position, "quaternion": quaternion} | more


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


def _settled(case: cases.Case, seconds: float) -> np.ndarray:
    """Positions [N, 3] m of the case's blocks after this time in C MuJoCo."""
    world, exact, data = placed.case_in_c(case)
    mujoco.mj_step(exact, data, nstep=round(seconds / exact.opt.timestep))
    return data.qpos[world.block_qpos[:, :3]]


def test_names_are_those_of_the_files():
    """Claim: four cases are shipped, and each file bears its case's name."""
    assert cases.names() == SHIPPED
    assert tuple(cases.load(cases.shipped(name)).name for name in cases.names()) == SHIPPED


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_case_stands_still(name: str):
    """Claim: after 1 s of C MuJoCo no block of a shipped case has moved by more than 2 mm."""
    case = cases.load(cases.shipped(name))
    moved = np.linalg.norm(_settled(case, 1.0) - case.scene.position, axis=1)
    assert moved.max() < 0.002, moved


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_case_has_a_target_hemmed_in(name: str):
    """Claim: the target of a shipped case has a neighbour within 3 mm, the last block none within
    50 mm."""
    case = cases.load(cases.shipped(name))
    cases.require_target(case)
    gap = _gaps(case)
    assert np.nanmin(gap[int(case.scene.target)]) < 0.003
    assert np.nanmin(gap[-1]) > 0.05


def _gaps(case: cases.Case) -> np.ndarray:
    """Distance [N, N] m between blocks in C MuJoCo, NaN on the diagonal; at most 1 m."""
    world, exact, data = placed.case_in_c(case)
    gap = np.full((len(case.slots),) * 2, np.nan)
    for one, slot in zip(world.block_geoms, world.parts.slot, strict=True):
        for two, other in zip(world.block_geoms, world.parts.slot, strict=True):
            if slot != other:
                gap[slot, other] = np.fmin(
                    gap[slot, other], mujoco.mj_geomDistance(exact, data, one, two, 1.0, None)
                )
    return gap


def test_load_gives_what_the_file_says(tmp_path: Path):
    """Claim: shapes, colours, poses and target are those of the file, sizes and materials nominal,
    all at rest."""
    half_turn = [0, 0, 0, 2.0]  # brought to unit length
    case = _load(
        tmp_path,
        _block("plank", [0.1, -0.05, 0.0125], "pink", half_turn),
        _block("half_cylinder", [-0.1, 0.05, 0.0125], "blue", target=True),
        _block("tile", [0.0, 0.0, 0.0125], "grey", target=False),
    )
    assert (case.name, case.slots) == ("test", ("box", "half_cylinder", "box"))
    scene = case.scene
    assert jax.tree.map(lambda leaf: leaf.dtype, scene) == jax.tree.map(
        lambda leaf: leaf.dtype, layout.parked(("box",))
    )
    np.testing.assert_array_equal(
        scene.position, np.float32([[0.1, -0.05, 0.0125], [-0.1, 0.05, 0.0125], [0.0, 0.0, 0.0125]])
    )
    np.testing.assert_array_equal(scene.quaternion, np.float32([[0, 0, 0, 1], FLAT, FLAT]))
    shapes = ("plank", "half_cylinder", "tile")
    np.testing.assert_array_equal(
        scene.half_size, np.float32([blocks.SHAPES[shape].half_size for shape in shapes])
    )
    assert [blocks.COLOUR_NAMES[row] for row in scene.colour] == ["pink", "blue", "grey"]
    assert set(scene.density) == {np.float32(layout.NOMINAL_DENSITY)}
    assert set(scene.friction) == {np.float32(layout.NOMINAL_FRICTION)}
    assert scene.in_play.all()
    assert not scene.velocity.any()
    assert scene.target == 1


def _changed(block: int, key: str, value: Any) -> dict:
    content = copy.deepcopy(PAIR)
    content["blocks"][block][key] = value
    return content


def _without(block: int, key: str) -> dict:
    content = copy.deepcopy(PAIR)
    del content["blocks"][block][key]
    return content


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "not a JSON file"),
        ("[" * 100_000, "nested too deeply"),
        ("[]", "must be an object"),
        (PAIR | {"extra": 1}, 'unknown key "extra"'),
        ({"blocks": PAIR["blocks"]}, 'key "name" is missing'),
        (PAIR | {"name": "two\nlines"}, '"name" must be'),
        (PAIR | {"name": 3}, '"name" must be'),
        (PAIR | {"blocks": []}, '"blocks" must be a list of 1 to'),
        (PAIR | {"blocks": {}}, '"blocks" must be a list of 1 to'),
        (PAIR | {"blocks": PAIR["blocks"] * 40}, '"blocks" must be a list of 1 to'),
        (PAIR | {"blocks": [3]}, "block 1: must be an object"),
        ('{"name": "a", "name": "b", "blocks": []}', 'key "name" is given twice'),
        (_without(1, "colour"), 'block 2: key "colour" is missing'),
        (_changed(1, "tagret", True), 'block 2: unknown key "tagret"'),
        (_changed(1, "shape", "sphere"), 'block 2: "shape" must be one of: cube, cuboid'),
        (_changed(0, "shape", ["cube"]), 'half_cylinder, cylinder, not ["cube"]'),
        (_changed(0, "colour", "x" * 500), 'block 1: "colour" must be one of: blue'),
        (_changed(0, "colour", [255, 0, 0]), "pink, not [255, 0, 0]"),
        (
            _changed(1, "position", [0.1, 0.1]),
            'block 2: "position" must be a list of 3 numbers in metres',
        ),
        (_changed(1, "position", [0.1, 0.1, "0"]), 'block 2: "position" must be'),
        (_changed(1, "position", [0.1, 0.1, True]), 'block 2: "position" must be'),
        (_changed(1, "position", [0.1, 0.1, float("nan")]), 'block 2: "position" must be'),
        (_changed(1, "position", [0.1, 0.1, float("inf")]), 'block 2: "position" must be'),
        (_changed(1, "position", [0.1, 0.1, 10**400]), 'block 2: "position" must be'),
        (_changed(1, "position", "here"), 'block 2: "position" must be'),
        (_changed(1, "quaternion", [1, 0, 0]), 'block 2: "quaternion" must be a list of 4 numbers'),
        (_changed(1, "quaternion", None), 'block 2: "quaternion" must be'),
        (
            _changed(1, "quaternion", [0, 0, 0.0, 0]),
            "each from -10 to 10 and not all zero, not [0, 0, 0.0, 0]",
        ),
        (_changed(1, "target", 1), 'block 2: "target" must be true or false'),
        (_changed(1, "target", True), "block 2: block 1 is the target already"),
        (
            _changed(0, "position", [0.203, 0.0, 0.025]),
            "block 1: reaches 4.0 mm beyond the square of 0.448 m",
        ),
        (_changed(0, "position", [0.0, -0.5, 0.025]), "block 1: reaches 301.0 mm beyond"),
        (_changed(0, "position", [0.05, 0.0, 0.022]), "block 1: reaches 3.0 mm below the table"),
        (_changed(0, "position", [0.05, 0.0, 0.48]), "block 1: reaches 0.505 m above the table"),
        (_changed(0, "position", [0.0225, 0.0, 0.025]), "block 2: overlaps block 1 by 2.5 mm"),
    ],
)
def test_bad_file_is_refused_in_one_line(tmp_path: Path, content: Any, says: str):
    """Claim: whatever is wrong with a case file is a ValueError of one line that names the file,
    the block and it."""
    path = _written(tmp_path, content)
    with pytest.raises(ValueError, match=re.escape(says)) as error:
        cases.load(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert len(message) < len(str(path)) + 200


def test_unreadable_file_is_refused_in_one_line(tmp_path: Path):
    """Claim: a file that is not there, a folder, or no text is a ValueError too."""
    (tmp_path / "raw.json").write_bytes(b"\xff\xfe\x00")
    for path, says in (
        (tmp_path / "none.json", "No such file"),
        (tmp_path, "directory"),
        (tmp_path / "raw.json", "is not a JSON file: 'utf-8' codec"),
    ):
        with pytest.raises(ValueError, match=says) as error:
            cases.load(path)
        assert str(error.value).startswith(f"{path}: ")


def test_unknown_name_lists_the_shipped_cases():
    """Claim: asking for a case that is not shipped names those that are."""
    with pytest.raises(
        ValueError, match=r"unknown case '\.\./x'; choose one of: hole, pinwheel, ridge, row"
    ):
        cases.shipped("../x")


@pytest.mark.parametrize(
    ("shape", "height", "second"),
    [
        ("cube", 0.025, "cube"),
        ("cylinder", 0.025, "prism"),
        ("prism", 0.0243, "prism"),
        ("half_cylinder", 0.0125, "tile"),
        ("arch", 0.025, "plank"),
    ],
)
def test_overlap_is_measured_to_the_millimetre(
    tmp_path: Path, shape: str, height: float, second: str
):
    """Claim: two blocks side by side may overlap by 2 mm, no more, whatever their shapes."""
    other = blocks.SHAPES[second].half_size
    touching = (blocks.SHAPES[shape].half_size[1] if shape != "cylinder" else 0.0224) + other[1]
    first = _block(shape, [0.0, 0.0, height])
    _load(tmp_path, first, _block(second, [0.0, touching - 0.0018, other[2]], "blue"))
    with pytest.raises(ValueError, match=r"block 2: overlaps block 1 by 2\.[0-9] mm"):
        _load(tmp_path, first, _block(second, [0.0, touching - 0.0025, other[2]], "blue"))


@pytest.mark.parametrize("shape", blocks.SHAPES)
def test_same_place_is_an_overlap(tmp_path: Path, shape: str):
    """Claim: a block inside another is refused, however deep."""
    half = blocks.SHAPES[shape].half_size
    with pytest.raises(ValueError, match="block 2: overlaps block 1"):
        _load(
            tmp_path, _block(shape, [0.0, 0.0, half[2]]), _block(shape, [0.0, 0.0, half[2]], "blue")
        )


@pytest.mark.parametrize("shape", blocks.SHAPES)
def test_corners_are_those_of_the_block(tmp_path: Path, shape: str):
    """Claim: a block of any shape, turned or not, may touch the border from inside, and reach no
    farther."""
    half = np.array(blocks.SHAPES[shape].half_size)
    border = 0.5 * HeightmapConfig().extent
    for turn, reach in ((0.0, half[0]), (90.0, half[1])):
        quaternion = (
            Rotation.from_euler("z", turn, degrees=True).as_quat(scalar_first=True).tolist()
        )
        _load(tmp_path, _block(shape, [border - reach, 0.0, half[2]], "red", quaternion))
        with pytest.raises(ValueError, match=r"block 1: reaches 1\.0 mm beyond the square"):
            _load(
                tmp_path, _block(shape, [border - reach + 0.001, 0.0, half[2]], "red", quaternion)
            )


def test_the_square_may_be_another(tmp_path: Path):
    """Claim: the side of the square is the caller's."""
    path = _written(tmp_path, PAIR)
    cases.load(path, 0.2)
    with pytest.raises(ValueError, match=r"block 1: reaches 5\.0 mm beyond the square of 0\.14 m"):
        cases.load(path, 0.14)


def test_target_is_required_where_asked(tmp_path: Path):
    """Claim: without a target a case is for the clearing task only."""
    cases.require_target(_load(tmp_path, *PAIR["blocks"]))
    loose = _load(tmp_path, PAIR["blocks"][1])
    assert int(loose.scene.target) == layout.ANY
    with pytest.raises(ValueError, match="case 'test' marks no target"):
        cases.require_target(loose)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "nested too deeply"),
        ('{"name": ' + "[" * 300 + "]" * 300 + ', "blocks": []}', '"name" must be'),
        ('{"name": "a", "blocks": [' + "1, " * 100_000 + "1]}", '"blocks" must be a list'),
        ("{" + ", ".join(f'"k{i}": {i}' for i in range(20_000)) + "}", 'unknown key "k0"'),
        ("{" + ", ".join('"k": 1' for _ in range(20_000)) + "}", 'key "k" is given twice'),
        ('{"name": "a", "blocks": 1' + "0" * 400 + "}", '"blocks" must be'),
        ('{"name": "a", "blocks": 1' + "0" * 5000 + "}", "."),
        ('{"name": "\\ud800", "blocks": []}', '"name" must be'),
    ],
)
def test_hostile_file_is_one_line(tmp_path: Path, text: str, message: str):
    """Claim: deep nesting, long lists, huge numbers and thousands of keys are refused at once, in
    one line."""
    path, begun = tmp_path / "case.json", time.monotonic()
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        cases.load(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 300
    assert time.monotonic() - begun < 2.0


def _with_object(tmp_path: Path, **changes: object) -> Path:
    """A case of a cup of a library beside the file, a cube, and changes to the cup's entry."""
    if not (tmp_path / "lib").exists():
        library.save(tmp_path / "lib", families.draw(0, 14))
    cup = {
        "object": "cup-0-2",
        "library": "lib",
        "colour": "red",
        "position": [0.05, 0.0, 0.0311],
        "quaternion": [1, 0, 0, 0],
    }
    cube = {
        "shape": "cube",
        "colour": "blue",
        "position": [-0.05, 0.0, 0.025],
        "quaternion": [1, 0, 0, 0],
        "target": True,
    }
    path = tmp_path / "case.json"
    path.write_text(json.dumps({"name": "cup", "blocks": [cup | changes, cube]}))
    return path


def test_a_case_names_objects(tmp_path: Path):
    """Claim: an object of a library beside the file stands at its place: the middle of its bounding
    box, not its centre of mass, is where the case says."""
    case = cases.load(
        _with_object(tmp_path, quaternion=[0.5, 0.5, 0.5, 0.5], position=[0, 0.1, 0.04])
    )
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
        ({"library": 3}, '"library" must be a text'),
        ({"shape": "cube"}, 'unknown key "shape"'),
        ({"position": [0.05, 0.0, 0.02]}, "mm below the table"),
        ({"position": [-0.04, 0.0, 0.0311]}, "overlaps block 1"),
        ({"position": [0.2, 0.0, 0.0311]}, "beyond the square"),
    ],
)
def test_an_unsound_object_is_named(tmp_path: Path, changes: dict[str, object], message: str):
    """Claim: an object that is unknown, lies wrong or overlaps is one line with the file."""
    path = _with_object(tmp_path, **changes)
    with pytest.raises(ValueError, match=message) as caught:
        cases.load(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
