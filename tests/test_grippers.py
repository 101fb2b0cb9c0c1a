"""The numbers of grippers: closed forms, and the user's files."""

import json
import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from csac_jax import grippers
from csac_jax.errors import SettingsError

RG2 = grippers.load("rg2")


def _numbers(name: str = "rg2") -> dict[str, Any]:
    return json.loads((grippers.load(name).folder / grippers.NUMBERS).read_text())


def _write(folder: Path, numbers: Any) -> str:
    folder.mkdir(exist_ok=True)
    (folder / grippers.NUMBERS).write_text(json.dumps(numbers))
    return str(folder)


def test_shipped_grippers_name_their_sources():
    """Claim: each shipped gripper says where its lengths are from."""
    assert {"2f85", "franka_hand", "rg2", "varied", "wsg32"} <= {*grippers.shipped()}
    for name in grippers.shipped():
        sources = _numbers(name)["sources"]
        assert {*sources} >= {*grippers.LENGTHS} - {"clearance"}
        assert all(len(text) >= 4 for text in sources.values())


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("name", grippers.shipped())
def test_gap_is_the_inverse_of_the_joints(name: str, xp: Any):
    """Claim: joints and actuator follow the opening; the first joint gives the gap back."""
    gripper = grippers.load(name)
    half = xp.linspace(*gripper.half, 50)
    joints = gripper.joint_positions(half, xp)
    for joint, (closed, opened) in zip(joints, gripper.positions, strict=True):
        np.testing.assert_allclose([joint[0], joint[-1]], [closed, opened], atol=1e-6)
        assert (np.diff(joint) * np.sign(opened - closed) > 0.0).all()
    ends = gripper.set_point(half, xp)
    np.testing.assert_allclose([ends[0], ends[-1]], gripper.set_points, atol=1e-6)
    gap = gripper.gap(joints[0], xp)
    np.testing.assert_allclose(gap, 2.0 * half - gripper.opening[0], atol=1e-6)
    for values in (*joints, ends) if name == "rg2" else ():  # half the opening, to the last bit
        np.testing.assert_array_equal(values, half)


RANGES = {"opening": [0.06, 0.14], "thickness": [0.008, 0.02], "width": [0.014, 0.026]}
WRONG = {
    "missing": (("opening", None), "'opening' is missing"),
    "part": (("finger", {"thickness": 0.01, "width": 0.02}), "'finger.length' is missing"),
    "unknown": (("fingers", 2), "'fingers' is unknown"),
    "format": (("format", 2), "'format' should be 1"),
    "pads": (("pads", ["pad"]), "'pads.1' is missing"),
    "joints": (("joints", {}), "'joints' must name 1 to 16"),
    "text": (("depth", {"closed": "0.2", "open": 0.2}), "'depth.closed' should be a valid number"),
    "nan": (("radius", float("nan")), "'radius' must lie in 0 .. 1 m"),
    "millimetres": (("opening", {"closed": 0, "open": 110}), "'opening' must lie in 0 .. 1 m"),
    "swapped": (("opening", {"closed": 0.1, "open": 0}), "'opening' must grow from closed"),
    "moves": (("depth", {"closed": 0.2, "open": 0.21}), "'depth' must be the same at both ends"),
    "still": (("joints", {"a": {"closed": 1, "open": 1}}), "must differ between closed and open"),
    "narrow": (("radius", 0.05), "'radius' must hold the open fingers"),
    "tight": (("arc_radius", 0.02), "'arc_radius' must be above 0.0275"),
    "no range": (("varies", {}), "'varies.opening' is missing"),
    "a number": (("varies", {"opening": 0.1}), "'varies.opening' should be a valid array"),
    "turned": (("varies", RANGES | {"opening": [0.14, 0.06]}), "'varies' must be ranges [least, "),
    "wider": (("varies", RANGES | {"width": [0.01, 0.03]}), "the most of 'varies' must be the MJ"),
}


@pytest.mark.parametrize("case", WRONG)
def test_numbers_that_do_not_fit_are_named(tmp_path: Path, case: str):
    """Claim: numbers that are missing, unknown or cannot be are one line with file and key."""
    (key, value), says = WRONG[case]
    numbers = _numbers("varied" if key == "varies" else "rg2")
    numbers[key] = value
    if value is None:
        del numbers[key]
    folder = _write(tmp_path / "mine", numbers)
    with pytest.raises(SettingsError, match=re.escape(says)) as error:
        grippers.load(folder)
    assert str(error.value).startswith(f"{folder}/gripper.json: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, "\xff\xfe"])
def test_files_that_are_no_numbers_are_refused(tmp_path: Path, text: str):
    """Claim: a file that holds no JSON object is one line, however it is damaged."""
    (tmp_path / grippers.NUMBERS).write_text(text, encoding="latin-1")
    with pytest.raises(SettingsError, match=r"gripper\.json: ") as error:
        grippers.load(str(tmp_path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("source", ["rg3", "/nowhere"])
def test_no_gripper_is_one_line(source: str):
    """Claim: a name without a gripper says which there are."""
    message = f"neither one of {', '.join(grippers.shipped())} nor a folder"
    with pytest.raises(SettingsError, match=message):
        grippers.load(source)
